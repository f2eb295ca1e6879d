"""Exact orientation test: on which side of a line a point lies, never on the line itself.

The sign of a 2 x 2 determinant is computed in floating point where an error bound guarantees it,
and in exact expansion arithmetic otherwise (J. R. Shewchuk, "Adaptive Precision Floating-Point
Arithmetic and Fast Robust Geometric Predicates", 1997). If the determinant is exactly zero, the tie
is broken symbolically, as if bead k were moved in x and then in y by amounts each infinitely
smaller than all before (H. Edelsbrunner and E. P. Muecke, "Simulation of Simplicity", 1990). All
answers together are then those of one curve in general position, so a strand that passes exactly
over a bead is counted once. The test is exact unless a product of two coordinates over- or
underflows.

After a change run `pytest tests/topology/test_crossings.py`: a sign must be that of exact
arithmetic, for points that lie on a line, too.
"""

import numpy as np

from knotgym.common import inner

_HALF_ULP = 2.0**-53  # rounding error of one operation, relative
# Shewchuk's ccwerrboundA: |error of the determinant| <= _FILTER * (|left| + |right|)
_FILTER = (3.0 + 16.0 * _HALF_ULP) * _HALF_ULP
_SPLITTER = 2.0**27 + 1.0  # splits the 53 bits of a float64 into two halves that multiply exactly


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
    bound = _FILTER * (abs(left) + abs(right))
    if determinant > bound:
        return 1
    if determinant < -bound:
        return -1
    sign: int = _exact_sign(
        points[a, 0], points[a, 1], points[b, 0], points[b, 1], points[c, 0], points[c, 1]
    )
    if sign == 0:
        sign = _tie(points, a, b, c)
    return sign


@inner
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
def _exact_sign(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> int:
    """Return the exact sign of (b - a) x (c - a).

    The determinant is expanded into six products, ax by - ax cy + bx cy - bx ay + cx ay - cx by.
    Each is held as a sum of two floats, and the twelve floats are added without rounding.
    """
    factors = (ax, by, -ax, cy, bx, cy, -bx, ay, cx, ay, -cx, by)
    # An expansion in Shewchuk's sense: its floats don't overlap and grow in magnitude, so the last
    # one that isn't zero has the sign of the sum.
    total = np.zeros(12)
    length = 0
    for k in range(6):
        high, low = _product(factors[2 * k], factors[2 * k + 1])
        for part in (low, high):
            # GROW-EXPANSION: push `part` through by TWO-SUM, leaving each rounding error behind
            carry = part
            for m in range(length):
                upper = carry + total[m]
                virtual = upper - carry
                total[m] = (carry - (upper - virtual)) + (total[m] - virtual)
                carry = upper
            total[length] = carry
            length += 1
    for m in range(length - 1, -1, -1):
        if total[m] != 0.0:
            return 1 if total[m] > 0.0 else -1
    return 0


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
