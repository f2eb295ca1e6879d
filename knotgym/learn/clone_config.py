"""Settings of the clone's training; no torch here, because the command line reads them."""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.learn.train_config import InvalidTraining

HEADS = ("macro", "bead")


@dataclass(frozen=True, kw_only=True)
class ImproveConfig:
    """How the clone plays to improve.

    Attributes:
        episodes: per task and round.
        temperature: at which macro-actions are drawn.
        rounds_kept: rounds whose decisions are trained on, the latest.
    """

    episodes: int = 512
    temperature: float = 0.7
    rounds_kept: int = 6

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("episodes", "rounds_kept"),
            non_negative=("temperature",),
            error=InvalidTraining,
        )


@dataclass(frozen=True, kw_only=True)
class CloneConfig:
    """Settings of a clone's training.

    Attributes:
        action: what is cloned: "macro" for a demonstrator's macro-actions, "bead" for every pull.
        steps: optimizer steps on the data.
        failed: whether to learn from episodes that didn't reach their goal, too.
        hindsight: macro-actions before a state for which its code counts as a goal; 0 for none.
        hindsight_share: share of each batch that has such goals, if there are any.
        improve: rounds of improvement by playing in the chain engine.
        round_steps: optimizer steps after each of them.
        batch: decisions per step.
        rate: peak learning rate; it falls by a cosine.
        decay: weight decay.
        average: decay of the average of the weights, per step.
        held_out: share of the episodes that are held out.
        judge_every: steps between held-out losses and checkpoints.
        width: of the network.
        layers: of attention.
        seed: seed of all random draws.
        play: how the clone plays.
    """

    action: str = "macro"
    steps: int = 4000
    failed: bool = False
    hindsight: int = 2
    hindsight_share: float = 0.2
    improve: int = 0
    round_steps: int = 1000
    batch: int = 128
    rate: float = 1e-3
    decay: float = 0.05
    average: float = 0.998
    held_out: float = 0.1
    judge_every: int = 250
    width: int = 96
    layers: int = 2
    seed: int = 0
    play: ImproveConfig = ImproveConfig()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("steps", "round_steps", "batch", "judge_every", "width", "layers"),
            whole=("seed", "improve", "hindsight"),
            positive=("rate",),
            non_negative=("decay", "average", "held_out", "hindsight_share"),
            error=InvalidTraining,
        )
        if self.action not in HEADS:
            raise InvalidTraining(f"action must be {' or '.join(HEADS)}, got {self.action!r}")
        for name in ("average", "held_out", "hindsight_share"):
            if getattr(self, name) >= 1:
                raise InvalidTraining(f"{name} must be below 1, got {getattr(self, name)}")
        if self.improve and self.action != "macro":
            raise InvalidTraining(
                f"a clone improves by its macro-actions: set action = macro, got {self.action!r}"
            )
