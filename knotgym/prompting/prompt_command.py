"""The command `knotgym prompt`."""

import hashlib
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from knotgym import datasets
from knotgym.cli import EXISTING, Given, command
from knotgym.common import InvalidFile, InvalidInput, atomic_write, require_output
from knotgym.prompting.prompts import PromptConfig


@command(
    {"": PromptConfig}, f"mode chat.model chat.base_url task.task task.nx episodes seed {EXISTING}"
)
def prompt(
    given: Given,
    pictures: Annotated[Path | None, Parameter(name="PICTURES")] = None,
    /,
    *,
    split: str | None = None,
    out: Path | None = None,
    show: bool = False,
) -> None:
    """Evaluate a vision-language model on episodes, or on reading Gauss codes from pictures.

    Each episode's transcript is a line of transcripts.jsonl; result.json has the totals.

    Examples:

        knotgym prompt --mode stateless --task tie --nx 2 --model NAME

        knotgym prompt pictures --mode read --model NAME

    Args:
        pictures: For mode read: a folder of pictures from `knotgym images`.
        split: Split, as for evaluate; default train, as published, or test for pictures.
        out: Folder to write.
        show: Print the whole prompt and send nothing; with --out also write its pictures.
    """

    usual = {"chat.model": "none" if show else ""}
    more: dict[str, Any] = {"task.split": split} if split and pictures is None else {}
    config = given.config(PromptConfig, more, usual=usual)
    if (config.mode == "read") != (pictures is not None):
        raise InvalidInput(
            "mode read, and only mode read, takes a folder of pictures; got --mode"
            f" {config.mode} and {'no folder' if pictures is None else pictures}"
        )
    rows = [] if pictures is None else _rows(pictures, split or "test", config.episodes)
    if show:
        _show(given, config, rows, out)
        return
    if pictures is not None:
        digest = hashlib.sha256(b"".join(row["image"] for row in rows)).hexdigest()
        more["pictures"] = (split or "test", digest)
        config = given.config(PromptConfig, more, usual=usual)
    task, model = config.task, config.chat.model
    subject = f"{task.task}-nx{task.nx}" if pictures is None else pictures.absolute().name
    folder = given.folder(out, f"prompt-{config.mode}-{subject}-{model}")

    from knotgym.prompting.prompt_run import run_prompts

    run_prompts(config, folder, given.run, rows=rows, progress=given.progress)
    given.summarize(str(folder))


def _rows(pictures: Path, split: str, count: int) -> list[dict[str, Any]]:
    """Return the first `count` pictures of a split; the table is shuffled."""

    columns = ["image", "gauss_code", "nx", "grade", "accepted"]
    rows = list(islice(datasets.read_rows(pictures, split, columns), count))
    if not rows:
        raise InvalidFile(f"{pictures} has no pictures of split {split}")
    return rows


def _show(given: Given, config: PromptConfig, rows: list[dict[str, Any]], out: Path | None) -> None:
    """Print the first request of a run; write its pictures to the folder `out`, if given."""
    from knotgym.prompting.prompt_run import sample_prompt

    text, shown = sample_prompt(config, rows)
    pictures = {} if out is None else {out / f"{name}.png": png for name, png in shown.items()}
    for path in pictures:
        require_output(path, folder=False, overwrite=given.run.overwrite, reads=[])
    given.progress.console.print(text, end="", soft_wrap=True, highlight=False, markup=False)
    for path, png in pictures.items():
        with atomic_write(path, overwrite=given.run.overwrite) as temporary:
            temporary.write_bytes(png)
