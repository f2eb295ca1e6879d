"""The command `knotgym prompt`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    RUN,
    EngineOption,
    HoldOption,
    IntegratorStepsOption,
    OverwriteOption,
    QuietOption,
    ResetNoiseOption,
    RestartOption,
    ResumeOption,
    SeedOption,
    StatesOption,
    TowLimitOption,
    default_folder,
    option,
)
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing

if TYPE_CHECKING:
    from knotgym.prompting.prompted_episodes import PromptConfig

_MODEL, _PROMPT = "The model", "The prompt"


def prompt(
    pictures: Annotated[
        Path | None,
        typer.Argument(
            metavar="PICTURES", help="For mode read: a folder of pictures from `knotgym images`."
        ),
    ] = None,
    mode: Annotated[
        str,
        option(
            "--mode",
            help=(
                "open: one answer with all actions; stateless: one action per request; stateful:"
                " the same, with past pictures and answers; read: the Gauss code of a picture."
            ),
            group=_PROMPT,
        ),
    ] = "stateless",
    model: Annotated[str, option("--model", help="Model name on the server.", group=_MODEL)] = "",
    base_url: Annotated[
        str,
        option(
            "--base-url",
            help=(
                "URL of a server with the chat-completions protocol. Its key, if it needs one, is"
                " read from OPENAI_API_KEY."
            ),
            group=_MODEL,
        ),
    ] = "https://api.openai.com/v1",
    temperature: Annotated[
        float,
        option(
            "--temperature",
            help="Sampling temperature; below 0 uses the server's default.",
            group=_MODEL,
        ),
    ] = 1.0,
    prompt_price: Annotated[
        float | None,
        option("--prompt-price", help="Price of a million prompt tokens.", group=_MODEL),
    ] = None,
    completion_price: Annotated[
        float | None,
        option("--completion-price", help="Price of a million completion tokens.", group=_MODEL),
    ] = None,
    timeout: Annotated[
        float, option("--timeout", help="Time limit for one request, in seconds.", group=_MODEL)
    ] = 120.0,
    attempts: Annotated[
        int,
        option("--attempts", help="Tries per request before the run stops.", group=_MODEL),
    ] = 6,
    backoff: Annotated[
        float,
        option(
            "--backoff",
            help="Seconds to wait before the second try; doubled before each later one.",
            group=_MODEL,
        ),
    ] = 1.0,
    task: Annotated[str, typer.Option(help="Task: tie, unknot or convert.")] = "tie",
    nx: Annotated[int, typer.Option("--nx", help="Number of crossings.")] = 2,
    episodes: Annotated[
        int, typer.Option(help="Number of episodes, or of pictures from the start of the split.")
    ] = 100,
    split: Annotated[
        str,
        typer.Option(
            help="Split, as for evaluate; default train, as published, or test for pictures."
        ),
    ] = "",
    window: Annotated[
        int,
        option("--window", help="Past turns included in mode stateful.", group=_PROMPT),
    ] = 4,
    actions: Annotated[
        int, option("--actions", help="Maximum actions per episode.", group=_PROMPT)
    ] = 50,
    image_size: Annotated[
        int, option("--image-size", help="Side of each picture in pixels.", group=_PROMPT)
    ] = 256,
    tell_centre: Annotated[
        bool,
        option(
            "--tell-centre",
            help="Tell the model the world coordinates of the picture's centre.",
            group=_PROMPT,
        ),
    ] = False,
    show: Annotated[
        bool,
        option(
            "--show",
            help="Print the whole prompt and send nothing; with --out also write its pictures.",
            group=_PROMPT,
        ),
    ] = False,
    states: StatesOption = None,
    hold: HoldOption = 1,
    tow_limit: TowLimitOption = None,
    reset_noise: ResetNoiseOption = 0.015,
    engine: EngineOption = "mujoco",
    integrator_steps: IntegratorStepsOption = 24,
    camera: Annotated[
        str,
        option("--camera", help="Projection: orthographic or perspective.", group=ENVIRONMENT),
    ] = "orthographic",
    out: Annotated[Path | None, typer.Option(help="Folder to write.")] = None,
    side_by_side: Annotated[
        int,
        option("--side-by-side", help="Concurrent requests to the server.", group=RUN),
    ] = 4,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Evaluate a vision-language model on episodes, or on reading Gauss codes from pictures.

    Each episode's transcript is a line of transcripts.jsonl; result.json has the totals.

    Examples:

        knotgym prompt --mode stateless --task tie --nx 2 --model NAME

        knotgym prompt --mode read knotgym-data/images-nx0-4 --model NAME --base-url http://127.0.0.1:8000/v1
    """
    with Progress(quiet) as progress:
        from knotgym.envs.tasks import TaskConfig
        from knotgym.prompting.chat import ChatConfig
        from knotgym.prompting.prompted_episodes import PromptConfig, play
        from knotgym.prompting.prompts import READ

        if (mode == READ) != (pictures is not None):
            raise typer.BadParameter(
                "mode read, and only mode read, takes a folder of pictures; got --mode"
                f" {mode}{' and no folder' if pictures is None else f' and {pictures}'}"
            )
        if show and not model:
            model = "none"
        chat = ChatConfig(
            model=model,
            base_url=base_url,
            temperature=None if temperature < 0 else temperature,
            timeout=timeout,
            attempts=attempts,
            backoff=backoff,
        )
        environment = TaskConfig(
            task=task,
            nx=nx,
            split="train" if pictures is not None else split or "train",
            states=None if states is None else str(states),
            horizon=actions,
            hold=hold,
            tow_limit=tow_limit,
            reset_noise=reset_noise,
            image_size=image_size,
            camera=camera,
            engine=engine,
            integrator_steps=integrator_steps,
        )
        settings: dict[str, Any] = {
            "mode": mode,
            "chat": chat,
            "task": environment,
            "episodes": episodes,
            "seed": seed,
            "window": window,
            "tell_centre": tell_centre,
            "prompt_price": prompt_price,
            "completion_price": completion_price,
        }
        config = PromptConfig(**settings)
        rows = [] if pictures is None else _rows(pictures, split or "test", config.episodes)
        if show:
            _show(config, rows, out, overwrite, progress)
            return
        if pictures is not None:
            config = PromptConfig(**settings, pictures=(split or "test", _digest(rows)))
        subject = f"{task}-nx{nx}" if pictures is None else pictures.absolute().name
        stem = "".join(letter if letter.isalnum() or letter in "-." else "-" for letter in model)
        mark = f"seed{seed}" if seed else ""
        folder = out or default_folder(f"prompt-{mode}-{subject}", stem, mark)

        from knotgym.prompting.prompt_run import run
        from knotgym.prompting.prompted_episodes import read

        def ask(number: int, of: Any) -> dict[str, Any]:
            if rows:
                return read(config, number, rows[number], of)
            return play(config, number, of)

        run(
            config,
            ask,
            len(rows) or config.episodes,
            folder,
            side_by_side=side_by_side,
            existing=Existing(resume=resume, restart=restart, overwrite=overwrite),
            progress=progress,
        )
        if not quiet:
            from knotgym.cli.summaries import print_transcripts

            print_transcripts(folder, progress.console)
            progress.say(f"{folder}: transcripts.jsonl, result.json")


def _rows(pictures: Path, split: str, count: int) -> list[dict[str, Any]]:
    """Return the first `count` pictures of a split; the table is shuffled."""
    from itertools import islice

    from knotgym.datasets.image_table import InvalidImages, read_rows

    columns = ["image", "gauss_code", "nx", "grade", "accepted"]
    rows = list(islice(read_rows(pictures, split, columns), count))
    if not rows:
        raise InvalidImages(f"{pictures} has no pictures of split {split}")
    return rows


def _digest(rows: list[dict[str, Any]]) -> str:
    import hashlib

    return hashlib.sha256(b"".join(row["image"] for row in rows)).hexdigest()


def _show(
    config: PromptConfig,
    rows: list[dict[str, Any]],
    out: Path | None,
    overwrite: bool,
    progress: Progress,
) -> None:
    """Print the prompt of the first episode or picture.

    In mode stateful it is the prompt of the second turn, after an answer that moved nothing.
    """
    from knotgym.common.atomic_files import atomic_write, require_output
    from knotgym.prompting.prompts import as_text
    from knotgym.prompting.sample_prompt import sample_prompt

    messages, shown = sample_prompt(config, rows)
    pictures = {} if out is None else {out / f"{one.name}.png": one.png for one in shown}
    for path in pictures:
        require_output(path, folder=False, overwrite=overwrite)
    progress.console.print(
        as_text(messages, {one.sha256: one.name for one in shown}),
        end="",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    for path, png in pictures.items():
        with atomic_write(path, overwrite=overwrite) as temporary:
            temporary.write_bytes(png)
