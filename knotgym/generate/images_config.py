"""The configuration of `knotgym images`."""

from pkgutil import resolve_name
from typing import Annotated, Any

from pydantic import Field, NonNegativeInt, PositiveInt

from knotgym.common import Distinct, InvalidInput, Seed, Share, configuration
from knotgym.quality import Limits
from knotgym.rendering import APPEARANCES, AppearanceConfig
from knotgym.rope import MUJOCO, EngineName
from knotgym.topology import LISTED_NX

_Listed = Annotated[int, Field(ge=0, le=LISTED_NX)]


@configuration
class ImagesConfig:
    """Which pictures to make.

    Attributes:
        nx: numbers of crossings: 3, 2,3 or 0-4.
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
    count: PositiveInt = 20_000
    test_nx: tuple[NonNegativeInt, ...] | None = ()
    test_share: Share = 0.15
    code_share: Share = 0.15
    seed: Seed = 0
    engine: EngineName = MUJOCO
    policies: tuple[str, ...] = ("random", "scripted")
    pulls: PositiveInt = 12
    stride: PositiveInt = 2
    limits: Limits = Limits.UNAMBIGUOUS
    extreme: Share = 0.3
    appearance: AppearanceConfig = AppearanceConfig()
    rows_per_file: PositiveInt = 500
    ropes: PositiveInt = 64
    most_ropes: PositiveInt = 32_768
    idle: PositiveInt = 6

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
