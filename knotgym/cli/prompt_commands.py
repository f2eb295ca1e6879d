"""The command `knotgym prompt`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    RUN,
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

_MODEL, _ASKED = "The model", "What is asked"


def prompt(
    pictures: Annotated[
        Path | None,
        typer.Argument(
            metavar="PICTURES", help="Folder of pictures that `knotgym images` made: mode read."
        ),
    ] = None,
    mode: Annotated[
        str,
        option(
            "--mode",
            help=(
                "open: one answer with all actions; stateless: an action at a time; stateful: the"
                " same, with past pictures and answers; read: the code of a picture."
            ),
            group=_ASKED,
        ),
    ] = "stateless",
    model: Annotated[str, option("--model", help="Its name at the server.", group=_MODEL)] = "",
    base_url: Annotated[
        str,
        option(
            "--base-url",
            help=(
                "A server that speaks the chat-completions protocol. The key, where one is wanted,"
                " is read from OPENAI_API_KEY."
            ),
            group=_MODEL,
        ),
    ] = "https://api.openai.com/v1",
    temperature: Annotated[
        float,
        option("--temperature", help="Of sampling; below 0 leaves it to the server.", group=_MODEL),
    ] = 1.0,
    prompt_price: Annotated[
        float | None,
        option("--prompt-price", help="Of a million prompt tokens.", group=_MODEL),
    ] = None,
    completion_price: Annotated[
        float | None,
        option("--completion-price", help="Of a million completion tokens.", group=_MODEL),
    ] = None,
    timeout: Annotated[
        float, option("--timeout", help="Seconds that an attempt may take in all.", group=_MODEL)
    ] = 120.0,
    attempts: Annotated[
        int, option("--attempts", help="Of each question, before the run stops.", group=_MODEL)
    ] = 6,
    backoff: Annotated[
        float,
        option(
            "--backoff",
            help="Seconds before the second attempt, doubled before each one after it.",
            group=_MODEL,
        ),
    ] = 1.0,
    task: Annotated[str, typer.Option(help="tie, unknot or convert.")] = "tie",
    nx: Annotated[int, typer.Option("--nx", help="Crossings.")] = 2,
    episodes: Annotated[int, typer.Option(help="Or pictures, the first of the split.")] = 100,
    split: Annotated[
        str,
        typer.Option(help="As of evaluate; by default train, as published; of pictures test."),
    ] = "",
    window: Annotated[
        int,
        option("--window", help="Past turns that mode stateful shows.", group=_ASKED),
    ] = 4,
    actions: Annotated[
        int, option("--actions", help="Limit on the actions of an episode.", group=_ASKED)
    ] = 50,
    image_size: Annotated[
        int, option("--image-size", help="Pixels of each picture.", group=_ASKED)
    ] = 256,
    tell_centre: Annotated[
        bool,
        option(
            "--tell-centre",
            help="Say where the middle of the current picture is, which can't be seen.",
            group=_ASKED,
        ),
    ] = False,
    show: Annotated[
        bool,
        option(
            "--show",
            help=("Ask nobody: print the whole prompt; with --out write its pictures there, too."),
            group=_ASKED,
        ),
    ] = False,
    states: StatesOption = None,
    hold: HoldOption = 1,
    tow_limit: TowLimitOption = None,
    reset_noise: ResetNoiseOption = 0.015,
    integrator_steps: IntegratorStepsOption = 24,
    camera: Annotated[
        str,
        option("--camera", help="orthographic or perspective.", group=ENVIRONMENT),
    ] = "orthographic",
    out: Annotated[Path | None, typer.Option(help="Folder to make.")] = None,
    side_by_side: Annotated[
        int,
        option("--side-by-side", help="Questions that wait for the server at a time.", group=RUN),
    ] = 4,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Put a vision-language model to episodes, or to reading codes off pictures.

    Each episode's transcript is a line of transcripts.jsonl; result.json holds what they count up
    to.

    Examples:

        knotgym prompt --mode stateless --task tie --nx 2 --model NAME

        knotgym prompt --mode read knotgym-data/images-nx0-4 --model NAME --base-url http://127.0.0.1:8000/v1
    """
    with Progress(quiet) as progress:
        from knotgym.prompting.chat import ChatConfig
        from knotgym.prompting.prompted_episodes import PromptConfig, play
        from knotgym.prompting.prompts import READ
        from knotgym.tasks import TaskConfig

        if (mode == READ) != (pictures is not None):
            raise typer.BadParameter(
                "mode read takes a folder of pictures, and no other mode does; got --mode"
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
        what = f"{task}-nx{nx}" if pictures is None else pictures.absolute().name
        stem = "".join(letter if letter.isalnum() or letter in "-." else "-" for letter in model)
        mark = f"seed{seed}" if seed else ""
        folder = out or default_folder(f"prompt-{mode}-{what}", stem, mark)

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
    """The first pictures of a split; they are in no order."""
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
    """Print the prompt of the first episode or picture; of mode stateful that of the second turn,
    after an answer that moved nothing.
    """
    from knotgym.atomic_files import atomic_write, require_output
    from knotgym.prompting.prompts import as_text
    from knotgym.prompting.sample_prompt import sample_prompt

    said, shown = sample_prompt(config, rows)
    pictures = {} if out is None else {out / f"{one.name}.png": one.png for one in shown}
    for path in pictures:
        require_output(path, folder=False, overwrite=overwrite)
    progress.console.print(
        as_text(said, {one.sha256: one.name for one in shown}),
        end="",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    for path, png in pictures.items():
        with atomic_write(path, overwrite=overwrite) as temporary:
            temporary.write_bytes(png)
