"""Macro-actions: one bead led past waypoints, in a few steps and without a goal.

One step moves the bead by three to five centimetres. Macro-actions are drawn at random from what is
near: `pass` (over or under another strand), `curl` (over or under a strand close by along the rope,
which makes or undoes a kink), `spread` (away from the middle), `shift` (anywhere).

A haul is another thing: two beads pulled apart with all force, in turn. It heeds neither strands
nor codes, and undoes tangles whose every small change makes them worse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import InvalidConfig, check_numbers
from knotgym.rope.model import Array

KINDS = ("pass", "curl", "spread", "shift")
_WAYPOINTS = 3
_HAUL_RISE = -0.2, 0.6  # upward force, in units of the largest
_HAUL_STEPS = 4, 20  # from and below


@dataclass(frozen=True, kw_only=True)
class MacroActionConfig:
    """How macro-actions are drawn and carried out.

    Attributes:
        shares: of KINDS among those drawn at random.
        arrived: metres from a waypoint that count as there.
        stride: metres that one step at full force leads a bead, about; shorter ones take less.
        lift: metres above or below a strand that a bead passes it at, or that it is shifted at.
        rise: metres ahead within which a bead reaches that height.
        distance: metres that a bead is spread or shifted, from and to.
        spread_angle: standard deviation of a spread's heading, radians.
        pass_angle: that of the heading of a pass or curl.
        beyond: metres past the strand that a pass or curl ends at, from and to.
        farthest: metres away that a strand is passed at most; one farther off isn't reached.
        pass_apart: beads along the rope between a bead and the strand it passes, at least.
        curl_apart: the same of a curl, from and to.
    """

    shares: tuple[float, float, float, float] = (0.4, 0.25, 0.1, 0.25)
    arrived: float = 0.012
    stride: float = 0.045
    lift: float = 0.03
    rise: float = 0.03
    distance: tuple[float, float] = (0.03, 0.2)
    spread_angle: float = 0.5
    pass_angle: float = 0.3
    beyond: tuple[float, float] = (0.02, 0.09)
    farthest: float = 0.3
    pass_apart: int = 12
    curl_apart: tuple[int, int] = (6, 24)

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("pass_apart",),
            positive=("arrived", "stride", "farthest"),
            non_negative=("lift", "rise", "spread_angle", "pass_angle"),
            ranges=("distance", "beyond", "curl_apart"),
        )
        if len(self.shares) != len(KINDS) or min(self.shares) < 0 or not sum(self.shares) > 0:
            raise InvalidConfig(
                f"shares must be {len(KINDS)} numbers of at least 0, not all 0, for"
                f" {', '.join(KINDS)}; got {self.shares}"
            )


@dataclass(frozen=True)
class MacroAction:
    """Lead `bead` past `waypoints`, float64 (3, 3), metres, world frame.

    Attributes:
        target: the bead of the strand to be passed, -1 where there is none.
        side: +1 over it, -1 under it.
    """

    kind: str
    bead: int
    waypoints: Array
    target: int = -1
    side: int = 0


def propose(points: Array, rng: np.random.Generator, config: MacroActionConfig) -> MacroAction:
    """Draw a macro-action for a configuration (beads, 3)."""
    beads = len(points)
    kind = KINDS[int(_kinds(tuple(config.shares)).searchsorted(rng.random(), side="right"))]
    bead = int(rng.integers(beads))
    side = (-1, 1)[rng.integers(2)]
    if kind == "curl":
        least, most = config.curl_apart
        apart = int(rng.integers(least, most + 1)) * (-1, 1)[rng.integers(2)]
    elif kind == "pass":
        apart = int(rng.integers(config.pass_apart, beads - config.pass_apart))
    else:
        return move_aside(points, kind, bead, side, rng, config)
    return pass_strand(points, kind, bead, (bead + apart) % beads, side, rng, config)


@dataclass(frozen=True, eq=False)
class Haul:
    """Two beads pulled apart, in turn.

    Attributes:
        beads: pulled at even and at odd steps.
        force: float64 (3,), of even steps, in units of the largest; odd ones turn it about.
        steps: that it takes.
    """

    beads: tuple[int, int]
    force: Array
    steps: int

    def pull(self, step: int) -> tuple[int, Array]:
        """The bead pulled at a step, and the force, (3,)."""
        return self.beads[step % 2], self.force * ((1, 1, 1), (-1, -1, 1))[step % 2]


def propose_haul(beads: int, rng: np.random.Generator) -> Haul:
    """Draw a haul of a rope of so many beads: any two, a fifth of the rope apart at least."""
    first, apart = int(rng.integers(beads)), int(rng.integers(beads // 5, beads - beads // 5))
    heading, rise = rng.uniform(-np.pi, np.pi), rng.uniform(*_HAUL_RISE)
    force = np.array([np.cos(heading), np.sin(heading), rise])
    return Haul((first, (first + apart) % beads), force, int(rng.integers(*_HAUL_STEPS)))


def move_aside(
    points: Array,
    kind: str,
    bead: int,
    side: int,
    rng: np.random.Generator,
    config: MacroActionConfig,
) -> MacroAction:
    """Lead `bead` away from the rope's middle ("spread") or anywhere ("shift").

    A shift is lifted (side +1) or lowered (-1).
    """
    offset = points[bead, :2] - points[:, :2].mean(axis=0)
    height = points[bead, 2]
    if kind == "spread":
        side = 0
        heading = np.arctan2(offset[1], offset[0]) + rng.normal(0, config.spread_angle)
    else:
        height = height + side * config.lift
        heading = rng.uniform(-np.pi, np.pi)
    far = rng.uniform(*config.distance)
    waypoints = _waypoints(points, bead, heading, height, min(config.rise, far), far)
    return MacroAction(kind, bead, waypoints, side=side)


def pass_strand(
    points: Array,
    kind: str,
    bead: int,
    target: int,
    side: int,
    rng: np.random.Generator,
    config: MacroActionConfig,
) -> MacroAction:
    """Lead `bead` over (side +1) or under (-1) the bead `target`, and on."""
    offset = points[target, :2] - points[bead, :2]
    far = min(float(np.hypot(*offset)), config.farthest)
    heading = np.arctan2(offset[1], offset[0]) + rng.normal(0, config.pass_angle)
    height = points[target, 2] + side * config.lift
    reach = far + rng.uniform(*config.beyond)
    waypoints = _waypoints(points, bead, heading, height, min(config.rise, far), reach)
    return MacroAction(kind, bead, waypoints, target, side)


def _waypoints(
    points: Array, bead: int, heading: float, height: float, rise: float, reach: float
) -> Array:
    """To `height` within `rise` metres, on to `reach`, and back to the rope's level; (3, 3)."""
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


def cumulative_shares(weights: Array) -> Array:
    """Shares summed up to each; `searchsorted(rng.random(), side="right")` draws by them.

    So `Generator.choice` does it, by the same number of the stream, but with checks that take far
    longer.
    """
    shares = (weights / weights.sum()).cumsum()
    return np.asarray(shares / shares[-1])


@lru_cache
def _kinds(shares: tuple[float, ...]) -> Array:
    return cumulative_shares(np.array(shares))


class WaypointController:
    """Leads one bead of each of n ropes through its macro-action, step by step.

    Attributes:
        beads: int64 (n,), the bead led on each rope.
    """

    def __init__(self, count: int, config: MacroActionConfig) -> None:
        self.beads = np.zeros(count, dtype=np.int64)
        self._config = config
        self._waypoints = np.zeros((count, _WAYPOINTS, 3))
        self._stage = np.full(count, _WAYPOINTS)  # the waypoint gone to; past the last if idle

    def begin(self, index: int, macro_action: MacroAction) -> None:
        """Begin a macro-action on rope `index`."""
        self.beads[index] = macro_action.bead
        self._waypoints[index] = macro_action.waypoints
        self._stage[index] = 0

    def release(self, index: int) -> None:
        """Let go of rope `index`."""
        self._stage[index] = _WAYPOINTS

    @property
    def idle(self) -> NDArray[np.bool_]:
        """Which ropes have no waypoint left to go to, bool (n,)."""
        return self._stage >= _WAYPOINTS

    def advance(self, points: Array) -> None:
        """Go on to the next waypoint where the bead is at one; points (n, beads, 3)."""
        for _ in range(_WAYPOINTS):
            near = np.linalg.norm(self._offsets(points), axis=1) < self._config.arrived
            self._stage += near & ~self.idle

    def forces(self, points: Array) -> Array:
        """The steps to take now: float64 (n, 3), at most 1 long, in units of the largest force.

        An idle rope's is 0.
        """
        offset = self._offsets(points)
        far = np.linalg.norm(offset, axis=1, keepdims=True)
        force = offset / np.maximum(far, 1e-9) * np.minimum(1.0, far / self._config.stride)
        return np.where(self.idle[:, None], 0.0, force)

    def _offsets(self, points: Array) -> Array:
        """From each led bead to its waypoint, float64 (n, 3), metres."""
        rows = np.arange(len(self.beads))
        stage = np.minimum(self._stage, _WAYPOINTS - 1)
        return self._waypoints[rows, stage] - points[rows, self.beads]
