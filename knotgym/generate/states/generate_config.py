"""The configuration of `knotgym generate`, and whether a knot allows it."""

from typing import Annotated

from pydantic import Field

from knotgym.common.configuration import (
    Count,
    Crossings,
    Int,
    Interval,
    Seed,
    Share,
    Whole,
    choice,
    configuration,
)
from knotgym.common.errors import InvalidInput
from knotgym.control.planner_config import PlannerConfig
from knotgym.drawing.drawing_config import DrawingConfig
from knotgym.envs.tasks import MAX_BEADS, MIN_BEADS, max_nx
from knotgym.generate.states.search import SearchSettings
from knotgym.quality.measures import Limits
from knotgym.rope.engines import MUJOCO, EngineName
from knotgym.rope.model import RopeConfig, rope_of
from knotgym.topology.diagrams import is_planar, not_planar
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import diagram_of, type_of
from knotgym.topology.knots import LISTED_NX, knot_type, shows


@configuration
class GenerateConfig:
    """Which states to make, and how.

    Attributes:
        nx: numbers of crossings: 3, 2,3 or 0-4.
        codes: Gauss codes to use instead of all those of `knot`, with or without chirality; `nx`
            must list their crossing numbers.
        count: states per number of crossings, spread over as many Gauss codes as possible.
        every_code: instead of --count: number of states for every existing Gauss code.
        split_by: "state" or "code"; with "code", train and test share no Gauss code.
        train_share: share of states (or codes) in the train split.
        knot: knot type of the rope: 0_1, a prime knot of up to 10 crossings (8_19), a mirror image
            (m3_1) or a sum (3_1#4_1); or a file with a closed curve, as .npy or three numbers per
            line, from which action sequences start.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
        beads: number of beads of the rope, each 13.3 mm long; other numbers than 100 take source
            drawing without demonstrations. More crossings than 11 need more beads.
        demonstrations: search for an action sequence that reaches the Gauss code of every state,
            and write the sequences as Minari datasets; up to 6 crossings.
        seed: random seed; the same seed gives the same bytes.
        attempts: drawings per requested state before a Gauss code is skipped; with random-walk,
            walks per requested state.
        searches: searches for a code before it is skipped; the planner has the budget
            `planner.budget` in the first and twice that of the one before in each further one, and
            before it plans, the demonstrator leads ropes from twice as many states.
        cycles: stop after this many rounds of work and keep the states made; 0 for no limit.
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

    nx: Crossings = (3,)
    codes: tuple[str, ...] = ()
    count: Count = 40
    every_code: Whole = 0
    split_by: Annotated[str, choice("state", "code")] = "state"
    train_share: Share = 0.5
    knot: str = "0_1"
    engine: EngineName = MUJOCO
    beads: Annotated[Int, Field(ge=MIN_BEADS, le=MAX_BEADS)] = 100
    demonstrations: bool = True
    seed: Seed = 0
    attempts: Count = 100
    searches: Count = 8
    cycles: Whole = 0
    wave: Count = 64
    planned: Count = 8
    batch: Count = 10
    stalled: Whole = 3
    search: SearchSettings = SearchSettings()
    planner: PlannerConfig = PlannerConfig(budget=400)
    drawing: DrawingConfig = DrawingConfig()
    stir: Whole = 2
    loop_stir: Whole = 32
    force: Interval = (0.05, 0.3)
    rest: Count = 3
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        if not MIN_BEADS <= self.beads <= MAX_BEADS:
            raise InvalidInput(f"beads must be from {MIN_BEADS} to {MAX_BEADS}, got {self.beads}")
        if self.beads != RopeConfig().beads and self.demonstrations:
            raise InvalidInput(
                f"demonstrations are for a rope of {RopeConfig().beads} beads, got {self.beads};"
                " leave them out: --no-demonstrations"
            )
        if max(self.nx) > max_nx(self.beads):
            raise InvalidInput(
                f"nx takes numbers of crossings from 0 to {max_nx(self.beads)}, got {max(self.nx)}"
            )
        if self.every_code and max(self.nx) > LISTED_NX and not self.codes:
            raise InvalidInput(
                f"there are too many codes with {max(self.nx)} crossings to list, so every_code"
                f" takes nx up to {LISTED_NX}; give a count"
            )
        for code in self.parsed:
            if not is_planar(code):
                raise not_planar(code)
            if code.nx not in self.nx:
                raise InvalidInput(
                    f"nx must include the crossings of all codes, got {self.nx} and {str(code)!r}"
                )

    @property
    def rope(self) -> RopeConfig:
        """The rope."""
        return rope_of(self.beads)

    @property
    def parsed(self) -> list[GaussCode]:
        """The requested codes, parsed."""
        return [GaussCode.parse(text) for text in self.codes]


def is_tabled(knot: str) -> bool:
    """Whether the knot table has a knot of this name."""
    try:
        diagram_of(knot)
    except InvalidInput:
        return False
    return True


def require_possible(config: GenerateConfig, knot: str) -> None:
    """Require crossing numbers and codes that the knot can show, and sequences within reach."""
    least = diagram_of(knot).nx
    for nx in config.nx:
        if nx < least:
            raise InvalidInput(
                f"no diagram of {config.knot} has {nx} crossings; it has at least {least}"
            )
        if config.demonstrations and nx > max(LISTED_NX, least):
            raise InvalidInput(
                f"action sequences are limited to {LISTED_NX} crossings, got nx {nx};"
                " --no-demonstrations makes states without them"
            )
    for code in config.parsed:
        if not shows(code, knot):
            seen = knot_type(code)
            other_hand = " (handedness differs)" if seen == type_of(knot) else ""
            raise InvalidInput(
                f"the code {str(code)!r} shows the knot {seen}, not {config.knot}{other_hand}"
            )
