"""The command `knotgym train`."""

import importlib.util
from pathlib import Path

from knotgym.cli.options import EXISTING, Given, Option, command, option, options_of, run_options
from knotgym.common.errors import InvalidInput, MissingExtra, install_command
from knotgym.learn.clone_config import CloneConfig
from knotgym.learn.train_config import TrainConfig


def _options() -> list[Option]:
    return [
        option("--out", Path, "Folder to write: weights, card and learning curves.", default=...),
        option(
            "--data",
            list[str],
            "Minari id or folder of train-split episodes; may be repeated.",
        ),
        option(
            "--learner",
            str,
            "pictures: the learner from pictures alone. clone: imitates the macro-actions of a"
            " demonstrator, from vertices.",
            default="pictures",
        ),
        *options_of(
            TrainConfig(),
            "steps",
            steps={
                "help": "Training steps: of the reader of pictures, or 4000 of the clone.",
            },
        ),
        *_of_the_clone(),
        *run_options("settings"),
        *options_of(TrainConfig(), "engine seed"),
        *run_options(EXISTING),
    ]


def _of_the_clone() -> list[Option]:
    made = "episodes task nx split".replace(" ", " demonstrations.")
    own = options_of(
        CloneConfig(),
        f"demonstrations.{made} improve",
        "The clone",
        episodes={"names": "--demonstrations"},
    )
    return [*own, *run_options("workers")]


@command(_options)
def train(given: Given) -> None:
    """Train a policy; evaluate it with `knotgym evaluate --policy FOLDER`."""
    for library in ("torch", "safetensors"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, install_command("learn"), "knotgym train")
    from knotgym.learn.clone_training import train_clone
    from knotgym.learn.training import train as train_from_pictures

    learner, data, out = given["learner"], given["data"] or [], given["out"]
    if learner == "clone":
        clone = given.config(CloneConfig)
        run = given.run
        train_clone(data, out, clone, existing=run, workers=run.workers, progress=given.progress)
    elif learner != "pictures":
        raise InvalidInput(f"no learner {learner!r}; there is pictures, clone")
    elif given.typed & {option.path for option in _of_the_clone()}:
        raise InvalidInput(
            "only the clone makes demonstrations and improves by playing: add --learner clone"
        )
    elif not data:
        raise InvalidInput("name at least one dataset to train on, as in --data FOLDER")
    else:
        pictures = given.config(TrainConfig)
        train_from_pictures(data, out, pictures, existing=given.run, progress=given.progress)
