"""Settings of the clone's training; no torch here, because the command line reads them."""

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import InvalidInput
from knotgym.rope.engines import MUJOCO, require_engine

HEADS = ("macro", "bead")


@dataclass(frozen=True, kw_only=True)
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

    episodes: int = 0
    task: tuple[str, ...] = ("tie",)
    nx: tuple[int, ...] = (2,)
    split: str = "train"
    every_code: bool = False
    starts: int = 512
    wander: int = 3
    led: int = 0
    budget: int = 400
    lanes: int = 128

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("starts", "budget", "lanes"),
            whole=("episodes", "wander", "led"),
            error=InvalidInput,
        )
        if self.split not in ("train", "train-code"):
            raise InvalidInput(
                f"a clone learns from train or train-code, got the split {self.split!r}"
            )


@dataclass(frozen=True, kw_only=True)
class ImproveConfig:
    """How the clone plays to improve.

    Attributes:
        episodes: per task and round.
        temperature: at which macro-actions are drawn.
        share: of each batch that comes from play.
    """

    episodes: int = 1500
    temperature: float = 0.5
    share: float = 0.5

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("episodes",),
            non_negative=("temperature",),
            shares=("share",),
            error=InvalidInput,
        )


@dataclass(frozen=True, kw_only=True)
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

    action: str = "macro"
    guided: bool = False
    start: str = ""
    blend: float = 0.0
    steps: int = 4000
    failed: bool = False
    demonstrations: DemonstrationsConfig = DemonstrationsConfig()
    hindsight: int = 1
    copies: int = 3
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
    engine: str = MUJOCO
    seed: int = 0
    play: ImproveConfig = ImproveConfig()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("steps", "round_steps", "batch", "judge_every", "width", "layers"),
            whole=("seed", "improve", "hindsight", "copies"),
            positive=("rate",),
            non_negative=("decay", "average", "held_out"),
            shares=("blend",),
            error=InvalidInput,
        )
        require_engine(self.engine)
        if self.action not in HEADS:
            raise InvalidInput(f"action must be {' or '.join(HEADS)}, got {self.action!r}")
        for name in ("average", "held_out"):
            if getattr(self, name) >= 1:
                raise InvalidInput(f"{name} must be below 1, got {getattr(self, name)}")
        if (self.demonstrations.led or self.blend) and not self.start:
            raise InvalidInput(
                "to blend with a clone, or let it lead to demonstrations, set start to its folder"
            )
        if (self.improve or self.demonstrations.episodes) and self.action != "macro":
            raise InvalidInput(
                "play and demonstrations in the chain engine consist of macro-actions: set action"
                f" = macro, got {self.action!r}"
            )
