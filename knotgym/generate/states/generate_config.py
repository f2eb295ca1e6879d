"""The configuration of `knotgym generate`."""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.control.planner_config import PlannerConfig
from knotgym.drawing.drawn_curve import DrawingConfig
from knotgym.envs.tasks import MAX_NX
from knotgym.generate.states.search import SearchSettings
from knotgym.quality.measures import Limits
from knotgym.rope.engines import MUJOCO, require_engine
from knotgym.topology.diagrams import NotPlanar, is_planar
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import LISTED_NX


class InvalidGenerateConfig(KnotgymError, ValueError):
    """The requested states can't be made."""


def check_nx(nx: tuple[int, ...], most: int) -> None:
    """Require distinct crossing numbers in [0, most].

    Raises:
        InvalidGenerateConfig: they are not, or there are none.
    """
    if not nx or any(not 0 <= one <= most for one in nx) or len(set(nx)) != len(nx):
        raise InvalidGenerateConfig(
            f"nx takes distinct numbers of crossings from 0 to {most}, got"
            f" {', '.join(map(str, nx)) or 'none'}"
        )


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """Which states to make, and how.

    Attributes:
        nx: crossing numbers.
        codes: Gauss codes to use instead of all those of `knot`, with or without chirality; `nx`
            must list their crossing numbers.
        count: states per crossing number, spread over as many Gauss codes as possible.
        every_code: number of states for every code, instead of `count`; 0 to use `count`.
        split_by: "state", or "code" for splits that share no code.
        train_share: share of states (or codes) in the train split.
        knot: the rope's knot: a name of `topology.knot_table.diagram_of`, or a file with a curve.
        engine: the engine of every simulation, see `knotgym.rope.engines`.
        demonstrations: whether to find an action sequence to every code and write demonstrations.
        seed: random seed of the run.
        attempts: drawings per requested state of a code before the code is skipped.
        searches: planner searches for a code before it is skipped; the first has the budget
            `planner.budget`, each further one twice that of the one before.
        cycles: waves of work after which the run ends with the states it has; 0 for no limit.
        wave: maximum number of units of work in a wave.
        planned: codes that the planner searches for in one wave.
        batch: drawings of a code in one wave.
        stalled: play ends after a round that adds fewer codes than this, and the planner takes
            over; 0 to play until all codes are known.
        search: settings of play.
        planner: settings of the planner.
        drawing: settings of the drawings.
        stir: maximum number of random actions that stir a drawing.
        loop_stir: the same with at most 1 crossing, where there is but one diagram of states.
        force: minimum and maximum force of these actions, relative to the largest force.
        rest: number of actions without force at the end.
        limits: quality limits of accepted states.
    """

    nx: tuple[int, ...] = (3,)
    codes: tuple[str, ...] = ()
    count: int = 40
    every_code: int = 0
    split_by: str = "state"
    train_share: float = 0.5
    knot: str = "0_1"
    engine: str = MUJOCO
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
    loop_stir: int = 32
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
        require_engine(self.engine)
        if self.split_by not in ("state", "code"):
            raise InvalidGenerateConfig(
                f'split_by must be "state" or "code", got {self.split_by!r}'
            )
        if self.every_code and max(self.nx) > LISTED_NX and not self.codes:
            raise InvalidGenerateConfig(
                f"there are too many codes with {max(self.nx)} crossings to list, so every_code"
                f" takes nx up to {LISTED_NX}; give a count"
            )
        for code in self.parsed:
            if not is_planar(code):
                raise NotPlanar(code)
            if code.nx not in self.nx:
                raise InvalidGenerateConfig(
                    f"nx must include the crossings of all codes, got {self.nx} and {str(code)!r}"
                )

    @property
    def parsed(self) -> list[GaussCode]:
        """The requested codes, parsed."""
        return [GaussCode.parse(text) for text in self.codes]
