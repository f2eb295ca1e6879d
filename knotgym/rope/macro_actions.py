"""Macro-actions: lead one bead past three waypoints, in a few steps and without a goal.

One step moves the bead by three to five centimetres. There are four kinds: `pass` leads the bead
over or under another strand, `curl` over or under a strand close to it along the rope (which makes
or undoes a kink), `spread` away from the rope's middle, and `shift` in any direction.

A haul pulls two beads apart with full force, one in even and one in odd steps. It ignores strands
and codes, and undoes tangles in which every small change makes things worse.

After a change run `pytest tests/rope/test_macro_actions.py tests/control/planning`: draws come in a
fixed order, and passes must lead where the table of moves says.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, kernel
from knotgym.rope.actions import FORCE_BINS, quantized

_WAYPOINTS = 3  # per macro-action, see `_waypoints`
KINDS = ("pass", "curl", "spread", "shift")

# _STRIDE is about what is measured: at full force the pulled bead moves by 48 mm in an action on
# average. The others were set by hand when play made the states (2026). A change needs the table of
# moves made again (`benchmarks/moves.py`), and `expert` and `planner` must succeed as often as
# docs/benchmark.md says. Lengths are in metres, angles in radians.
_CUMULATIVE = np.cumsum((0.4, 0.25, 0.1, 0.25))  # probabilities of KINDS, summed up
_ARRIVED = 0.012  # distance at which a waypoint counts as reached
_STRIDE = 0.045  # what a step at full force moves a bead; it is less if the waypoint is nearer
LIFT = 0.03  # height above or below a strand at which a bead passes it, or by which a shift rises
RISE = 0.03  # horizontal distance within which a bead reaches that height
_DISTANCE = 0.03, 0.2  # range of the length of a spread or shift
_SPREAD_ANGLE, _PASS_ANGLE = 0.5, 0.3  # standard deviation of the heading of a spread; pass or curl
_BEYOND = 0.02, 0.09  # range of the distance past the strand at which a pass or curl ends
STRAIGHT_LIFT, _STRAIGHT_BEYOND = 0.06, 0.1  # the same two, of a pass without chance
_FARTHEST = 0.3  # longest distance to a strand that a pass covers; one farther away isn't reached
_CLOSE = 8  # fewest beads along the rope between the two of a pass that is drawn
_PASS_APART = 12  # fewest beads along the rope between a bead and the strand it passes
_CURL_APART = 6, 24  # range of that number for a curl, both ends included

# Hauls were introduced for hard unknots, of which no planner without them solved any of 64
# (notes/hard-unknots.md); their sizes were not compared.
_HAUL_RISE = -0.2, 0.6  # range of the upward force, in units of the largest force
_HAUL_STEPS = 4, 20  # range of its length for 100 beads; the upper end is excluded


class Pass(NamedTuple):
    """A macro-action without chance: lead `bead` over (+1) or under (-1) the bead `target`."""

    bead: int
    target: int
    side: int

    @classmethod
    def drawn(cls, beads: int, rng: np.random.Generator) -> "Pass":
        """Draw a pass over or under any bead that isn't close along a rope of so many beads."""
        bead, apart = int(rng.integers(beads)), int(rng.integers(_CLOSE, beads - _CLOSE + 1))
        return cls(bead, (bead + apart) % beads, (-1, 1)[int(rng.integers(2))])


@dataclass(frozen=True)
class MacroAction:
    """Lead a bead past waypoints.

    Attributes:
        bead: the bead to lead.
        waypoints: float64 (3, 3), metres, world frame.
        target: bead of the strand to pass, -1 if there is none.
        side: +1 over or upwards, -1 under or downwards, 0 for neither.
    """

    bead: int
    waypoints: Array
    target: int = -1
    side: int = 0

    @classmethod
    def drawn(cls, points: Array, rng: np.random.Generator) -> "MacroAction":
        """Draw a macro-action at random.

        Args:
            points: float64 (beads, 3), metres.
            rng: source of all draws.
        """
        # Draws come in this order whatever the kind: another would change every seeded run.
        beads = len(points)
        kind = KINDS[int(_CUMULATIVE.searchsorted(rng.random(), side="right"))]
        bead = int(rng.integers(beads))
        side = (-1, 1)[rng.integers(2)]
        if kind == "curl":
            least, most = _CURL_APART  # either way along the rope
            apart = int(rng.integers(least, most + 1)) * (-1, 1)[rng.integers(2)]
        elif kind == "pass":
            # at least so many from the bead in both directions round the loop
            apart = int(rng.integers(_PASS_APART, beads - _PASS_APART))
        else:
            return _aside(points, kind, bead, side, rng)
        return cls.passing(points, Pass(bead, (bead + apart) % beads, side), rng)

    @classmethod
    def passing(cls, points: Array, move: Pass, rng: np.random.Generator) -> "MacroAction":
        """Lead a bead over or under its target and a little beyond it, by chance."""
        turn, beyond = rng.normal(0, _PASS_ANGLE), rng.uniform(*_BEYOND)
        offset = points[move.target, :2] - points[move.bead, :2]
        # a strand farther away than that is approached without being passed
        far = min(float(np.hypot(*offset)), _FARTHEST)
        heading = math.atan2(offset[1], offset[0]) + turn
        # relative to the strand to pass, not to the bead
        height = points[move.target, 2] + move.side * LIFT
        waypoints = _waypoints(points, move.bead, heading, height, far, beyond)
        return cls(move.bead, waypoints, move.target, move.side)


@dataclass(frozen=True, eq=False)
class Haul:
    """Pull two beads apart, in turn.

    Attributes:
        beads: the beads pulled in even and in odd steps.
        force: float64 (3,), force of even steps in units of the largest force; in odd steps its
            horizontal part is reversed.
        steps: number of steps.
    """

    beads: tuple[int, int]
    force: Array
    steps: int

    def pull(self, step: int) -> tuple[int, Array]:
        """Return the bead to pull in a step, and the force, float64 (3,)."""
        return self.beads[step % 2], self.force * ((1, 1, 1), (-1, -1, 1))[step % 2]

    @classmethod
    def drawn(cls, beads: int, rng: np.random.Generator) -> "Haul":
        """Draw a haul of two beads that are at least a fifth of the rope apart.

        A rope of 200 beads is hauled for twice as many steps as one of 100.
        """
        first, apart = int(rng.integers(beads)), int(rng.integers(beads // 5, beads - beads // 5))
        # horizontal part of length 1 plus a rise: each component is in [-1, 1], as in an action
        heading, rise = rng.uniform(-np.pi, np.pi), rng.uniform(*_HAUL_RISE)
        force = quantized([np.cos(heading), np.sin(heading), rise])
        fewest, most = (steps * beads // 100 for steps in _HAUL_STEPS)
        return cls((first, (first + apart) % beads), force, int(rng.integers(fewest, most)))


def _aside(points: Array, kind: str, bead: int, side: int, rng: np.random.Generator) -> MacroAction:
    """Lead a bead away from the rope's middle ("spread"), or in a random direction ("shift").

    A shift is raised (side +1) or lowered (-1) by LIFT; a spread stays at its height.
    """
    offset = points[bead, :2] - points[:, :2].mean(axis=0)  # seen from above, as codes are
    height = points[bead, 2]
    if kind == "spread":
        side = 0  # whatever was drawn: the bead stays at its height
        heading = math.atan2(offset[1], offset[0]) + rng.normal(0, _SPREAD_ANGLE)
    else:  # a shift heads anywhere, above or below what lies in its way
        height = height + side * LIFT
        heading = rng.uniform(-np.pi, np.pi)
    far = rng.uniform(*_DISTANCE)
    waypoints = _waypoints(points, bead, heading, height, far)
    return MacroAction(bead, waypoints, side=side)


def _waypoints(
    points: Array, bead: int, heading: float, height: float, far: float, beyond: float = 0.0
) -> Array:
    """Waypoints of a straight walk, float64 (3, 3): up or down, across, and back to rope level.

    Seen from the side, for a bead that passes over a strand at o:

        height      1---------2
                   /     o    |
        level   bead          3

    Args:
        points: float64 (beads, 3), metres.
        bead: the bead to lead.
        heading: direction of the walk, radians from the x axis.
        height: z of the first two waypoints, metres.
        far, beyond: horizontal distance to what is passed, and from there to the other two, metres.
    """
    rise, reach = min(RISE, far), far + beyond
    # plain floats: this runs for every candidate, and NumPy is slow on single numbers
    x, y, _ = points[bead].tolist()
    ahead_x, ahead_y = float(np.cos(heading)), float(np.sin(heading))
    end_x, end_y = x + ahead_x * reach, y + ahead_y * reach
    level = points[:, 2].sum() / len(points)
    return np.array(
        [
            [x + ahead_x * rise, y + ahead_y * rise, height],
            [end_x, end_y, height],
            [end_x, end_y, level],
        ]
    )


class WaypointFollower:
    """Carries out a macro-action on each of n ropes, pull by pull, in compiled code.

    Every method takes the indices of the ropes that it is about, and treats each by itself.

    Attributes:
        beads: int64 (n,), the bead to pull on each rope.
    """

    ARRIVED, STRIDE = _ARRIVED, _STRIDE

    def __init__(self, count: int) -> None:
        self.beads = np.zeros(count, dtype=np.int64)
        self._waypoints = np.zeros((count, _WAYPOINTS, 3))
        self._stage = np.full(count, _WAYPOINTS)  # index of the next waypoint; past the end if idle

    @property
    def idle(self) -> NDArray[np.bool_]:
        """Which ropes have no waypoint left, bool (n,)."""
        return np.asarray(self._stage >= _WAYPOINTS)

    def begin(self, ids: NDArray[np.int64], moves: Sequence[MacroAction]) -> None:
        """Start macro-actions, one a rope."""
        self.beads[ids] = [move.bead for move in moves]
        self._waypoints[ids] = [move.waypoints for move in moves]
        self._stage[ids] = 0

    def begin_passes(self, ids: NDArray[np.int64], passes: ArrayLike, points: Array) -> None:
        """Start passes without chance, see `_straight`.

        Args:
            ids: the ropes.
            passes: int (len(ids), 3): bead, target and side of each.
            points: float64 (n, beads, 3), metres: where all ropes lie.
        """
        moves = np.array(passes, dtype=np.int64).reshape(-1, 3)
        self.beads[ids], self._stage[ids] = moves[:, 0], 0
        _straight(
            points, ids, moves, self._waypoints, RISE, _FARTHEST, STRAIGHT_LIFT, _STRAIGHT_BEYOND
        )

    def release(self, ids: NDArray[np.int64]) -> None:
        """Abandon the macro-actions of some ropes."""
        self._stage[ids] = _WAYPOINTS

    def arrive(self, points: Array, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Go on to the first waypoint that the bead hasn't reached; return which have none left."""
        _arrive(points, ids, self.beads, self._waypoints, self._stage, _ARRIVED)
        return np.asarray(self._stage[ids] >= _WAYPOINTS)

    def forces(self, points: Array, ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """Forces on the led beads, float32 (len(ids), 3), in units of the largest; 0 if idle.

        Their length is 1, or less where the waypoint is nearer than a stride. They are `quantized`.
        """
        return np.asarray(_lead(points, ids, self.beads, self._waypoints, self._stage, _STRIDE))


@kernel
def _straight(points, ids, passes, waypoints, rise, farthest, lift, beyond):  # type: ignore[no-untyped-def]
    """Lay out the `_waypoints` of passes (bead, target, side) in rows `ids`.

    They are those of `MacroAction.passing` straight ahead and a fixed distance beyond. No sine or
    cosine: their last bits differ between processors.
    """
    for k in range(len(ids)):
        rope, bead, target, side = points[ids[k]], passes[k, 0], passes[k, 1], passes[k, 2]
        # Seen from above; where both beads lie at one point any direction will do, and (1, 0) is as
        # good as another.
        x, y = rope[target, 0] - rope[bead, 0], rope[target, 1] - rope[bead, 1]
        far = np.sqrt(x * x + y * y)
        ahead_x, ahead_y = (x / far, y / far) if far > 0 else (1.0, 0.0)
        # a strand farther away than that is approached without being passed
        reach = min(far, farthest)
        # relative to the strand to pass, not to the bead
        height, level = rope[target, 2] + side * lift, rope[:, 2].sum() / len(rope)
        for n, (along, z) in enumerate(
            ((min(rise, reach), height), (reach + beyond, height), (reach + beyond, level))
        ):
            waypoints[ids[k], n, 0] = rope[bead, 0] + ahead_x * along
            waypoints[ids[k], n, 1] = rope[bead, 1] + ahead_y * along
            waypoints[ids[k], n, 2] = z


@kernel
def _arrive(points, ids, beads, waypoints, stage, arrived):  # type: ignore[no-untyped-def]
    for index in ids:
        while stage[index] < 3:
            square = 0.0
            for c in range(3):
                square += (waypoints[index, stage[index], c] - points[index, beads[index], c]) ** 2
            if np.sqrt(square) >= arrived:
                break
            stage[index] += 1


@kernel
def _lead(points, ids, beads, waypoints, stage, stride):  # type: ignore[no-untyped-def]
    forces = np.zeros((len(ids), 3), np.float32)
    for k in range(len(ids)):
        index = ids[k]
        if stage[index] < 3:
            offset = waypoints[index, stage[index]] - points[index, beads[index]]
            far = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
            # proportional control that saturates at `stride`; 1e-9 guards a bead on its waypoint
            share = min(1.0, far / stride)
            for c in range(3):
                # + 0.0 makes -0.0 to 0.0, as in `quantized`
                bins = np.rint(offset[c] / max(far, 1e-9) * share * FORCE_BINS) + 0.0
                forces[k, c] = bins / FORCE_BINS
    return forces
