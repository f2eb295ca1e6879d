"""The proof that no strands passed through each other in a substep.

Let vertices move on straight lines in a substep, and two edges be d0 apart when it begins and d1
when it ends. A point of one moves by at most m against a point of the other, m being the largest
such motion of their vertices. At time t in [0, 1] their distance is at least d0 - t m and at least
d1 - (1 - t) m; if d0 + d1 > m, one of the two is positive at all times and the edges never met. A
substep is accepted only if this holds for all pairs of edges that aren't neighbours. Then the
polyline was moved by an isotopy, and the knot is the same. (Neighbours share a vertex; they could
only meet by folding flat onto each other, which a motion misses.)

After a change run `pytest -m thorough tests/rope/chain/test_chain_equations.py`: what is accepted
must be proved for every pair of edges; then `python benchmarks/passages.py`: no passage,
and no knot changes.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, inner
from knotgym.rope.chain.contact import (
    DRIFT,
    LISTED,
    LOOKAHEAD,
    SHARP,
    STRETCH,
    Pairs,
    closest,
    list_pairs,
    middles,
    sharpness,
)
from knotgym.rope.chain.simd import LANES, any_below, fma, load, put, where_below
from knotgym.rope.chain.vectors import dot, minus, norm, vector

# Edges not listed are LISTED - L = 34.6 mm apart when the list is made and 34.6 - 2 DRIFT = 26.6 mm
# when a substep begins: out of reach of contact, and they can't meet if vertices move by < 13.3 mm.
# These follow from each other for the usual edge of 13.3 mm, as said; none is tuned. At full force
# the pulled bead moves by 48 mm in an action on average, and by 16 mm at most in a substep.
USUAL_MOVE = 0.013  # m: if a vertex moves further, all pairs within FAR_APART are checked
FAR_APART = 0.080  # m; 80 mm - L > 2 MOST_MOVE
MOST_MOVE = 0.022  # m, that a vertex may move in one substep
SAFE = 1e-5  # m, margin of the proof; rounding is below 1e-12


def longest_edge(radius: float) -> float:
    """The longest edge, metres, for which the distances above prove what they are meant to."""
    # Midpoints of pairs that aren't listed are LISTED apart at least, and their edges at least an
    # edge's length less. By the time that a substep begins both may have come nearer by DRIFT. What
    # is then left must be more than both can move, USUAL_MOVE each, and more than contact reaches.
    # The same for the wide list and MOST_MOVE.
    listed = LISTED - 2.0 * DRIFT - max(2.0 * USUAL_MOVE, 2.0 * radius + LOOKAHEAD)
    return min(listed, FAR_APART - 2.0 * MOST_MOVE) / STRETCH


@inner
def judge(
    x: Array,
    new: Array,
    tangent: Array,
    middle: Array,
    motion: Array,
    pairs: Pairs,
    wider: Pairs,
    length: float,
    accepted: NDArray[np.bool_],
) -> None:
    """Decide for each lane whether a substep may be taken, see the module.

    Args:
        x, new: where vertices are and would be.
        tangent: of the edges at x.
        middle, motion: (n, 3, LANES) and (n, LANES), overwritten.
        pairs: as of `list_pairs`.
        wider: for more pairs, overwritten.
        length: of an edge, metres.
        accepted: bool (LANES,); written. False too where something is not finite, a vertex would
            move by MOST_MOVE or an edge's length be off by 0.1 %.
    """
    n = len(x)
    turn, spot = np.empty((n, LANES)), np.empty((2, LANES))
    widest, worst = 0.0 * load(x, (0, 0)), 0.0 * load(x, (0, 0))
    move = minus(vector(new, np.int64(0)), vector(x, np.int64(0)))
    last = norm(move)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        after = minus(vector(new, j), vector(x, j))
        speed = norm(after)
        put(motion, (i,), max(last, speed))
        widest = where_below(speed, widest, widest, speed)  # max() would pass by a NaN
        put(turn, (i,), norm(minus(after, move)))
        e = minus(vector(new, j), vector(new, i))
        off = abs(fma(e[0], e[0], fma(e[1], e[1], fma(e[2], e[2], -length * length))))
        worst = where_below(off, worst, worst, off)
        move, last = after, speed
    put(spot, (0,), widest)
    put(spot, (1,), worst)
    # both comparisons are false at a NaN, so a lane that isn't finite is rejected here
    for lane in range(LANES):
        accepted[lane] = spot[0, lane] < MOST_MOVE and spot[1, lane] < 2e-3 * length * length
    # The list was made for slow vertices; a fast one needs a wider one, which all lanes then share.
    # That changes nothing for the slow: their other pairs are too far apart to be rejected.
    if any_below(-widest, -USUAL_MOVE):
        middles(x, middle)
        list_pairs(middle, FAR_APART, wider)
        pairs = wider
    start, other = pairs
    middles(new, middle)
    for i in range(n):
        speed = vector(middle, i)
        way = load(motion, (i,)) + (STRETCH * length + SAFE)
        for p in range(start[i], start[i + 1]):
            j = other[p]
            apart = minus(vector(middle, j), speed)
            # d1 > m already, by the midpoints alone, unless they are nearer than this
            reach = way + load(motion, (j,))
            if any_below(dot(apart, apart), reach * reach):
                _check(x, new, i, j, spot, accepted)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        k = j + 1 if j + 1 < n else 0
        # d0 = L where no joint is sharp, see `contact.find_rows`, and m is at most the sum of the
        # three edges' changes
        most = load(turn, (i,)) + load(turn, (j,)) + load(turn, (k,))
        if any_below(-most, -0.5 * length) or any_below(sharpness(tangent, i, j, k), SHARP):
            _check(x, new, i, k, spot, accepted)


@inner
def _relative_motion(x: Array, new: Array, i: int, j: int) -> Any:
    """How far a point of edge i moves against a point of edge j at most, as vertices move straight.

    Both points' motions are mixtures of their vertices', so the largest is between two vertices.
    """
    n, most = len(x), 0.0 * load(x, (i, 0))
    # Four differences of vertices bound the motion of all points: it is bilinear in both places.
    for p in (i, i + 1 if i + 1 < n else 0):
        one = minus(vector(new, p), vector(x, p))
        for q in (j, j + 1 if j + 1 < n else 0):
            way = minus(one, minus(vector(new, q), vector(x, q)))
            most = max(most, dot(way, way))
    return math.sqrt(most)


@inner
def _check(x: Array, new: Array, i: int, j: int, spot: Array, accepted: NDArray[np.bool_]) -> None:
    """Reject the lanes where it isn't proved that edges i and j didn't meet."""
    # d0 + d1 > m, with a margin for rounding; a NaN fails the comparison, too
    both = closest(x, i, j)[0] + closest(new, i, j)[0]
    put(spot, (0,), both - _relative_motion(x, new, i, j))
    for lane in range(LANES):
        if not spot[0, lane] > SAFE:
            accepted[lane] = False
