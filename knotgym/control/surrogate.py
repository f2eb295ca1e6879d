"""Surrogate rollouts: about where a macro-action would lead a rope, without simulating it.

The led bead goes straight to its waypoints and takes its neighbours along; from there on to both
sides every vertex follows the one before it at its distance, as the links of a chain do in
something thick. Inertia, contact and the drag in the joints are left out: of the codes that
surrogate rollouts show one in four is one that the simulated rope goes through. A rollout takes
about a fourteenth of a millisecond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from knotgym.common.configuration import check_numbers
from knotgym.control.macro_actions import MacroAction
from knotgym.rope.model import Array

_LEAST_SHARE = 1e-3  # of the bead's motion, below which a neighbour isn't taken along


@dataclass(frozen=True, kw_only=True)
class SurrogateConfig:
    """How surrogate rollouts move a rope.

    Attributes:
        steps: of the rope that a rollout foresees.
        pace: metres that a step leads a bead, on average.
        stride: metres that the surrogate moves the bead at once.
        reach: vertices away at which a neighbour is taken along by exp(-1/2).
    """

    steps: int = 10
    pace: float = 0.03
    stride: float = 0.006
    reach: float = 2.0

    def __post_init__(self) -> None:
        check_numbers(self, counts=("steps",), positive=("pace", "stride", "reach"))


def surrogate_rollout(
    points: Array, macro_action: MacroAction, arrived: float, config: SurrogateConfig
) -> Array:
    """Configurations about after each step of a macro-action.

    Args:
        points: float64 (beads, 3), metres; left alone.
        macro_action: what the rope is led through.
        arrived: metres from a waypoint that count as there.
        config: how the rope moves.

    Returns:
        float64 (k, beads, 3), metres, `config.steps` of them at most.
    """
    frames, count = _lead(
        points,
        macro_action.bead,
        macro_action.waypoints,
        arrived,
        config.steps,
        config.pace,
        config.stride,
        config.reach,
    )
    return frames[:count]


@njit(cache=True)
def _lead(
    points: Array,
    bead: int,
    waypoints: Array,
    arrived: float,
    steps: int,
    pace: float,
    stride: float,
    reach: float,
) -> tuple[Array, int]:
    n = len(points)
    half = n // 2
    now = points.copy()
    frames = np.empty((steps, n, 3))
    lengths, taken = np.empty(n), np.empty(half)
    for i in range(n):
        square = 0.0
        for c in range(3):
            square += (points[(i + 1) % n, c] - points[i, c]) ** 2
        lengths[i] = np.sqrt(square)
    for k in range(half):
        taken[k] = np.exp(-0.5 * (k / reach) ** 2)
    move = np.empty(3)
    stage, count, walked = 0, 0, 0.0
    while stage < len(waypoints) and count < steps:
        for c in range(3):
            move[c] = waypoints[stage, c] - 0.5 * (now[bead, c] + now[(bead + 1) % n, c])
        far = np.sqrt(move[0] ** 2 + move[1] ** 2 + move[2] ** 2)
        if far < arrived:
            stage += 1
            continue
        step = min(stride, far)
        for c in range(3):
            move[c] *= step / far
        for k in range(half):
            if taken[k] < _LEAST_SHARE:
                break
            for c in range(3):
                now[(bead + 1 + k) % n, c] += taken[k] * move[c]
                now[(bead - k) % n, c] += taken[k] * move[c]
        ahead, back = (bead + 1) % n, bead
        for _ in range(half - 1):
            after, before = ahead + 1, back - 1
            after = 0 if after == n else after
            before = n - 1 if before < 0 else before
            _follow(now, ahead, after, lengths[ahead])
            _follow(now, back, before, lengths[before])
            ahead, back = after, before
        walked += step
        if walked >= pace:
            walked = 0.0
            _copy(now, frames[count])
            count += 1
    if count < steps:
        _copy(now, frames[count])
        count += 1
    return frames, count


@njit(cache=True)
def _copy(points: Array, frame: Array) -> None:
    for k in range(len(points)):
        for c in range(3):
            frame[k, c] = points[k, c]


@njit(cache=True)
def _follow(now: Array, lead: int, after: int, length: float) -> None:
    """Put a vertex at its old distance from the one that leads it."""
    far = 0.0
    for c in range(3):
        far += (now[after, c] - now[lead, c]) ** 2
    share = length / max(np.sqrt(far), 1e-9)
    for c in range(3):
        now[after, c] = now[lead, c] + share * (now[after, c] - now[lead, c])
