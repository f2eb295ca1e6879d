"""Contact between edges.

Beads are capsules about the edges of the polyline, of radius r; every two may touch that aren't
neighbours along the rope, as in MuJoCo's model. There is no friction.

*Contact force.* MuJoCo's contact is a soft constraint: with its parameters `solref` (time constant
c, damping ratio 1) and `solimp` (impedance d) the force between two beads at the gap g, negative
when they overlap, is f = -(k g + b g') / R, with k = 1 / (d c)^2, b = 2 / (d c) and
R = (1 - d) / d times the sum of the beads' inverse weights. Here g and g' are those at the end of
the substep (implicit): with u = n . (v_q - v_p), the speed at which the nearest points part,

    f = max(0, -k g - (k h + b) u)               where the beads overlap already,
    f = max(0, -(k h + b) (u + g / h))           where they first meet in the substep,
    f >= what keeps the distance above FLOOR     always.

The last keeps strands apart at any force. The velocities answer by v = v* + A^-1 J^T f, with the
matrix A of the substep and J of the row vectors n; J A^-1 J^T takes one forward substitution per
contact, and the forces are found by projected Gauss-Seidel.

*Pairs.* Edges are compared by their midpoints first. Pairs nearer than LISTED in any lane are
listed; the list is made again when a vertex has moved by DRIFT. Which pairs are in the list never
matters to a lane's result: those that aren't are too far apart to matter.

After a change run `pytest -m 'thorough or not thorough' tests/rope/chain`: forces must be those
of a plain Gauss-Seidel, and no pair end a substep below the floor; then `python
benchmarks/long_play.py --engine chain`: no change of knot type.
"""

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.rope.chain.banded import System, forward
from knotgym.rope.chain.layout import (
    CORNER_DIAGONAL,
    DAMPING,
    DIAGONAL,
    EDGE_I,
    EDGE_J,
    FLOOR,
    GAP,
    MAY,
    NORMAL,
    ON_I,
    ON_J,
    RADIUS,
    STIFFNESS,
    THEN,
)
from knotgym.rope.chain.simd import LANES, any_below, fma, load, put, where_below

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LISTED = 0.048  # m, between midpoints
DRIFT = 0.004  # m
LOOKAHEAD = 0.008  # m, largest gap at which two edges may meet in a substep
SHARP = 0.05  # cosine of a joint's angle; neighbours' neighbours may touch only if it is below 0
ROWS = 40  # contacts of a rope in a substep at most
ROUNDS = 60  # of Gauss-Seidel at most
_NEXT = 3  # edges nearer than this along the rope are not in the list
STRETCH = 1.01  # no edge is longer than this times its length


@njit(nogil=True)
def middles(x: Array, middle: Array) -> None:
    """Write the midpoints of the edges."""
    n = len(x)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        for c in range(3):
            put(middle, (i, c), 0.5 * (load(x, (i, c)) + load(x, (j, c))))


@njit(nogil=True)
def list_pairs(middle: Array, within: float, start: Ints, other: Ints) -> None:
    """List the pairs of edges that are near in some lane: i with other[start[i] : start[i + 1]]."""
    n, count, bound = len(middle), 0, within * within
    for i in range(n):
        start[i] = count
        x, y, z = load(middle, (i, 0)), load(middle, (i, 1)), load(middle, (i, 2))
        # Every pair once. The last edges are near the first along the loop, so for i < _NEXT the
        # range ends before those that are within _NEXT of i on the other side.
        for j in range(i + _NEXT, n if i >= _NEXT else n - _NEXT + 1 + i):
            a, b = load(middle, (j, 0)) - x, load(middle, (j, 1)) - y
            c = load(middle, (j, 2)) - z
            if any_below(fma(a, a, fma(b, b, c * c)), bound):
                other[count] = j
                count += 1
    start[n] = count


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
    # Least |w + s u - t v|^2. For endless lines s = (uv vw - uw vv) / det, with det = |u x v|^2;
    # then each place is clamped to its edge, and the other is computed for the clamped one.
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
def find_rows(
    x: Array,
    v: Array,
    tangent: Array,
    middle: Array,
    start: Ints,
    other: Ints,
    step: Array,
    contact: Array,
    length: float,
    motion: Array,
    rows: Array,
    found: Ints,
) -> None:
    """Find the pairs of edges that would overlap at the end of the substep.

    Args:
        x, v: where vertices are, and their velocities without contact.
        tangent, middle: of the edges at x.
        start, other: pairs, as of `list_pairs`.
        step: (1, LANES), seconds.
        contact, length: numbers of the contact; of an edge, metres.
        motion: (n, LANES), overwritten.
        rows: (ROWS, 8, LANES), the contacts, see `layout`; written.
        found: int64 (LANES,), how many rows each lane has; written.
    """
    n = len(x)
    h = load(step, (0,))
    touch = 2.0 * contact[RADIUS]
    spot = np.empty((8, LANES))
    _vertex_most(v, motion)
    found[:] = 0
    close = STRETCH * length + touch
    for i in range(n):
        mx, my, mz = load(middle, (i, 0)), load(middle, (i, 1)), load(middle, (i, 2))
        # Edges meet in the substep only if their midpoints are nearer than an edge's length, a
        # diameter and the way that both go; LOOKAHEAD bounds that way.
        way = fma(h, load(motion, (i,)), close)
        for p in range(start[i], start[i + 1]):
            j = other[p]
            dx, dy = load(middle, (j, 0)) - mx, load(middle, (j, 1)) - my
            dz = load(middle, (j, 2)) - mz
            reach = min(fma(h, load(motion, (j,)), way), close + LOOKAHEAD)
            if any_below(fma(dx, dx, fma(dy, dy, dz * dz)), reach * reach):
                put(spot, (MAY,), -1.0)
                _try_row(x, v, i, j, h, touch, spot, rows, found)
    # Edges i and k with one between them are L apart at least if both joints turn by less than a
    # right angle: |L u + a t + b w|^2 >= L^2 + (a - b)^2 where u . t, u . w >= 0.
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        k = j + 1 if j + 1 < n else 0
        least = sharpness(tangent, i, j, k)
        if any_below(least, SHARP):
            put(spot, (MAY,), least - SHARP)
            _try_row(x, v, i, k, h, touch, spot, rows, found)


@njit(nogil=True)
def _vertex_most(v: Array, most: Array) -> None:
    """Write the larger speed of each edge's two vertices."""
    n = len(v)
    x, y, z = load(v, (0, 0)), load(v, (0, 1)), load(v, (0, 2))
    last = math.sqrt(fma(x, x, fma(y, y, z * z)))
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        x, y, z = load(v, (j, 0)), load(v, (j, 1)), load(v, (j, 2))
        own = math.sqrt(fma(x, x, fma(y, y, z * z)))
        put(most, (i,), max(last, own))
        last = own


@njit(nogil=True)
def _try_row(
    x: Array, v: Array, i: int, j: int, h: Any, touch: float, spot: Array, rows: Array, found: Ints
) -> None:
    """Add a row for edges i and j to the lanes where they would overlap, if spot[MAY] < 0."""
    n = len(x)
    k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
    far, s, t, nx, ny, nz = closest(x, i, j)
    shrink = 1.0 / far
    # Speed at which the nearest points part, along the line between them.
    apart = 0.0 * far
    for c in range(3):
        one = fma(s, load(v, (k, c)) - load(v, (i, c)), load(v, (i, c)))
        two = fma(t, load(v, (m, c)) - load(v, (j, c)), load(v, (j, c)))
        along = shrink * (nx if c == 0 else (ny if c == 1 else nz))
        put(spot, (NORMAL + c,), along)
        apart = fma(along, two - one, apart)
    then = fma(h, apart, far)
    if not any_below(then, touch):
        return
    put(spot, (ON_I,), s)
    put(spot, (ON_J,), t)
    put(spot, (GAP,), far)
    put(spot, (THEN,), then)
    for lane in range(LANES):
        row = found[lane]
        # a vertex belongs to the edge that begins there, so that it makes one row
        inside = spot[ON_I, lane] < 1.0 and spot[ON_J, lane] < 1.0
        near = spot[THEN, lane] < touch and spot[GAP, lane] < touch + LOOKAHEAD
        if inside and near and spot[MAY, lane] < 0.0 and row < ROWS:
            for c in range(GAP + 1):
                rows[row, c, lane] = spot[c, lane]
            rows[row, EDGE_I, lane], rows[row, EDGE_J, lane] = i, j
            found[lane] = row + 1


@njit(nogil=True)
def push_apart(
    rows: Array,
    found: Ints,
    most: int,
    v: Array,
    step: Array,
    contact: Array,
    system: System,
    right: Array,
) -> None:
    """Add what the contact forces do to `right`, which has been substituted forwards.

    With A = L D L^T and y_r = L^-1 J_r^T, the answer of contact q to a unit force at contact r is
    y_q . D^-1 y_r.

    Args:
        rows, found: as of `find_rows`; `most` is the largest of `found`.
        v: velocities without contact.
        step, contact: as of `find_rows`.
        system: as `banded.factor` left it.
        right: (n + 1, 4, LANES), changed in place.
    """
    n, diag, corner = len(v), system[0], system[4]
    # L^-1 J^T of all contacts, D^-1 L^-1 J^T of one, and J A^-1 J^T.
    column = np.zeros((most, n + 1, 4, LANES))
    scaled = np.zeros((n + 1, 4, LANES))
    weight = np.empty((most, most, LANES))
    speed = np.zeros((most, LANES))
    force = np.zeros((most, LANES))
    for r in range(most):
        first = n
        for lane in range(LANES):
            if r < found[lane]:
                i, j = int(rows[r, EDGE_I, lane]), int(rows[r, EDGE_J, lane])
                k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
                s, t = rows[r, ON_I, lane], rows[r, ON_J, lane]
                # The point at s of edge i moves at (1 - s) v_i + s v_k, so J has -(1 - s) n and
                # -s n there, and (1 - t) n and t n at the other edge. Vertex 0 is the corner,
                # block n.
                for vertex, share in ((i, s - 1.0), (k, -s), (j, 1.0 - t), (m, t)):
                    block = vertex if vertex > 0 else n
                    first = min(first, block)
                    for c in range(3):
                        own = share * rows[r, NORMAL + c, lane]
                        column[r, block, c, lane] += own
                        speed[r, lane] += own * v[vertex, c, lane]
        forward(system, column[r], first)
        for i in range(first, n):
            for c, e in enumerate(DIAGONAL):
                put(scaled, (i, c), load(column, (r, i, c)) * load(diag, (i, e)))
        for c, e in enumerate(CORNER_DIAGONAL):
            put(scaled, (n, c), load(column, (r, n, c)) * load(corner, (e,)))
        for q in range(r + 1):
            # Two sums side by side, so that the processor doesn't wait for each; their order is
            # fixed.
            a, b = 0.0 * load(step, (0,)), 0.0 * load(step, (0,))
            for i in range(first, n + 1):
                a = fma(load(scaled, (i, 0)), load(column, (q, i, 0)), a)
                b = fma(load(scaled, (i, 1)), load(column, (q, i, 1)), b)
                a = fma(load(scaled, (i, 2)), load(column, (q, i, 2)), a)
                b = fma(load(scaled, (i, 3)), load(column, (q, i, 3)), b)
            put(weight, (r, q), a + b)
            put(weight, (q, r), a + b)
    for lane in range(LANES):
        _solve_forces(rows, found[lane], lane, step[0, lane], contact, weight, speed, force)
    for r in range(most):
        own = load(force, (r,))
        for i in range(n + 1):
            for c in range(4):
                put(right, (i, c), fma(own, load(column, (r, i, c)), load(right, (i, c))))


@njit(nogil=True)
def _solve_forces(
    rows: Array,
    count: int,
    lane: int,
    h: float,
    contact: Array,
    weight: Array,
    speed: Array,
    force: Array,
) -> None:
    """Find the forces of a lane's contacts, see the module, by projected Gauss-Seidel.

    Each is a falling function of its own speed u = u' + w f, u' being what the others make of it,
    so that f = c0 - c1 u is solved by f = (c0 - c1 u') / (1 + c1 w).
    """
    slope = contact[STIFFNESS] * h + contact[DAMPING]
    for _ in range(ROUNDS):
        change = 0.0
        for r in range(count):
            without = speed[r, lane]
            for q in range(count):
                if q != r:
                    without += weight[r, q, lane] * force[q, lane]
            own, distance = weight[r, r, lane], rows[r, GAP, lane]
            gap = distance - 2.0 * contact[RADIUS]
            if gap > 0.0:
                soft = -slope * (gap / h + without) / (1.0 + slope * own)
            else:
                soft = -(contact[STIFFNESS] * gap + slope * without) / (1.0 + slope * own)
            # What keeps the distance at FLOOR at the end of the substep, whatever pulls.
            hard = (-(distance - contact[FLOOR]) / h - without) / own
            new = max(0.0, max(soft, hard))
            change = max(change, abs(new - force[r, lane]))
            force[r, lane] = new
        if change < 1e-9:
            break


@njit(nogil=True)
def sharpness(tangent: Array, i: int, j: int, k: int) -> Any:
    """The smaller cosine of the angles between edge j and its neighbours i and k."""
    x, y, z = load(tangent, (j, 0)), load(tangent, (j, 1)), load(tangent, (j, 2))
    one = fma(load(tangent, (i, 0)), x, fma(load(tangent, (i, 1)), y, load(tangent, (i, 2)) * z))
    two = fma(load(tangent, (k, 0)), x, fma(load(tangent, (k, 1)), y, load(tangent, (k, 2)) * z))
    return min(one, two)
