"""Opening a configuration up without physics: strands part in the picture, bends ease, and the
Gauss code stays.

A thousandth of the cost of opening up in the simulator (`generate.opening`), for pictures, which
need a rope that could lie so and no way there. Each iteration pushes apart vertices whose strands
come near in the picture, straightens bends, lifts the strands at crossings apart, and gives every
bead its length again (position-based dynamics, Müller et al., 2007).
"""

from __future__ import annotations

import numba
import numpy as np

from knotgym.rope import Array, InvalidCurve, Rope
from knotgym.topology.crossings import label

REACH = 0.045  # metres in the picture within which strands push each other apart: nine pixels
APART = 5  # beads along the rope that are the same strand
HEIGHT = 0.0125  # metres that crossing strands' axes are brought apart


def relaxed(points: Array, rounds: int, rope: Rope) -> Array | None:
    """Open a configuration up.

    Args:
        points: float64 (beads, 3), metres; left alone.
        rounds: of 20 iterations each, at least 1; it ends before the first that would change the
            code.
        rope: whose bead length and overlap it keeps to.

    Returns:
        float64 (beads, 3), a configuration of the rope with the code of `points`; None if it can't
        be had.
    """
    code = label(points)
    moving, last = np.array(points, dtype=np.float64), None
    for _ in range(rounds):
        _iterate(moving, rope.config.bead_length, 20)
        if label(moving) != code:
            break
        last = moving.copy()
    if last is None:
        return None
    try:
        laid = rope.from_curve(last)
    except InvalidCurve:  # strands are too deep in each other
        return None
    return laid if label(laid) == code else None


@numba.njit(cache=True, nogil=True)
def _iterate(p: Array, length: float, iterations: int) -> None:
    n = len(p)
    push = np.empty((n, 3))
    for _ in range(iterations):
        for i in range(n):
            a, b, c, d = (i - 2) % n, (i - 1) % n, (i + 1) % n, (i + 2) % n
            for k in range(3):
                push[i, k] = -0.03 * (p[a, k] - 4 * p[b, k] + 6 * p[i, k] - 4 * p[c, k] + p[d, k])
        for i in range(n):
            for j in range(i + APART, n):
                if i + n - j < APART:
                    continue
                x, y = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1]
                apart = np.sqrt(x * x + y * y)
                if apart >= REACH:
                    continue
                if (
                    apart < 1.5 * length
                ):  # they cross, or nearly: over and under keep their distance
                    z = p[i, 2] - p[j, 2]
                    lack = HEIGHT - abs(z)
                    if lack > 0:
                        lift = 0.25 * lack if z >= 0 else -0.25 * lack
                        push[i, 2] += lift
                        push[j, 2] -= lift
                if apart > 1e-9:
                    strength = 0.012 * (1 - apart / REACH) ** 2 * length / apart
                    push[i, 0] += strength * x
                    push[i, 1] += strength * y
                    push[j, 0] -= strength * x
                    push[j, 1] -= strength * y
        for i in range(n):
            for k in range(3):
                p[i, k] += min(0.15 * length, max(-0.15 * length, push[i, k]))
        for _ in range(8):
            for i in range(n):
                j = (i + 1) % n
                x, y, z = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
                now = np.sqrt(x * x + y * y + z * z)
                share = 0.5 * (now - length) / max(now, 1e-12)
                p[i, 0] += share * x
                p[i, 1] += share * y
                p[i, 2] += share * z
                p[j, 0] -= share * x
                p[j, 1] -= share * y
                p[j, 2] -= share * z
