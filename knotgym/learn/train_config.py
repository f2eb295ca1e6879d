"""The configuration of `knotgym train`, which can be read without torch."""

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import InvalidInput
from knotgym.rope.engines import MUJOCO, require_engine


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of a training.

    Attributes:
        steps: training steps of the reader, the perception model.
        batch: pictures per step.
        places: start positions of episodes that are kept, at most.
        save_every: steps between checkpoints.
        engine: engine that the episodes must be made with, mujoco or chain.
        seed: random seed; the same seed and data give the same weights.
    """

    steps: int = 3000
    batch: int = 48
    places: int = 512
    save_every: int = 200
    engine: str = MUJOCO
    seed: int = 0

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("steps", "batch", "places", "save_every"),
            whole=("seed",),
            error=InvalidInput,
        )
        require_engine(self.engine)
