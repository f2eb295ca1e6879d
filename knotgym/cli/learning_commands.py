"""The command `knotgym train`."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

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
    steps: Annotated[
        int, typer.Option(help="Training steps of the reader, the perception model.")
    ] = 3000,
    settings: SettingsOption = None,
    seed: Annotated[
        int, typer.Option(help="Random seed; the same seed and data give the same weights.")
    ] = 0,
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train a policy from pictures alone; evaluate it with `knotgym evaluate --policy FOLDER`."""
    for library in ("torch", "safetensors"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, install_command("learn"), "knotgym train")
    with Progress(quiet) as progress:
        from knotgym.learn.training import TrainConfig
        from knotgym.learn.training import train as run

        config = with_settings(TrainConfig(steps=steps, seed=seed), settings)
        run(
            data,
            out,
            config,
            existing=Existing(resume=resume, restart=restart, overwrite=overwrite),
            progress=progress,
        )
