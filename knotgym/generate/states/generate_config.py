"""The configuration of `knotgym generate`: which rope states are wanted, and how they are made."""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.control.planner_config import PlannerConfig
from knotgym.drawing.drawn_curve import DrawingConfig
from knotgym.envs.tasks import MAX_NX
from knotgym.generate.states.search import SearchSettings
from knotgym.quality.measures import Limits
from knotgym.topology.diagrams import NotPlanar, is_planar
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import LISTED_NX


class InvalidGenerateConfig(KnotgymError, ValueError):
    """States that cannot be made as asked."""


def check_nx(nx: tuple[int, ...], most: int) -> None:
    """Refuse crossing numbers that repeat or lie outside [0, most].

    Raises:
        InvalidGenerateConfig: they do, or there are none.
    """
    if not nx or any(not 0 <= one <= most for one in nx) or len(set(nx)) != len(nx):
        raise InvalidGenerateConfig(
            f"nx takes different numbers of crossings from 0 to {most}, got"
            f" {', '.join(map(str, nx)) or 'none'}"
        )


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """Which states are wanted, and how they are made.

    Attributes:
        nx: crossing numbers.
        codes: Gauss codes to make instead of all those of `knot`, with or without chirality; `nx`
            must list their crossing numbers.
        count: states for each crossing number, of as many distinct codes as there are.
        every_code: states of every code, instead of count; 0 for count.
        split_by: "state", or "code" for splits that share no code.
        train_share: share of the states (or codes) that are for training.
        knot: the rope's knot: a name of `topology.knot_table.diagram_of`, or a file with a curve.
        demonstrations: find an action sequence to every code and write the demonstrations.
        seed: of everything.
        attempts: drawings for each state wanted of a code before the code is passed over.
        searches: planner searches for a code before it is passed over; each may simulate twice as
            many actions as the one before, the first `planner.budget`.
        cycles: waves of work after which the run ends with what it has; 0 for no limit.
        wave: codes worked on between two checkpoints.
        planned: codes that one wave of the planner searches for.
        batch: drawings of a code in a wave.
        stalled: play ends once a round adds fewer codes than this, and the planner takes over; 0 to
            play on until all are known.
        search: how play searches for codes.
        planner: how the planner searches for the codes that play has not met.
        drawing: how codes are drawn.
        stir: most actions with which a drawing is stirred.
        loop_stir: the same for plain loops, which are all drawn alike.
        force: of such an action, from and to, in units of the largest force.
        rest: actions of no force at the end.
        limits: that accepted states keep.
    """

    nx: tuple[int, ...] = (3,)
    codes: tuple[str, ...] = ()
    count: int = 40
    every_code: int = 0
    split_by: str = "state"
    train_share: float = 0.5
    knot: str = "0_1"
    demonstrations: bool = True
    seed: int = 0
    attempts: int = 100
    searches: int = 6
    cycles: int = 0
    wave: int = 64
    planned: int = 8
    batch: int = 10
    stalled: int = 3
    search: SearchSettings = SearchSettings()
    planner: PlannerConfig = PlannerConfig(budget=400)
    drawing: DrawingConfig = DrawingConfig()
    stir: int = 2
    loop_stir: int = 12
    force: tuple[float, float] = (0.05, 0.3)
    rest: int = 3
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("count", "attempts", "searches", "wave", "planned", "batch", "rest"),
            whole=("every_code", "seed", "cycles", "stalled", "stir", "loop_stir"),
            shares=("train_share",),
            ranges=("force",),
            error=InvalidGenerateConfig,
        )
        check_nx(self.nx, MAX_NX)
        if self.split_by not in ("state", "code"):
            raise InvalidGenerateConfig(
                f'split_by must be "state" or "code", got {self.split_by!r}'
            )
        if self.every_code and max(self.nx) > LISTED_NX and not self.codes:
            raise InvalidGenerateConfig(
                f"the codes of {max(self.nx)} crossings are too many to be listed, so every_code"
                f" takes nx to {LISTED_NX}; give a count"
            )
        for code in self.parsed:
            if not is_planar(code):
                raise NotPlanar(code)
            if code.nx not in self.nx:
                raise InvalidGenerateConfig(
                    f"nx must name the crossings of all codes, got {self.nx} and {str(code)!r}"
                )

    @property
    def parsed(self) -> list[GaussCode]:
        """The codes asked for by name."""
        return [GaussCode.parse(text) for text in self.codes]
