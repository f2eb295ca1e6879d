"""The command `knotgym train`."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Any

import typer

from knotgym.cli.options import (
    OverwriteOption,
    QuietOption,
    RestartOption,
    ResumeOption,
    SettingsOption,
    with_settings,
)
from knotgym.common.errors import MissingExtra, install_command
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing


def train(
    out: Annotated[Path, typer.Option(help="Folder to write: weights, card and learning curves.")],
    data: Annotated[
        list[str],
        typer.Option(help="Minari id or folder of train-split episodes; may be repeated."),
    ],
    learner: Annotated[
        str,
        typer.Option(
            help="pictures: the learner from pictures alone. clone: imitates the macro-actions of"
            " a demonstrator, from vertices."
        ),
    ] = "pictures",
    steps: Annotated[
        int | None,
        typer.Option(help="Training steps: 3000 of the reader of pictures, or 4000 of the clone."),
    ] = None,
    improve: Annotated[
        int,
        typer.Option(
            help="Rounds in which the clone plays in the chain engine and learns from it."
        ),
    ] = 0,
    settings: SettingsOption = None,
    seed: Annotated[
        int, typer.Option(help="Random seed; the same seed and data give the same weights.")
    ] = 0,
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train a policy; evaluate it with `knotgym evaluate --policy FOLDER`."""
    for library in ("torch", "safetensors"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, install_command("learn"), "knotgym train")
    with Progress(quiet) as progress:
        from knotgym.learn.clone_config import CloneConfig
        from knotgym.learn.clone_training import train_clone
        from knotgym.learn.training import TrainConfig
        from knotgym.learn.training import train as train_from_pictures
        from knotgym.learn.training_data import InvalidTraining

        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        given: dict[str, Any] = {} if steps is None else {"steps": steps}
        if learner == "clone":
            clone = with_settings(CloneConfig(seed=seed, improve=improve, **given), settings)
            train_clone(data, out, clone, existing=existing, progress=progress)
        elif learner == "pictures" and not improve:
            pictures = with_settings(TrainConfig(seed=seed, **given), settings)
            train_from_pictures(data, out, pictures, existing=existing, progress=progress)
        elif improve:
            raise InvalidTraining("only the clone improves by playing: add --learner clone")
        else:
            raise InvalidTraining(f"no learner {learner!r}; there is pictures, clone")
