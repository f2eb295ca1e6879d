"""The configurations of `knotgym train` and `knotgym read`, which can be read without torch."""

from itertools import product
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat

from knotgym.common import Count, Distinct, InvalidInput, Mark, Seed, configuration
from knotgym.envs import TaskConfig
from knotgym.learn.card import ROPE_READER
from knotgym.rope import CHAIN

HEADS = 4  # of the attention of a clone


@configuration
class TrainConfig:
    """Settings that all learners have.

    Attributes:
        steps: optimizer steps.
        batch: examples per step.
        save_every: steps between checkpoints.
        trials: episodes of the training's tasks that the learner plays about ten times while it
            trains, so that `training.csv` and `curve.png` show its success rate; 0 for none.
        seed: random seed; the same seed and data give the same weights.
    """

    steps: Count = 3000
    batch: Count = 48
    save_every: Count = 200
    trials: NonNegativeInt = 0
    seed: Seed = 0

    @property
    def demonstrated(self) -> list[TaskConfig]:
        """The tasks of demonstrations that the training makes."""
        return []


@configuration
class ReaderConfig(TrainConfig):
    """Settings of the learner from pictures, that is of its reader.

    Attributes:
        positions: start positions of ropes that are kept, at most.
    """

    positions: Count = 512


@configuration
class CloneConfig(TrainConfig):
    """Settings of a clone.

    Attributes:
        guided: whether the clone, when it acts, also chooses by the counted passes that ship, which
            tell what leads nearer to the goal.
        rate: peak learning rate; it falls by a cosine.
        width: of the network.
        layers: of attention.
        demonstrations: searches to make for each task and nx in the chain engine, beside the
            episodes of datasets.
        copies: of each search that found a way, with the beads numbered from others.
        task: tasks of these demonstrations.
        nx: numbers of crossings of these demonstrations.
        split: split of their starts and goals.
        states: state file of their starts and goals, or a name of a set that ships.
        device: where the network is trained; "cuda" rounds otherwise than "cpu".
    """

    steps: Count = 4000
    batch: Count = 128
    save_every: Count = 100
    trials: NonNegativeInt = 64
    guided: bool = False
    rate: PositiveFloat = 1e-3
    width: Count = 96
    layers: Count = 2
    demonstrations: Annotated[NonNegativeInt, Field(le=10**9)] = 0
    copies: Annotated[int, Field(ge=0, le=20)] = 0
    task: tuple[Literal["tie", "convert", "unknot"], ...] = ("tie",)
    nx: Annotated[tuple[NonNegativeInt, ...], Distinct] = (2,)
    split: Literal["train", "train-code"] = "train"
    states: Annotated[str, Mark("states")] = "readable"
    device: Literal["cpu", "cuda"] = "cpu"

    def __post_init__(self) -> None:
        if self.width % HEADS:
            raise InvalidInput(
                f"width must be a multiple of {HEADS} attention heads, got {self.width}"
            )

    @property
    def demonstrated(self) -> list[TaskConfig]:
        """The tasks of demonstrations that the training makes."""
        return [
            TaskConfig(task=task, nx=nx, split=self.split, states=self.states, engine=CHAIN)
            for task, nx in product(self.task, self.nx)
            if self.demonstrations
        ]


@configuration
class ReadConfig:
    """How `knotgym read` reads photos.

    Attributes:
        views: mirror images and quarter turns of each photo that are read, 1 to 8.
        weights: folder of a reader of ropes, or the one that ships.
    """

    views: Annotated[int, Field(ge=1, le=8)] = 4
    weights: str = ROPE_READER
