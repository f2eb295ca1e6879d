"""The configuration of `knotgym train`, which can be read without torch."""

from knotgym.common.configuration import Count, Seed, configuration
from knotgym.rope.engines import MUJOCO, EngineName


@configuration
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

    steps: Count = 3000
    batch: Count = 48
    places: Count = 512
    save_every: Count = 200
    engine: EngineName = MUJOCO
    seed: Seed = 0
