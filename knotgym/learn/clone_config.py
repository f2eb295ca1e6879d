"""Settings of the clone's training; no torch here, because the command line reads them."""

from typing import Annotated

from pydantic import Field

from knotgym.common.configuration import (
    Count,
    NonNegative,
    Positive,
    Real,
    Seed,
    Share,
    Whole,
    choice,
    configuration,
)
from knotgym.common.errors import InvalidInput
from knotgym.rope.engines import MUJOCO, EngineName

HEADS = ("macro", "bead")


@configuration
class DemonstrationsConfig:
    """Demonstrations that a training makes for itself, in the chain engine.

    Attributes:
        episodes: demonstrations to make of each task and nx, in the chain engine.
        task: tasks of these demonstrations: tie, convert, unknot.
        nx: numbers of crossings of these demonstrations.
        split: split of their starts and goals: train or train-code.
        every_code: whether goals are drawn from every code with so many crossings that no held-out
            state shows, or only from those of the split's states.
        starts: resets of each task that they begin from.
        wander: passes before a demonstration that weren't tried out, at most.
        led: passes after those, at most, chosen by the clone that training goes on from, so that
            the demonstrator shows what to do where that clone leads a rope.
        budget: actions simulated for a demonstration, at most; what needs more is given up, and is
            no example of what is done at first sight.
        lanes: demonstrations side by side; makes no difference to them.
    """

    episodes: Whole = 0
    task: tuple[str, ...] = ("tie",)
    nx: tuple[Count, ...] = (2,)
    split: Annotated[str, choice("train", "train-code")] = "train"
    every_code: bool = False
    starts: Count = 512
    wander: Whole = 3
    led: Whole = 0
    budget: Count = 400
    lanes: Count = 128


@configuration
class ImproveConfig:
    """How the clone plays to improve.

    Attributes:
        episodes: per task and round.
        temperature: at which macro-actions are drawn.
        share: of each batch that comes from play.
    """

    episodes: Count = 1500
    temperature: NonNegative = 0.5
    share: Share = 0.5


@configuration
class CloneConfig:
    """Settings of a clone's training.

    Attributes:
        action: what is cloned: "macro" for a demonstrator's macro-actions, "bead" for every pull.
        guided: whether the clone also chooses by the counts of passes that ship, which tell what
            leads nearer to the goal, in evaluations and in rounds of improvement.
        start: folder of a trained clone to go on from, of the same width and layers; "" for none.
        blend: share of the weights of `start` in those that training ends with; the mean of both
            is often better than either (Wortsman et al., "Robust fine-tuning", 2022).
        steps: optimizer steps on the data.
        failed: whether to learn from episodes that didn't reach their goal, too.
        demonstrations: to make, beside those in datasets.
        hindsight: macro-actions before a state for which its code counts as a goal; 0 for none.
        copies: of a way to a goal, with the rope's beads numbered from others; each leads to the
            goal's code as it is read from its first bead.
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
        engine: engine that the episodes of datasets must be made with, mujoco or chain.
        seed: seed of all random draws.
        play: how the clone plays.
    """

    action: Annotated[str, choice(*HEADS)] = "macro"
    guided: bool = False
    start: str = ""
    blend: Share = 0.0
    steps: Count = 4000
    failed: bool = False
    demonstrations: DemonstrationsConfig = DemonstrationsConfig()
    hindsight: Whole = 1
    copies: Whole = 3
    improve: Whole = 0
    round_steps: Count = 1000
    batch: Count = 128
    rate: Positive = 1e-3
    decay: NonNegative = 0.05
    average: Annotated[Real, Field(ge=0, lt=1)] = 0.998
    held_out: Annotated[Real, Field(ge=0, lt=1)] = 0.1
    judge_every: Count = 250
    width: Count = 96
    layers: Count = 2
    engine: EngineName = MUJOCO
    seed: Seed = 0
    play: ImproveConfig = ImproveConfig()

    def __post_init__(self) -> None:
        if (self.demonstrations.led or self.blend) and not self.start:
            raise InvalidInput(
                "to blend with a clone, or let it lead to demonstrations, set start to its folder"
            )
        if (self.improve or self.demonstrations.episodes) and self.action != "macro":
            raise InvalidInput(
                "play and demonstrations in the chain engine consist of macro-actions: set action"
                f" = macro, got {self.action!r}"
            )
