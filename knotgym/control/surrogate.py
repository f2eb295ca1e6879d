"""Surrogate rollouts: predict roughly where a macro-action leads a rope, without the simulator.

The bead moves straight towards its waypoints and drags its neighbours along. Outwards from it, in
both directions, each vertex then moves along the line to the vertex before it until their segment
has its old length: follow-the-leader kinematics, the overdamped limit of a chain of links. Inertia,
contact and joint damping are ignored, so only one in four of the codes that a surrogate rollout
predicts is one that the simulated rope goes through. A rollout takes about 0.07 ms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from knotgym.common.configuration import check_numbers
from knotgym.rope.macro_actions import MacroAction
from knotgym.rope.model import Array

_LEAST_SHARE = 1e-3  # neighbours that would move by less than this share aren't dragged


@dataclass(frozen=True, kw_only=True)
class SurrogateConfig:
    """Settings of surrogate rollouts.

    Attributes:
        steps: most environment steps that a rollout predicts.
        pace: metres that a bead travels in one environment step, on average.
        stride: metres that the surrogate moves the bead in one iteration.
        reach: standard deviation, in vertices, of the Gaussian by which neighbours are dragged.
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
    """Predict the configuration after each environment step of a macro-action.

    Args:
        points: float64 (beads, 3), metres; not modified.
        macro_action: the bead and its waypoints.
        arrived: distance in metres at which a waypoint counts as reached.
        config: settings of the rollout.

    Returns:
        float64 (k, beads, 3), metres, with k at most `config.steps`.
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
    """Compiled body of `surrogate_rollout`: frames (steps, n, 3) and how many are filled.

    Bead i is the segment from vertex i to vertex i + 1, and its position is their midpoint.
    """
    n = len(points)
    half = n // 2
    now = points.copy()
    frames = np.empty((steps, n, 3))
    # lengths[i]: of the segment from vertex i to i + 1; taken[k]: share of the bead's motion that
    # vertices k beyond either end of the bead get
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
        # Both ends of the bead move by the whole step (taken[0] is 1), vertices beyond by less.
        for k in range(half):
            if taken[k] < _LEAST_SHARE:
                break
            for c in range(3):
                now[(bead + 1 + k) % n, c] += taken[k] * move[c]
                now[(bead - k) % n, c] += taken[k] * move[c]
        # Restore the segment lengths outwards from the bead, one vertex on each side in turn. The
        # two fronts meet at the far side of the loop; the one segment between them isn't
        # corrected and may change its length.
        ahead, back = (bead + 1) % n, bead
        for _ in range(half - 1):
            after, before = ahead + 1, back - 1
            after = 0 if after == n else after
            before = n - 1 if before < 0 else before
            _follow(now, ahead, after, lengths[ahead])
            _follow(now, back, before, lengths[before])
            ahead, back = after, before
        # Several iterations make one environment step: record a frame every `pace` metres.
        walked += step
        if walked >= pace:
            walked = 0.0
            _copy(now, frames[count])
            count += 1
    if count < steps:  # where the macro-action ends, between two frames
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
    """Move vertex `after` along its line to vertex `lead` until they are `length` apart."""
    far = 0.0
    for c in range(3):
        far += (now[after, c] - now[lead, c]) ** 2
    share = length / max(np.sqrt(far), 1e-9)  # coincident vertices have no direction
    for c in range(3):
        now[after, c] = now[lead, c] + share * (now[after, c] - now[lead, c])
