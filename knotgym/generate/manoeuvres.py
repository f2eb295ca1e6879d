"""Scripted manoeuvres: what a hand does to a rope with one bead in a few pulls.

A manoeuvre leads one bead past waypoints; one pull moves it by three to five centimetres. They are drawn at random from
what is near, without a goal: `pass` (over or under another strand), `curl` (over or under a strand close by along the rope,
which makes or takes a kink), `spread` (away from the middle), `shift` (anywhere).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.rope import Array
from knotgym.simulation import Ids, Simulation

KINDS = ("pass", "curl", "spread", "shift")
ARRIVED = 0.012  # metres from a waypoint that count as there
STRIDE = 0.045  # metres that one pull at full force leads a bead, about; shorter ways are pulled weaker
LIFT = 0.03  # metres above or below a strand that a bead passes it at


@dataclass(frozen=True)
class Manoeuvre:
    """Lead `bead` past `waypoints`, float64 (k, 3), metres, world frame."""

    kind: str
    bead: int
    waypoints: Array


def propose(points: Array, rng: np.random.Generator) -> Manoeuvre:
    """Draw a manoeuvre for a configuration (beads, 3)."""
    beads = len(points)
    kind = KINDS[rng.choice(4, p=(0.4, 0.25, 0.1, 0.25))]
    bead = int(rng.integers(beads))
    here = points[bead]
    side = float(rng.choice((-1.0, 1.0)))
    if kind in ("pass", "curl"):
        apart = int(rng.integers(6, 25)) * int(rng.choice((-1, 1))) if kind == "curl" else int(rng.integers(12, beads - 12))
        there = points[(bead + apart) % beads]
        way = there[:2] - here[:2]
        far = min(float(np.hypot(*way)), 0.3)
        heading = np.arctan2(way[1], way[0]) + rng.normal(0, 0.3)
        height = there[2] + side * LIFT
        reach = far + rng.uniform(0.02, 0.09)
    else:
        way = here[:2] - points[:, :2].mean(axis=0)
        heading = np.arctan2(way[1], way[0]) + rng.normal(0, 0.5) if kind == "spread" else rng.uniform(-np.pi, np.pi)
        far = reach = rng.uniform(0.03, 0.2)
        height = here[2] + (0.0 if kind == "spread" else side * LIFT)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    rise, end = here[:2] + ahead * min(0.03, far), here[:2] + ahead * reach
    return Manoeuvre(kind, bead, np.array([[*rise, height], [*end, height], [*end, points[:, 2].mean()]]))


class Hand:
    """Leads one bead of each of n ropes through its manoeuvre, pull by pull."""

    def __init__(self, count: int) -> None:
        self.beads = np.zeros(count, dtype=np.int64)
        self._waypoints = np.zeros((count, 3, 3))
        self._stage = np.full(count, 3)

    def take(self, index: int, manoeuvre: Manoeuvre) -> None:
        """Begin a manoeuvre on rope `index`."""
        self.beads[index] = manoeuvre.bead
        self._waypoints[index] = manoeuvre.waypoints
        self._stage[index] = 0

    def idle(self, points: Array) -> NDArray[np.bool_]:
        """Which ropes have reached their last waypoint, bool (n,); points (n, beads, 3)."""
        rows = np.arange(len(self.beads))
        for _ in range(3):
            stage = np.minimum(self._stage, 2)
            near = np.linalg.norm(self._waypoints[rows, stage] - points[rows, self.beads], axis=1) < ARRIVED
            self._stage += near & (self._stage < 3)
        return self._stage >= 3

    def forces(self, points: Array) -> Array:
        """The pulls to make now, in units of the largest force, float64 (n, 3), at most 1 long; 0 for an idle rope."""
        rows = np.arange(len(self.beads))
        way = self._waypoints[rows, np.minimum(self._stage, 2)] - points[rows, self.beads]
        far = np.linalg.norm(way, axis=1, keepdims=True)
        pull = way / np.maximum(far, 1e-9) * np.minimum(1.0, far / STRIDE)
        return np.where((self._stage < 3)[:, None], pull, 0.0)


@dataclass(frozen=True)
class Way:
    """Pulls that lead from one state to another, by bead and not by place, so that they fit a rope that lies otherwise.

    Attributes:
        beads: int16 (T,).
        forces: float32 (T, 3), in units of the largest force.
    """

    beads: NDArray[np.int16]
    forces: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.beads)

    def __add__(self, other: Way) -> Way:
        return Way(np.concatenate([self.beads, other.beads]), np.concatenate([self.forces, other.forces]))


NO_WAY = Way(np.zeros(0, dtype=np.int16), np.zeros((0, 3), dtype=np.float32))


def pull(
    simulation: Simulation, beads: NDArray[np.integer], forces: NDArray[np.floating], ids: Ids = None
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
    actions = simulation.actions(beads, np.asarray(forces, dtype=np.float64) * simulation.rope.config.max_force, ids)
    return actions, simulation.act(actions, ids)
