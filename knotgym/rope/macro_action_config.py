"""Settings of macro-actions; nothing here computes, because the command line reads them."""

from typing import Annotated

from knotgym.common.configuration import (
    Count,
    Interval,
    NonNegative,
    Ordered,
    Positive,
    Whole,
    configuration,
)
from knotgym.common.errors import InvalidInput

KINDS = ("pass", "curl", "spread", "shift")


@configuration
class MacroActionConfig:
    """How macro-actions are drawn and carried out.

    Attributes:
        shares: probabilities of KINDS in random draws, up to a factor.
        arrived: distance in metres at which a waypoint counts as reached.
        stride: metres that a step at full force moves a bead, roughly; the force is reduced in
            proportion when the waypoint is nearer.
        lift: height in metres above or below a strand at which a bead passes it, or by which it is
            raised or lowered in a shift.
        rise: horizontal distance in metres within which a bead reaches that height.
        distance: range of the length of a spread or shift, metres.
        spread_angle: standard deviation of the heading of a spread, radians.
        pass_angle: standard deviation of the heading of a pass or curl, radians.
        beyond: range of the distance past the strand at which a pass or curl ends, metres.
        straight_lift: as `lift`, of a pass without chance.
        straight_beyond: distance past the strand at which a pass without chance ends, metres.
        farthest: longest distance to a strand that a pass covers, metres; a strand farther away
            isn't reached.
        pass_apart: fewest beads along the rope between a bead and the strand it passes.
        curl_apart: range of that number for a curl, both ends included.
    """

    # `stride` is about what is measured: at full force the pulled bead moves by 48 mm in an action
    # on average. The others were set by hand when play made the states (2026), and no record says
    # what other values gave. A change needs the table of moves made again (`benchmarks/moves.py`),
    # and `expert` and `planner` must succeed as often as docs/benchmark.md says.
    shares: tuple[float, float, float, float] = (0.4, 0.25, 0.1, 0.25)
    arrived: Positive = 0.012
    stride: Positive = 0.045
    lift: NonNegative = 0.03
    rise: NonNegative = 0.03
    distance: Interval = (0.03, 0.2)
    spread_angle: NonNegative = 0.5
    pass_angle: NonNegative = 0.3
    beyond: Interval = (0.02, 0.09)
    straight_lift: NonNegative = 0.06
    straight_beyond: NonNegative = 0.1
    farthest: Positive = 0.3
    pass_apart: Count = 12
    curl_apart: Annotated[tuple[Whole, Whole], Ordered] = (6, 24)

    @property
    def straight(self) -> tuple[float, float, float, float]:
        """The sizes of a pass without chance: rise, farthest, lift and beyond."""
        return self.rise, self.farthest, self.straight_lift, self.straight_beyond

    def __post_init__(self) -> None:
        if len(self.shares) != len(KINDS) or min(self.shares) < 0 or not sum(self.shares) > 0:
            raise InvalidInput(
                f"shares must be {len(KINDS)} numbers of at least 0, not all 0, for"
                f" {', '.join(KINDS)}; got {self.shares}"
            )
