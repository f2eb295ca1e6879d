"""Exact signs for the search of crossings: sides of lines, orders of crossings, orders of heights.

`side` tells on which side of a line a point lies, and never that it lies on the line. The sign of a
2 x 2 determinant is computed in floating point where an error bound guarantees it, and in exact
expansion arithmetic otherwise (J. R. Shewchuk, "Adaptive Precision Floating-Point Arithmetic and
Fast Robust Geometric Predicates", 1997). If the determinant is exactly zero, the tie is broken
symbolically, as if bead k were moved in x and then in y by amounts each infinitely smaller than all
before (H. Edelsbrunner and E. P. Muecke, "Simulation of Simplicity", 1990). All answers together
are then those of one curve in general position, so a strand that passes exactly over a bead is
counted once.

`line_order` and `height_order` compare quotients of such determinants without dividing. Callers ask
them where floating point can't tell. All are exact unless a product over- or underflows.

After a change run `pytest tests/topology/test_crossings.py`.
"""

import numpy as np

from knotgym.common import inlined, inner

HALF_ULP = 2.0**-53  # rounding error of one operation, relative
# Shewchuk's ccwerrboundA: |error of the determinant| <= FILTER * (|left| + |right|)
FILTER = (3.0 + 16.0 * HALF_ULP) * HALF_ULP
_SPLITTER = 2.0**27 + 1.0  # splits the 53 bits of a float64 into two halves that multiply exactly
_NONE = np.int64(
    0
)  # floats of an empty expansion; for a plain 0 numba compiles variants of its own


@inner
def side(points: np.ndarray, a: int, b: int, c: int) -> int:
    """Return on which side bead c lies, seen along the line from bead a to bead b.

    Args:
        points: float64 (n, 2 or more); x and y are used.
        a, b, c: three different rows.

    Returns:
        +1 on the left, -1 on the right.
    """
    # (a - c) x (b - c), which has the sign of (b - a) x (c - a)
    left = (points[a, 0] - points[c, 0]) * (points[b, 1] - points[c, 1])
    right = (points[a, 1] - points[c, 1]) * (points[b, 0] - points[c, 0])
    determinant = left - right
    bound = FILTER * (abs(left) + abs(right))
    if determinant > bound:
        return 1
    if determinant < -bound:
        return -1
    sign: int = _sign(_area(points, a, b, c))
    if sign == 0:
        sign = _tie(points, a, b, c)
    return sign


@inlined
def _tie(points: np.ndarray, a: int, b: int, c: int) -> int:
    """Break a tie by the first perturbation term that doesn't vanish.

    The determinant of the perturbed beads is a polynomial in the infinitesimal moves. Its terms are
    looked at from the largest down; each is the determinant's derivative by one move.
    """
    # Sort the rows, counting swaps: a move of a lower row is infinitely larger.
    sign = 1
    if a > b:
        a, b, sign = b, a, -sign
    if b > c:
        b, c, sign = c, b, -sign
    if a > b:
        a, b, sign = b, a, -sign
    if points[b, 1] != points[c, 1]:  # d/d(a_x) = b_y - c_y
        return sign if points[b, 1] > points[c, 1] else -sign
    if points[b, 0] != points[c, 0]:  # d/d(a_y) = c_x - b_x
        return sign if points[c, 0] > points[b, 0] else -sign
    if points[c, 1] != points[a, 1]:  # d/d(b_x) = c_y - a_y
        return sign if points[c, 1] > points[a, 1] else -sign
    return -sign  # d2/d(a_y) d(b_x) = -1, a constant


@inner
def line_order(points: np.ndarray, after_of: np.ndarray, edge: int, one: int, other: int) -> int:
    """Return 1 if edge `one` crosses `edge` after edge `other` does, -1 if before, 0 if there.

    Edge k leads from bead k to bead after_of[k].

    With B and A the areas that an edge spans with the ends of `edge`, it crosses at the fraction
    B / (B - A), where A and B have other signs, or one is 0.
    """
    end, one_end, other_end = after_of[edge], after_of[one], after_of[other]
    before, after = _area(points, one, one_end, edge), _area(points, one, one_end, end)
    before_2, after_2 = _area(points, other, other_end, edge), _area(points, other, other_end, end)
    total, length = np.empty(4 * 12 * 12), _NONE
    for k in range(len(after)):
        length = _add_product(total, length, before_2, after[k])
    for k in range(len(after_2)):
        length = _add_product(total, length, before, -after_2[k])
    sign: int = _sign(total[:length]) * _way(before, after) * _way(before_2, after_2)
    return sign


@inner
def height_order(points: np.ndarray, after_of: np.ndarray, one: int, other: int) -> int:
    """Return 1 if edge `one` is above edge `other` where they cross, -1 if below, 0 if as high."""
    end, other_end = after_of[one], after_of[other]
    before, after = _area(points, other, other_end, one), _area(points, other, other_end, end)
    before_2, after_2 = _area(points, one, end, other), _area(points, one, end, other_end)
    # Heights are (z_end B - z_start A) / (B - A), and B - A of the two differ in sign alone.
    total = np.empty(4 * 2 * 12)
    length: int = _add_product(total, _NONE, before, points[end, 2])
    length = _add_product(total, length, after, -points[one, 2])
    length = _add_product(total, length, before_2, points[other_end, 2])
    length = _add_product(total, length, after_2, -points[other, 2])
    sign: int = _sign(total[:length]) * _way(before, after)
    return sign


@inner
def _area(points: np.ndarray, a: int, b: int, c: int) -> np.ndarray:
    """Return (b - a) x (c - a), twice the area of a triangle, as an expansion.

    An expansion in Shewchuk's sense is a sum of floats that don't overlap and grow in magnitude.
    Here none is 0, so the last has the sign of the sum, and 0 has no floats.
    """
    ax, ay, bx, by = points[a, 0], points[a, 1], points[b, 0], points[b, 1]
    cx, cy = points[c, 0], points[c, 1]
    factors = (ax, by, -ax, cy, bx, cy, -bx, ay, cx, ay, -cx, by)
    total, length = np.empty(12), _NONE
    for k in range(6):
        high, low = _product(factors[2 * k], factors[2 * k + 1])
        length = _add(total, _add(total, length, low), high)
    return total[:length]


@inner
def _sign(expansion: np.ndarray) -> int:
    if len(expansion) == 0:
        return 0
    return 1 if expansion[-1] > 0.0 else -1


@inner
def _way(before: np.ndarray, after: np.ndarray) -> int:
    """Return the sign of B - A, of which one is 0 or both have other signs."""
    sign: int = _sign(before)
    return sign if sign != 0 else -_sign(after)


@inner
def _add_product(total: np.ndarray, length: int, expansion: np.ndarray, factor: float) -> int:
    """Add a multiple of an expansion to another, and return how long that is then."""
    for k in range(len(expansion)):
        high, low = _product(expansion[k], factor)
        length = _add(total, _add(total, length, low), high)
    return length


@inner
def _add(total: np.ndarray, length: int, carry: float) -> int:
    """Add a float to an expansion, and return how long that is then."""
    kept = 0
    # GROW-EXPANSION: push the float through by TWO-SUM, leaving each rounding error behind
    for m in range(length):
        upper = carry + total[m]
        virtual = upper - carry
        low = (carry - (upper - virtual)) + (total[m] - virtual)
        if low != 0.0:
            total[kept] = low
            kept += 1
        carry = upper
    if carry != 0.0:
        total[kept] = carry
        kept += 1
    return kept


@inner
def _product(u: float, v: float) -> tuple[float, float]:
    """Return u * v exactly, as the rounded product and its rounding error (Dekker, Veltkamp)."""
    high = u * v
    # Veltkamp's split: u = u_high + u_low, each with at most 26 bits
    scaled = _SPLITTER * u
    u_high = scaled - (scaled - u)
    u_low = u - u_high
    scaled = _SPLITTER * v
    v_high = scaled - (scaled - v)
    v_low = v - v_high
    low = u_low * v_low - (((high - u_high * v_high) - u_low * v_high) - u_high * v_low)
    return high, low
