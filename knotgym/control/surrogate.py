"""Sketches of macro_actions: about where a rope would lie, without simulating it.

The pulled bead goes straight to its waypoints and takes its neighbours along; from there on to both
sides every vertex follows the one before it at its distance, as the links of a chain do in
something thick. Inertia, contact and the drag in the joints are left out: of the codes that
surrogate_rollouts show one in four is one that the simulated rope goes through. A surrogate rollout
takes about a seventh of a millisecond.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from knotgym.control.macro_actions import ARRIVED, MacroAction
from knotgym.rope import Array

PACE = 0.03  # metres that a pull leads a bead, on average
_STEP = 0.006  # metres in one go
_REACH = 2.0  # vertices away at which a neighbour is taken along by exp(-1/2)


def surrogate_rollout(points: Array, macro_action: MacroAction, steps: int) -> Array:
    """Configurations about after each pull of a macro-action, `pulls` at most: float64 (k, beads,
    3), metres.
    """
    frames, count = _led(points, macro_action.bead, macro_action.waypoints, steps)
    return frames[:count]


@njit(cache=True)
def _led(points: Array, bead: int, waypoints: Array, steps: int) -> tuple[Array, int]:
    n = len(points)
    half = n // 2
    now = points.copy()
    frames = np.empty((steps, n, 3))
    lengths, taken = np.empty(n), np.empty(half)
    for i in range(n):
        lengths[i] = np.sqrt(((points[(i + 1) % n] - points[i]) ** 2).sum())
    for k in range(half):
        taken[k] = np.exp(-0.5 * (k / _REACH) ** 2)
    sequence = np.empty(3)
    stage, count, walked = 0, 0, 0.0
    while stage < len(waypoints) and count < steps:
        for c in range(3):
            sequence[c] = waypoints[stage, c] - 0.5 * (now[bead, c] + now[(bead + 1) % n, c])
        far = np.sqrt((sequence**2).sum())
        if far < ARRIVED:
            stage += 1
            continue
        step = min(_STEP, far)
        sequence *= step / far
        for k in range(half):
            if taken[k] < 1e-3:
                break
            now[(bead + 1 + k) % n] += taken[k] * sequence
            now[(bead - k) % n] += taken[k] * sequence
        for k in range(half - 1):
            ahead, back = (bead + 1 + k) % n, (bead - k) % n
            _follow(now, ahead, (ahead + 1) % n, lengths[ahead])
            _follow(now, back, (back - 1) % n, lengths[(back - 1) % n])
        walked += step
        if walked >= PACE:
            walked = 0.0
            frames[count] = now
            count += 1
    if count < steps:
        frames[count] = now
        count += 1
    return frames, count


@njit(cache=True)
def _follow(now: Array, lead: int, after: int, length: float) -> None:
    """Draw a vertex towards, or push it from, the one that leads it until it is as far away as it
    was.
    """
    far = 0.0
    for c in range(3):
        far += (now[after, c] - now[lead, c]) ** 2
    share = length / max(np.sqrt(far), 1e-9)
    for c in range(3):
        now[after, c] = now[lead, c] + share * (now[after, c] - now[lead, c])
