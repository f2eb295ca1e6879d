"""The command `knotgym train`."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from knotgym.cli.options import (
    EXISTING,
    Given,
    Option,
    command,
    option,
    options_of,
    run_options,
)
from knotgym.common.errors import MissingExtra, install_command
from knotgym.learn.train_config import TrainConfig


def _options() -> list[Option]:
    return [
        option("--out", Path, "Folder to write: weights, card and learning curves.", default=...),
        option(
            "--data",
            list[str],
            "Minari id or folder of train-split episodes; may be repeated.",
            default=...,
        ),
        *options_of(TrainConfig(), "steps"),
        *run_options("settings"),
        *options_of(TrainConfig(), "seed"),
        *run_options(EXISTING),
    ]


@command(_options)
def train(given: Given) -> None:
    """Train a policy from pictures alone; evaluate it with `knotgym evaluate --policy FOLDER`."""
    for library in ("torch", "safetensors"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, install_command("learn"), "knotgym train")
    from knotgym.learn.training import train as run

    config = given.config(TrainConfig)
    run(given["data"], given["out"], config, existing=given.run, progress=given.progress)
