"""Scripted macro_actions: what a hand does to a rope with one bead in a few pulls.

A macro-action leads one bead past waypoints; one pull moves it by three to five centimetres. They
are drawn at random from what is near, without a goal: `pass` (over or under another strand), `curl`
(over or under a strand close by along the rope, which makes or takes a kink), `spread` (away from
the middle), `shift` (anywhere).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.rope import Array
from knotgym.simulation import Ids, Simulation

KINDS = ("pass", "curl", "spread", "shift")
ARRIVED = 0.012  # metres from a waypoint that count as there
STRIDE = (
    0.045  # metres that one pull at full force leads a bead, about; shorter ways are pulled weaker
)
LIFT = 0.03  # metres above or below a strand that a bead passes it at


@dataclass(frozen=True)
class MacroAction:
    """Lead `bead` past `waypoints`, float64 (k, 3), metres, world frame.

    Attributes:
        target: the bead of the strand to be passed, -1 where there is none.
        side: +1 over it, -1 under it.
    """

    kind: str
    bead: int
    waypoints: Array
    target: int = -1
    side: int = 0


def propose(points: Array, rng: np.random.Generator) -> MacroAction:
    """Draw a macro-action for a configuration (beads, 3)."""
    beads = len(points)
    kind = KINDS[rng.choice(4, p=(0.4, 0.25, 0.1, 0.25))]
    bead = int(rng.integers(beads))
    side = float(rng.choice((-1.0, 1.0)))
    if kind in ("pass", "curl"):
        apart = (
            int(rng.integers(6, 25)) * int(rng.choice((-1, 1)))
            if kind == "curl"
            else int(rng.integers(12, beads - 12))
        )
        return pass_strand(points, kind, bead, (bead + apart) % beads, int(side), rng)
    return move_aside(points, kind, bead, int(side), rng)


def move_aside(
    points: Array, kind: str, bead: int, side: int, rng: np.random.Generator
) -> MacroAction:
    """Lead `bead` away from the rope's middle ("spread"), or anywhere, lifted (side +1) or lowered
    (-1) ("shift").
    """
    offset = points[bead, :2] - points[:, :2].mean(axis=0)
    heading = (
        np.arctan2(offset[1], offset[0]) + rng.normal(0, 0.5)
        if kind == "spread"
        else rng.uniform(-np.pi, np.pi)
    )
    far = rng.uniform(0.03, 0.2)
    height = points[bead, 2] + (0.0 if kind == "spread" else side * LIFT)
    return MacroAction(
        kind,
        bead,
        _waypoints(points, bead, heading, height, far, far),
        -1,
        0 if kind == "spread" else side,
    )


def pass_strand(
    points: Array, kind: str, bead: int, target: int, side: int, rng: np.random.Generator
) -> MacroAction:
    """Lead `bead` over (side +1) or under (-1) the bead `target` and some way on."""
    offset = points[target, :2] - points[bead, :2]
    far = min(float(np.hypot(*offset)), 0.3)
    heading = np.arctan2(offset[1], offset[0]) + rng.normal(0, 0.3)
    waypoints = _waypoints(
        points, bead, heading, points[target, 2] + side * LIFT, far, far + rng.uniform(0.02, 0.09)
    )
    return MacroAction(kind, bead, waypoints, target, side)


class WaypointController:
    """Leads one bead of each of n ropes through its macro-action, pull by pull."""

    def __init__(self, count: int) -> None:
        self.beads = np.zeros(count, dtype=np.int64)
        self._waypoints = np.zeros((count, 3, 3))
        self._stage = np.full(count, 3)

    def begin(self, index: int, macro_action: MacroAction) -> None:
        """Begin a macro-action on rope `index`."""
        self.beads[index] = macro_action.bead
        self._waypoints[index] = macro_action.waypoints
        self._stage[index] = 0

    def release(self, index: int) -> None:
        """Let go of rope `index`."""
        self._stage[index] = 3

    @property
    def idle(self) -> NDArray[np.bool_]:
        """Which ropes have no waypoint left to go to, bool (n,)."""
        return self._stage >= 3

    def advance(self, points: Array) -> None:
        """Go on to the next waypoint where the bead is at one; points (n, beads, 3)."""
        rows = np.arange(len(self.beads))
        for _ in range(3):
            stage = np.minimum(self._stage, 2)
            offset = self._waypoints[rows, stage] - points[rows, self.beads]
            self._stage += (np.linalg.norm(offset, axis=1) < ARRIVED) & (self._stage < 3)

    def forces(self, points: Array) -> Array:
        """The pulls to make now, in units of the largest force, float64 (n, 3), at most 1 long; 0
        for an idle rope.
        """
        rows = np.arange(len(self.beads))
        offset = self._waypoints[rows, np.minimum(self._stage, 2)] - points[rows, self.beads]
        far = np.linalg.norm(offset, axis=1, keepdims=True)
        pull = offset / np.maximum(far, 1e-9) * np.minimum(1.0, far / STRIDE)
        return np.where((self._stage < 3)[:, None], pull, 0.0)


def _waypoints(
    points: Array, bead: int, heading: float, height: float, far: float, reach: float
) -> Array:
    """Up or down to `height` within the first 3 cm, `reach` metres ahead, and back to the rope's
    level; float64 (3, 3).
    """
    ahead = np.array([np.cos(heading), np.sin(heading)])
    rise, end = points[bead, :2] + ahead * min(0.03, far), points[bead, :2] + ahead * reach
    return np.array([[*rise, height], [*end, height], [*end, points[:, 2].mean()]])


@dataclass(frozen=True)
class ActionSequence:
    """Pulls that lead from one state to another, by bead and not by place, so that they fit a rope
    that lies otherwise.

    Attributes:
        beads: int16 (T,).
        forces: float32 (T, 3), in units of the largest force.
    """

    beads: NDArray[np.int16]
    forces: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.beads)

    def jittered(self, scale: float, rng: np.random.Generator) -> ActionSequence:
        """The same pulls, each stronger or weaker by a share of about `scale`: another try where
        the way itself just misses.
        """
        strength = 1 + rng.normal(0, scale, (len(self), 1))
        return ActionSequence(self.beads, np.clip(self.forces * strength, -1, 1).astype(np.float32))

    def __add__(self, other: ActionSequence) -> ActionSequence:
        return ActionSequence(
            np.concatenate([self.beads, other.beads]), np.concatenate([self.forces, other.forces])
        )


NO_ACTIONS = ActionSequence(np.zeros(0, dtype=np.int16), np.zeros((0, 3), dtype=np.float32))


def step_ropes(
    simulation: Simulation,
    beads: NDArray[np.integer],
    forces: NDArray[np.floating],
    ids: Ids = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Pull through the agent's interface, so that what is recorded is what an agent can do.

    Args:
        simulation: the ropes.
        beads: int (len(ids),).
        forces: (len(ids), 3), in units of the largest force.
        ids: the ropes.

    Returns:
        The actions float32 (len(ids), 6), and which ropes held.
    """
    actions = simulation.actions(
        beads, np.asarray(forces, dtype=np.float64) * simulation.rope.config.max_force, ids
    )
    return actions, simulation.act(actions, ids)
