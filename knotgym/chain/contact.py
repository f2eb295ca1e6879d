from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.chain.simd import any_below, fma, load, put, where_below

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FAR_APART = 0.080  # m, between midpoints: edges this far apart when the list is made aren't in it
DRIFT = 0.008  # m, that a vertex may move before the list is made again
LEAP = 0.022  # m, that a vertex may move in one substep
# Edges not listed are FAR_APART - L > 66 mm apart at first, > 66 - 2 DRIFT = 50 mm when a substep
# begins and > 50 - 2 LEAP = 6 mm at any time in it: they can't touch.
LOOKAHEAD = 0.008  # m, beyond touching, within which two edges may meet in a substep
SKIPPED = 3  # edges nearer than this along the rope are not in the list, see `bent`


@njit(nogil=True)
def middles(x: Array, middle: Array) -> None:
    n = len(x)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        for c in range(3):
            put(middle, (i, c), 0.5 * (load(x, (i, c)) + load(x, (j, c))))


@njit(nogil=True)
def list_pairs(middle: Array, pairs: Ints) -> int:
    """List the pairs of edges that are near in some lane; return how many."""
    n, count, bound = len(middle), 0, FAR_APART * FAR_APART
    for i in range(n):
        x, y, z = load(middle, (i, 0)), load(middle, (i, 1)), load(middle, (i, 2))
        for j in range(i + SKIPPED, n if i >= SKIPPED else n - SKIPPED + 1 + i):
            a, b = load(middle, (j, 0)) - x, load(middle, (j, 1)) - y
            c = load(middle, (j, 2)) - z
            if any_below(fma(a, a, fma(b, b, c * c)), bound):
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return count


@njit(nogil=True)
def closest(x: Array, i: int, j: int) -> Any:
    """Distance of edges i and j, and what leads to it (Ericson, Real-Time Collision Detection,
    5.1.9).

    Returns:
        The distance; the place of the nearest points along either edge, 0 to 1; the vector from
        the one to the other.
    """
    n = len(x)
    k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
    x0, y0, z0 = load(x, (i, 0)), load(x, (i, 1)), load(x, (i, 2))
    x1, y1, z1 = load(x, (j, 0)), load(x, (j, 1)), load(x, (j, 2))
    ux, uy, uz = load(x, (k, 0)) - x0, load(x, (k, 1)) - y0, load(x, (k, 2)) - z0
    vx, vy, vz = load(x, (m, 0)) - x1, load(x, (m, 1)) - y1, load(x, (m, 2)) - z1
    wx, wy, wz = x0 - x1, y0 - y1, z0 - z1
    uu, vv = fma(ux, ux, fma(uy, uy, uz * uz)), fma(vx, vx, fma(vy, vy, vz * vz))
    uv, uw = fma(ux, vx, fma(uy, vy, uz * vz)), fma(ux, wx, fma(uy, wy, uz * wz))
    vw = fma(vx, wx, fma(vy, wy, vz * wz))
    both = uu * vv
    det = fma(-uv, uv, both)
    s = min(max(fma(uv, vw, -uw * vv) / max(det, 1e-30), 0.0), 1.0)
    s = where_below(det, 1e-12 * both, 0.5, s)  # parallel: any will do
    free = fma(uv, s, vw) / vv
    t = min(max(free, 0.0), 1.0)
    # an end of the other edge is nearest: the nearest point to it
    s = where_below(abs(free - t), 1e-300, s, min(max(fma(uv, t, -uw) / uu, 0.0), 1.0))
    nx = fma(t, vx, fma(-s, ux, -wx))
    ny = fma(t, vy, fma(-s, uy, -wy))
    nz = fma(t, vz, fma(-s, uz, -wz))
    return math.sqrt(fma(nx, nx, fma(ny, ny, nz * nz))), s, t, nx, ny, nz


@njit(nogil=True)
def relative_motion(x: Array, new: Array, i: int, j: int) -> Any:
    """How far a point of edge i moves against a point of edge j at most, as vertices move straight.

    Both points' motions are mixtures of their vertices', so the largest is between two vertices.
    """
    n, most = len(x), 0.0 * load(x, (i, 0))
    for p in (i, i + 1 if i + 1 < n else 0):
        a = load(new, (p, 0)) - load(x, (p, 0))
        b = load(new, (p, 1)) - load(x, (p, 1))
        c = load(new, (p, 2)) - load(x, (p, 2))
        for q in (j, j + 1 if j + 1 < n else 0):
            d = a - (load(new, (q, 0)) - load(x, (q, 0)))
            e = b - (load(new, (q, 1)) - load(x, (q, 1)))
            f = c - (load(new, (q, 2)) - load(x, (q, 2)))
            most = max(most, fma(d, d, fma(e, e, f * f)))
    return math.sqrt(most)
