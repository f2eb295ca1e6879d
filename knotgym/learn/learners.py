"""The learners that `knotgym train` knows; torch isn't imported before one is used."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from knotgym.learn.card import PRETRAINED, ROPE_READER
from knotgym.learn.train_config import CloneConfig, ReaderConfig, TrainConfig

PICTURES, CLONE = "pictures", "clone"


@dataclass(frozen=True)
class Learner:
    """All that differs between learners.

    Attributes:
        config: class of its settings.
        training: "module:class" of its `Training`.
        policy: "module:function" that makes the policy of a folder, or of its name.
        ships: name of its folder that ships with the package.
        section: of its settings; "" for the command's own.
        splits: of the counted passes that its policy reads.
        every_code: whether it reads those of every code.
    """

    config: type[TrainConfig]
    training: str
    policy: str
    ships: str
    section: str = ""
    splits: tuple[str, ...] = ("train",)
    every_code: bool = False

    def loaded(self, name: str) -> Any:
        """Import what a "module:name" stands for."""
        return resolve_name(f"knotgym.learn.{name}")


LEARNERS = {
    PICTURES: Learner(
        config=ReaderConfig,
        training="reader_training:ReaderTraining",
        policy="agent:PicturePolicy",
        ships=PRETRAINED,
    ),
    CLONE: Learner(
        config=CloneConfig,
        training="clone_training:CloneTraining",
        policy="clone_policy:load_clone",
        ships="pretrained-clone",
        section="clone",
        splits=("train", "train-code"),
        every_code=True,
    ),
}
# names of the policies that ship
POLICIES = tuple(learner.ships for learner in LEARNERS.values())


def policy_folder(name: str | Path) -> Path:
    """Return the folder of a learner: a path, or the name of one that ships."""
    if name in (*POLICIES, ROPE_READER):
        return Path(str(files("knotgym.learn") / "data" / name))
    return Path(name)
