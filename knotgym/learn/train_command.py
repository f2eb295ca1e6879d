"""The command `knotgym train`."""

from pathlib import Path

from knotgym.cli import EXISTING, Given, command
from knotgym.common import InvalidInput, MissingExtra
from knotgym.learn.train_config import CloneConfig, ReaderConfig


@command({"": ReaderConfig, "clone": CloneConfig}, f"steps seed run.workers {EXISTING}")
def train(
    given: Given, *, out: Path, data: list[str] | None = None, learner: str = "pictures"
) -> None:
    """Train a policy; evaluate it with `knotgym evaluate --policy FOLDER`.

    Examples:

        knotgym train --data knotgym/tie-nx2/expert-v0 --out runs/reader

        knotgym train --learner clone --set clone.demonstrations=2000 --out clone

    Args:
        out: Folder to write: weights, policy.json (data, settings and results of the training) and
            learning curves.
        data: Minari id or folder of train-split episodes; may be repeated.
        learner: pictures: the learner from pictures alone. clone: imitates the macro-actions of a
            planner, from vertices; its settings are in the section clone.
    """
    config: ReaderConfig | CloneConfig
    if learner == "clone":
        common = {name: given.get(name) for name in ("steps", "seed") if given.has(name)}
        config = given.config(CloneConfig, common, section="clone")
    elif learner != "pictures":
        raise InvalidInput(
            f"no learner {learner!r}; there is pictures, clone; examples/learners trains others"
        )
    elif given.has("clone"):
        raise InvalidInput("settings of the clone are for --learner clone")
    else:
        config = given.config(ReaderConfig)
    for library in ("torch", "safetensors"):
        MissingExtra.imported(library, "learn", "knotgym train")
    from knotgym.learn.train_recipe import train as train_learner

    train_learner(data or [], out, config, given.run, given.progress)
    given.progress.say(f"next: knotgym evaluate --policy {out} --split train,test")
