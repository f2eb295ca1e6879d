"""The configurations of `knotgym generate`, and whether a knot allows it, and of `knotgym images`.

The command line reads them first, so nothing here imports the simulator.
"""

from __future__ import annotations

from dataclasses import replace
from pkgutil import resolve_name
from typing import Annotated, Any

from pydantic import Field, NonNegativeInt

from knotgym import topology
from knotgym.common import Count, Distinct, InvalidInput, Seed, Share, choice, configuration
from knotgym.drawing import DrawingConfig
from knotgym.envs import TaskConfig
from knotgym.quality import Limits
from knotgym.rendering import APPEARANCES, AppearanceConfig
from knotgym.rope import ENGINES, MUJOCO, EngineName
from knotgym.states import SOURCES
from knotgym.topology import LISTED_NX, UNKNOT, GaussCode, Knot

_BEADS = 100  # of the rope that demonstrations are made with
# Settings that states taken from ropes need.
_OF_ROPES = {"every_code": 0, "knot": UNKNOT, "codes": (), "beads": _BEADS}
# Drawings of one code resemble each other: beyond so many, most are refused as near duplicates.
_DRAWN = 20
_Listed = Annotated[int, Field(ge=0, le=LISTED_NX)]


@configuration
class PlayConfig:
    """The pulls of ropes that states are taken from.

    A rope starts as a coil, as in the published model. After `settle` random pulls it is laid at
    rest, and its record begins. Then come as many pulls of each phase as the fields say.

    Attributes:
        settle: random pulls before the record begins; 0 to record from the coil on.
        random: uniform random actions.
        opening: pulls of random beads away from the rope's middle, which untie and smooth it.
        rounds: how often the next two phases are repeated.
        scripted: pulls of random macro-actions, which pass strands over and under each other.
        spreading: pulls of beads away from the strands near them in the picture.
        first: pulls of the record before the first frame is examined.
        every: pulls between frames.
        per_rope: most states of a rope and crossing number: the longer a rope is pulled, the more
            its frames resemble each other.
        ropes: ropes side by side, in one unit of work.
    """

    settle: NonNegativeInt = 300
    random: NonNegativeInt = 0
    opening: NonNegativeInt = 60
    rounds: NonNegativeInt = 3
    scripted: NonNegativeInt = 20
    spreading: NonNegativeInt = 10
    first: NonNegativeInt = 5
    every: Count = 5
    per_rope: Count = 2
    ropes: Count = 128

    @property
    def pulls(self) -> int:
        """Pulls of a record."""
        return self.random + self.opening + self.rounds * (self.scripted + self.spreading)


# The published regime: uniform actions until the rope's distribution no longer depends on its start
# (`benchmarks/stationary.py` at 92001d60: walks from the coil and from the plain loop converge).
PUBLISHED = PlayConfig(
    settle=0, random=900, opening=0, rounds=0, first=300, every=25, per_rope=1, ropes=16
)


@configuration
class GenerateConfig:
    """Which states to make, and how.

    Attributes:
        nx: numbers of crossings: 3, 2,3 or 0-4.
        count: states per number of crossings, spread over as many Gauss codes as possible.
        source: "drawing": draw states from their Gauss codes; "play": take readable states from
            ropes that random and scripted policies pull; "random-walk": take states as uniform
            random actions reach them, readable or not; "auto": play for each nx with so few codes
            that more than 20 states of each are asked for, else drawing. Play and random-walk leave
            out over-twisted states, and their splits share no rope.
        every_code: instead of --count: number of states for every existing Gauss code.
        train_share: share of states or ropes in the train split.
        knot: knot type of the rope: 0_1, a prime knot of up to 10 crossings (8_19), a mirror image
            (m3_1) or a sum (3_1#4_1).
        codes: Gauss codes to use instead of all those of `knot`, with or without chirality; `nx`
            must list their crossing numbers.
        demonstrations: roll out the expert to the code of every state, and write these episodes as
            a Minari dataset; up to 6 crossings.
        attempts: drawings of a code per missing state since its last one was found, or ropes per
            requested state, before the run gives up.
        demonstration_attempts: rollouts per state before it stays without a demonstration; the
            later ones start elsewhere and use the planner.
        seed: random seed; the same seed gives the same bytes.
        engine: simulation engine: mujoco, the reference; chain, which is many times as fast; or
            auto, chain where states are taken by play and mujoco elsewhere.
        beads: number of beads of the rope, each 13.3 mm long; other numbers than 100 take source
            drawing without demonstrations. More crossings than 11 need more beads.
        drawing: settings of the curves of source drawing.
        play: settings of source play.
        walk: settings of source random-walk.
        limits: limits that make a state readable; source random-walk has none.
        twist: limits that leave out over-twisted states; source drawing has none.
    """

    nx: Annotated[tuple[NonNegativeInt, ...], Distinct] = (3,)
    count: Count = 40
    source: str = "auto"
    every_code: NonNegativeInt = 0
    train_share: Share = 0.5
    knot: str = UNKNOT
    codes: tuple[str, ...] = ()
    demonstrations: bool = True
    attempts: Count = 100
    demonstration_attempts: Count = 8
    seed: Seed = 0
    engine: Annotated[str, choice("auto", growing=ENGINES)] = "auto"
    beads: Annotated[int, Field(ge=TaskConfig.BEADS.start, le=TaskConfig.BEADS[-1])] = _BEADS
    drawing: DrawingConfig = DrawingConfig()
    play: PlayConfig = PlayConfig()
    walk: PlayConfig = PUBLISHED
    limits: Limits = Limits()
    twist: Limits = Limits.UNTWISTED

    def __post_init__(self) -> None:
        known = "auto", *(name for name, source in SOURCES.items() if source.rows)
        if self.source not in known:
            raise InvalidInput(f"source must be one of {', '.join(known)}, got {self.source!r}")
        if self.source in SOURCES and SOURCES[self.source].from_ropes:
            self._require_ropes()
        if max(self.nx) > (most := TaskConfig.most_nx(self.beads)):
            raise InvalidInput(f"nx must be from 0 to {most}, got {max(self.nx)}")
        if self.beads != _BEADS and self.demonstrations:
            raise InvalidInput(
                f"demonstrations are for a rope of {_BEADS} beads, got {self.beads};"
                " leave them out: --no-demonstrations"
            )
        if self.every_code and max(self.nx) > LISTED_NX and not self.codes:
            raise InvalidInput(
                f"there are too many codes with {max(self.nx)} crossings to list, so every_code"
                f" takes nx up to {LISTED_NX}; give a count"
            )
        for code in self.parsed:
            topology.with_chirality(code)
            if code.nx not in self.nx:
                raise InvalidInput(
                    f"nx must include the crossings of all codes, got {self.nx} and {str(code)!r}"
                )
        self._require_knot()

    def _require_ropes(self) -> None:
        """Require what states taken from ropes allow."""
        for name, value in _OF_ROPES.items():
            if getattr(self, name) != value:
                dashed = name.replace("_", "-")
                raise InvalidInput(f"--{dashed} needs --source drawing, not {self.source}")
        if max(self.nx) > LISTED_NX:
            raise InvalidInput(f"{self.source} takes nx up to {LISTED_NX}, got {max(self.nx)}")

    def _require_knot(self) -> None:
        """Require crossing numbers and codes that the knot can show, and that can be reached."""
        least = Knot(self.knot).diagram.nx
        for nx in self.nx:
            if nx < least:
                raise InvalidInput(f"{self.knot} has at least {least} crossings, got nx {nx}")
            if self.demonstrations and nx > max(LISTED_NX, least):
                raise InvalidInput(
                    f"demonstrations are limited to {LISTED_NX} crossings, got nx {nx};"
                    " --no-demonstrations makes states without them"
                )
        for code in self.parsed:
            if not Knot(self.knot).is_shown_by(code):
                seen = topology.knot_type(code)
                is_hand = seen == Knot(self.knot).type
                advice = " (handedness differs)" if is_hand else f"; add --knot {seen}"
                raise InvalidInput(
                    f"the code {str(code)!r} shows the knot {seen}, not {self.knot}{advice}"
                )

    @property
    def engine_used(self) -> str:
        """The engine that `engine` stands for: that of the sources, the faster of several."""
        if self.engine in ENGINES:
            return self.engine
        engines = (SOURCES[name].engine for name, _ in self._sources)
        return max(engines, key=lambda name: ENGINES[name].together, default=MUJOCO)

    @property
    def _sources(self) -> list[tuple[str, tuple[int, ...]]]:
        """The sources that are used, and for which numbers of crossings."""
        if self.source in SOURCES:
            return [(self.source, self.nx)]
        special = any(getattr(self, name) != value for name, value in _OF_ROPES.items())
        few = [nx for nx in self.nx if nx <= LISTED_NX and not special]
        played = [nx for nx in few if self.count > _DRAWN * len(topology.codes_of(UNKNOT, nx))]
        drawn = [nx for nx in self.nx if nx not in played]
        return [(name, tuple(nx)) for name, nx in (("play", played), ("drawing", drawn)) if nx]

    @property
    def parts(self) -> list[GenerateConfig]:
        """The configuration of each source; itself, unless the source is auto."""
        if self.source in SOURCES:
            return [self]
        engine = self.engine_used
        return [replace(self, source=name, nx=nx, engine=engine) for name, nx in self._sources]

    @property
    def parsed(self) -> list[GaussCode]:
        """The requested codes, parsed."""
        return [GaussCode.parse(text) for text in self.codes]


@configuration
class ImagesConfig:
    """Which pictures to make.

    Attributes:
        nx: numbers of crossings: 3, 2,3 or 0-4; of several, the largest is in split test-nx alone,
            unless --set test_nx=none.
        count: total pictures, spread evenly over the numbers of crossings.
        test_nx: crossing numbers held out for split "test-nx", larger than all others; empty for
            the largest if there are several, none to hold none out.
        test_share: share of pictures in split test. Held-out crossing numbers don't count.
        code_share: share of pictures in split test-code, and of Gauss codes held out for it; of
            diagrams, where pictures don't mark where and in which direction the code is read. None
            are held out for nx with fewer than 4.
        seed: random seed; the same seed gives the same bytes.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
        policies: policies of the rollouts, in turn; each gives equally many.
        pulls: pulls of a rollout.
        stride: pulls between two frames of it.
        limits: limits of frames that may be shown.
        extreme: maximum share of pictures of grade extreme, of those of a split with as many
            crossings.
        appearance: what varies between pictures.
        rows_per_file: pictures per file of the table.
        ropes: rollouts computed together.
        most_ropes: maximum number of rollouts between two looks at what is still missing.
        idle: the run gives up after this many looks without a new picture.
    """

    nx: Annotated[tuple[_Listed, ...], Distinct] = (0, 1, 2, 3, 4)
    count: Count = 20_000
    test_nx: tuple[NonNegativeInt, ...] | None = ()
    test_share: Share = 0.15
    code_share: Share = 0.15
    seed: Seed = 0
    engine: EngineName = MUJOCO
    policies: tuple[str, ...] = ("random", "scripted")
    pulls: Count = 12
    stride: Count = 2
    limits: Limits = Limits.UNAMBIGUOUS
    extreme: Share = 0.3
    appearance: AppearanceConfig = AppearanceConfig()
    rows_per_file: Count = 500
    ropes: Count = 64
    most_ropes: Count = 32_768
    idle: Count = 6

    def __post_init__(self) -> None:
        if self.test_nx == () and len(self.nx) > 1:
            object.__setattr__(self, "test_nx", (max(self.nx),))
        rest = self.trained
        if (
            not set(self.held_nx) <= set(self.nx)
            or not rest
            or min(self.held_nx, default=LISTED_NX + 1) <= max(rest)
        ):
            raise InvalidInput(
                f"test-nx takes the largest of the requested nx, {sorted(self.nx)}, but not all of"
                f" them; got {sorted(self.held_nx)}"
            )
        if self.stride > self.pulls:
            raise InvalidInput(f"stride must be at most pulls, {self.pulls}, got {self.stride}")
        if not self.policies:
            raise InvalidInput("policies must name at least one policy")
        if not self.test_share + self.code_share < 1:
            both = f"{self.test_share} and {self.code_share}"
            raise InvalidInput(f"test and code shares must be below 1 together, got {both}")

    @property
    def marked(self) -> bool:
        """Whether every picture marks the base bead and the direction; see `states.held_form`."""
        marks = APPEARANCES[self.appearance.name].marks
        return len(marks) == 2 and "colours" not in self.appearance.vary

    @property
    def held_nx(self) -> tuple[int, ...]:
        """The crossing numbers of split "test-nx"."""
        return self.test_nx or ()

    @property
    def trained(self) -> tuple[int, ...]:
        """The crossing numbers of the other splits."""
        return tuple(nx for nx in self.nx if nx not in self.held_nx)

    def pictured(self, number: int, count: int, seed: int) -> Any:
        """Make a block of pictures for split train, a pyarrow.Table, by its number and the seed.

        What this configuration holds out for the other splits is held out.
        """
        # by its name, as it imports this module
        block = resolve_name("knotgym.generate.image_recipe:picture_block")
        return block(self, number, count, seed)
