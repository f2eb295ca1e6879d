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
benchmarks/passages.py`: no strand passes another.
"""

from typing import Any

import numpy as np

from knotgym.common import Array, Ids, inlined, inner
from knotgym.rope.chain import layout
from knotgym.rope.chain.banded import System, forward
from knotgym.rope.chain.layout import Physics
from knotgym.rope.chain.simd import LANES, any_below, fma, load, put, where_below
from knotgym.rope.chain.vectors import along, dot, minus, norm, vector

# pairs of edges: `start` (n + 1,) and `other`, i with each of other[start[i] : start[i + 1]]
Pairs = tuple[Ids, Ids]

# LISTED and DRIFT trade the length of the list against how often it is made, and change no result
# (`python benchmarks/chain.py speed`); `passage.longest_edge` says for which edges they are wide
# enough.
LISTED = 0.048  # m, between midpoints
DRIFT = 0.004  # m
# The fastest vertex of a substep may move further, 11 mm at full force (median): what is missed so,
# the proof of passage rejects, and the substep is tried again with half its length.
LOOKAHEAD = 0.008  # m, largest gap at which two edges may meet in a substep
SHARP = 0.05  # cosine of a joint's angle; neighbours' neighbours may touch only if it is below 0
# Sizes, not tuned: under full force, shipped states of three and four crossings have 5 contacts on
# average and 9 at most. A rope with more keeps the first ROWS, and forces that haven't settled to
# 1e-9 N after ROUNDS are taken as they are; the proof decides whether either mattered.
ROWS = 40  # contacts of a rope in a substep at most
ROUNDS = 60  # of Gauss-Seidel at most
_NEXT = 3  # edges nearer than this along the rope are not in the list
STRETCH = 1.01  # no edge is longer than this times its length; `judge` rejects 0.1 % already


@inner
def middles(x: Array, middle: Array) -> None:
    """Write the midpoints of the edges."""
    n = len(x)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        for c in range(3):
            put(middle, (i, c), 0.5 * (load(x, (i, c)) + load(x, (j, c))))


@inner
def list_pairs(middle: Array, within: float, pairs: Pairs) -> None:
    """Write the pairs of edges whose midpoints are near in some lane."""
    start, other = pairs
    n, count, bound = len(middle), 0, within * within
    for i in range(n):
        start[i] = count
        here = vector(middle, i)
        # Every pair once. The last edges are near the first along the loop, so for i < _NEXT the
        # range ends before those that are within _NEXT of i on the other side.
        for j in range(i + _NEXT, n if i >= _NEXT else n - _NEXT + 1 + i):
            apart = minus(vector(middle, j), here)
            if any_below(dot(apart, apart), bound):
                other[count] = j
                count += 1
    start[n] = count


@inner
def closest(x: Array, i: int, j: int) -> Any:
    """Distance of edges i and j, and what leads to it (Ericson, Real-Time Collision Detection,
    5.1.9).

    Returns:
        The distance; the place of the nearest points along either edge, 0 to 1; the vector from
        the one to the other.
    """
    n = len(x)
    k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
    start, other = vector(x, i), vector(x, j)
    u, v, w = minus(vector(x, k), start), minus(vector(x, m), other), minus(start, other)
    uu, vv, uv, uw, vw = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w)
    # Least |w + s u - t v|^2. For endless lines s = (uv vw - uw vv) / det, with det = |u x v|^2;
    # then each place is clamped to its edge, and the other is computed for the clamped one.
    both = uu * vv
    det = fma(-uv, uv, both)
    s = min(max(fma(uv, vw, -uw * vv) / max(det, 1e-30), 0.0), 1.0)
    s = where_below(det, 1e-12 * both, 0.5, s)  # parallel: any will do
    free = fma(uv, s, vw) / vv
    t = min(max(free, 0.0), 1.0)
    # An end of the other edge is nearest: the nearest point to it. Where t wasn't clamped, s is
    # kept to the bit, which is what the comparison with 1e-300 says of a difference of exactly 0.
    s = where_below(abs(free - t), 1e-300, s, min(max(fma(uv, t, -uw) / uu, 0.0), 1.0))
    to = along(along((-w[0], -w[1], -w[2]), -s, u), t, v)
    return norm(to), s, t, to


@inner
def find_rows(
    x: Array,
    v: Array,
    tangent: Array,
    middle: Array,
    pairs: Pairs,
    step: Array,
    physics: Physics,
    motion: Array,
    rows: Array,
    counts: Ids,
) -> None:
    """Find the pairs of edges that would overlap at the end of the substep.

    Args:
        x, v: where vertices are, and their velocities without contact.
        tangent, middle: of the edges at x.
        pairs: as of `list_pairs`.
        step: (1, LANES), seconds.
        physics: of the rope.
        motion: (n, LANES), overwritten.
        rows: (ROWS, 8, LANES), the contacts, see `layout`; written.
        found: int64 (LANES,), how many rows each lane has; written.
    """
    n, (start, other) = len(x), pairs
    h = load(step, (0,))
    touch, length = 2.0 * physics.radius, physics.length
    spot = np.empty((8, LANES))
    _vertex_most(v, motion)
    counts[:] = 0
    close = STRETCH * length + touch
    # Cheap tests first: of 466 pairs listed for four tangled ropes, midpoints leave at most 102,
    # and only those are worth the divisions of `closest`.
    for i in range(n):
        here = vector(middle, i)
        # Edges meet in the substep only if their midpoints are nearer than an edge's length, a
        # diameter and the way that both go; LOOKAHEAD bounds that way.
        way = fma(h, load(motion, (i,)), close)
        for p in range(start[i], start[i + 1]):
            j = other[p]
            apart = minus(vector(middle, j), here)
            reach = min(fma(h, load(motion, (j,)), way), close + LOOKAHEAD)
            if any_below(dot(apart, apart), reach * reach):
                put(spot, (layout.MAY,), -1.0)
                _try_row(x, v, i, j, h, touch, spot, rows, counts)
    # Edges i and k with one between them are L apart at least if both joints turn by less than a
    # right angle: |L u + a t + b w|^2 >= L^2 + (a - b)^2 where u . t, u . w >= 0.
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        k = j + 1 if j + 1 < n else 0
        least = sharpness(tangent, i, j, k)
        if any_below(least, SHARP):
            put(spot, (layout.MAY,), least - SHARP)
            _try_row(x, v, i, k, h, touch, spot, rows, counts)


@inlined
def _vertex_most(v: Array, most: Array) -> None:
    """Write the larger speed of each edge's two vertices."""
    n = len(v)
    last = norm(vector(v, np.int64(0)))  # a literal would be a type of its own, and compile twice
    for i in range(n):
        speed = norm(vector(v, i + 1 if i + 1 < n else 0))
        put(most, (i,), max(last, speed))
        last = speed


@inner
def _try_row(
    x: Array, v: Array, i: int, j: int, h: Any, touch: float, spot: Array, rows: Array, counts: Ids
) -> None:
    """Add a row for edges i and j to the lanes where they would overlap, if spot[MAY] < 0."""
    n = len(x)
    k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
    far, s, t, to = closest(x, i, j)
    shrink = 1.0 / far
    # Speed at which the nearest points part, along the line between them.
    parting = 0.0 * far
    for c in range(3):
        one = fma(s, load(v, (k, c)) - load(v, (i, c)), load(v, (i, c)))
        two = fma(t, load(v, (m, c)) - load(v, (j, c)), load(v, (j, c)))
        normal = shrink * to[c]
        put(spot, (layout.NORMAL + c,), normal)
        parting = fma(normal, two - one, parting)
    then = fma(h, parting, far)
    if not any_below(then, touch):
        return
    put(spot, (layout.ON_I,), s)
    put(spot, (layout.ON_J,), t)
    put(spot, (layout.GAP,), far)
    put(spot, (layout.THEN,), then)
    for lane in range(LANES):
        row = counts[lane]
        # a vertex belongs to the edge that begins there, so that it makes one row
        inside = spot[layout.ON_I, lane] < 1.0 and spot[layout.ON_J, lane] < 1.0
        near = spot[layout.THEN, lane] < touch and spot[layout.GAP, lane] < touch + LOOKAHEAD
        if inside and near and spot[layout.MAY, lane] < 0.0 and row < ROWS:
            for c in range(layout.GAP + 1):
                rows[row, c, lane] = spot[c, lane]
            rows[row, layout.EDGE_I, lane], rows[row, layout.EDGE_J, lane] = i, j
            counts[lane] = row + 1


@inner
def push_apart(
    rows: Array,
    counts: Ids,
    most: int,
    v: Array,
    step: Array,
    physics: Physics,
    system: System,
    right: Array,
) -> None:
    """Add what the contact forces do to `right`, which has been substituted forwards.

    With A = L D L^T and y_r = L^-1 J_r^T, the answer of contact q to a unit force at contact r is
    y_q . D^-1 y_r.

    Args:
        rows, found: as of `find_rows`; `most` is the largest of `found`.
        v: velocities without contact.
        step, physics: as of `find_rows`.
        system: as `banded.factor` left it.
        right: (n + 1, 4, LANES), changed in place.
    """
    n, diag = len(v), system[0]
    # L^-1 J^T of all contacts, D^-1 L^-1 J^T of one, and J A^-1 J^T.
    column = np.empty((most, n + 1, 4, LANES))
    scaled = np.empty((n + 1, 4, LANES))
    weight = np.empty((most, most, LANES))
    speed, force = np.empty((most, LANES)), np.empty((most, LANES))
    column[:] = speed[:] = force[:] = 0.0
    for r in range(most):
        first = n
        for lane in range(LANES):
            if r < counts[lane]:
                i, j = int(rows[r, layout.EDGE_I, lane]), int(rows[r, layout.EDGE_J, lane])
                k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
                s, t = rows[r, layout.ON_I, lane], rows[r, layout.ON_J, lane]
                # The point at s of edge i moves at (1 - s) v_i + s v_k, so J has -(1 - s) n and
                # -s n there, and (1 - t) n and t n at the other edge. Vertex 0 is the corner,
                # block n.
                for vertex, share in ((i, s - 1.0), (k, -s), (j, 1.0 - t), (m, t)):
                    block = vertex if vertex > 0 else n
                    first = min(first, block)
                    for c in range(3):
                        own = share * rows[r, layout.NORMAL + c, lane]
                        column[r, block, c, lane] += own
                        speed[r, lane] += own * v[vertex, c, lane]
        # `first`: blocks before the first vertex of the contact stay zero, so substitution and all
        # sums may begin there: a third of the work is saved on average
        forward(system, column[r], first)
        for i in range(first, n + 1):
            for c, e in enumerate(layout.DIAGONAL):
                put(scaled, (i, c), load(column, (r, i, c)) * load(diag, (i, e)))
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
        _solve_forces(rows, counts[lane], lane, step[0, lane], physics, weight, speed, force)
    for r in range(most):
        own = load(force, (r,))
        for i in range(n + 1):
            for c in range(4):
                put(right, (i, c), fma(own, load(column, (r, i, c)), load(right, (i, c))))


@inlined
def _solve_forces(
    rows: Array,
    count: int,
    lane: int,
    h: float,
    physics: Physics,
    weight: Array,
    speed: Array,
    force: Array,
) -> None:
    """Find the forces of a lane's contacts, see the module, by projected Gauss-Seidel.

    Each is a falling function of its own speed u = u' + w f, u' being what the others make of it,
    so that f = c0 - c1 u is solved by f = (c0 - c1 u') / (1 + c1 w).
    """
    slope = physics.contact_stiffness * h + physics.contact_damping
    # One contact after the other, each with the newest forces of the others. The weights are a
    # symmetric, positive semidefinite matrix, so no round raises the energy, projection to f >= 0
    # included. The order is that of the lane's own rows: it doesn't depend on the other lanes.
    for _ in range(ROUNDS):
        change = 0.0
        for r in range(count):
            without = speed[r, lane]
            for q in range(count):
                if q != r:
                    without += weight[r, q, lane] * force[q, lane]
            own, distance = weight[r, r, lane], rows[r, layout.GAP, lane]
            gap = distance - 2.0 * physics.radius
            if gap > 0.0:
                soft = -slope * (gap / h + without) / (1.0 + slope * own)
            else:
                soft = -(physics.contact_stiffness * gap + slope * without) / (1.0 + slope * own)
            # What keeps the distance at FLOOR at the end of the substep, whatever pulls.
            hard = (-(distance - physics.floor) / h - without) / own
            new = max(0.0, max(soft, hard))
            change = max(change, abs(new - force[r, lane]))
            force[r, lane] = new
        if change < 1e-9:
            break


@inner
def sharpness(tangent: Array, i: int, j: int, k: int) -> Any:
    """The smaller cosine of the angles between edge j and its neighbours i and k."""
    middle = vector(tangent, j)
    return min(dot(vector(tangent, i), middle), dot(vector(tangent, k), middle))
