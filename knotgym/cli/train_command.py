"""The command `knotgym train`."""

import importlib.util
from pathlib import Path

from knotgym.cli.options import EXISTING, Given, command, extra
from knotgym.common.errors import InvalidInput, MissingExtra, install_command
from knotgym.learn.clone_config import CloneConfig
from knotgym.learn.train_config import TrainConfig


@command(
    {"": TrainConfig, "clone": CloneConfig},
    f"steps seed run.workers {EXISTING}",
    extra("out", Path, "Folder to write: weights, card and learning curves."),
    extra("data", list[str], "Minari id or folder of train-split episodes; may be repeated."),
    extra(
        "learner",
        str,
        "pictures: the learner from pictures alone. clone: imitates the macro-actions of a"
        " demonstrator, from vertices; its settings are in the section clone.",
        "pictures",
    ),
)
def train(given: Given) -> None:
    """Train a policy; evaluate it with `knotgym evaluate --policy FOLDER`.

    Examples:

        knotgym train --data knotgym/tie-nx2/expert-v0 --out runs/reader

        knotgym train --learner clone --set clone.demonstrations.episodes=2000 --out runs/clone
    """
    for library in ("torch", "safetensors"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, install_command("learn"), "knotgym train")
    from knotgym.learn.clone_training import train_clone
    from knotgym.learn.training import train as train_from_pictures

    learner, data, out = given["learner"], given["data"] or [], given["out"]
    if out is None:
        raise InvalidInput("name the folder to write: --out FOLDER")
    if learner == "clone":
        common = {name: given.get(name) for name in ("steps", "seed") if given.has(name)}
        clone = given.config(CloneConfig, common, section="clone")
        run = given.run
        train_clone(data, out, clone, existing=run, workers=run.workers, progress=given.progress)
    elif learner != "pictures":
        raise InvalidInput(f"no learner {learner!r}; there is pictures, clone")
    elif given.has("clone"):
        raise InvalidInput("settings of the clone are for --learner clone")
    elif not data:
        raise InvalidInput("name at least one dataset to train on, as in --data FOLDER")
    else:
        pictures = given.config(TrainConfig)
        train_from_pictures(data, out, pictures, existing=given.run, progress=given.progress)
