"""On which side of a line a point lies, decided exactly and never "on it".

The sign of a 2 x 2 determinant is taken in floating point where an error bound vouches for it and
in exact expansion arithmetic elsewhere (J. R. Shewchuk, "Adaptive Precision Floating-Point
Arithmetic and Fast Robust Geometric Predicates", 1997). A true zero is broken as if bead k had been
moved in x and then in y by amounts that are each infinitely smaller than any before (H.
Edelsbrunner and E. P. Muecke, "Simulation of Simplicity", 1990): all answers together are those of
one curve in general position, so a strand that passes exactly over a bead is counted once. Exact as
long as no product of two coordinates over- or underflows.
"""

import numpy as np
from numba import njit

_HALF_ULP = 2.0**-53
_FILTER = (3.0 + 16.0 * _HALF_ULP) * _HALF_ULP
_SPLITTER = 2.0**27 + 1.0


@njit(cache=True, nogil=True)
def side(points: np.ndarray, a: int, b: int, c: int) -> int:
    """Say where bead c lies, seen along the line from bead a to bead b.

    Args:
        points: float64 (n, 2 or more); x and y are used.
        a, b, c: three different rows.

    Returns:
        +1 on the left, -1 on the right.
    """
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


@njit(cache=True, nogil=True)
def _tie(points: np.ndarray, a: int, b: int, c: int) -> int:
    """Break a zero: the first coefficient that does not vanish, in order of size of the moves."""
    sign = 1
    if a > b:
        a, b, sign = b, a, -sign
    if b > c:
        b, c, sign = c, b, -sign
    if a > b:
        a, b, sign = b, a, -sign
    if points[b, 1] != points[c, 1]:  # of the move of a in x
        return sign if points[b, 1] > points[c, 1] else -sign
    if points[b, 0] != points[c, 0]:  # of a in y
        return sign if points[c, 0] > points[b, 0] else -sign
    if points[c, 1] != points[a, 1]:  # of b in x
        return sign if points[c, 1] > points[a, 1] else -sign
    return -sign  # of a in y times b in x: constant


@njit(cache=True, nogil=True)
def _exact_sign(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> int:
    """The sign of (b - a) x (c - a), exactly.

    Six products, each kept as a sum of two floats, are added without rounding.
    """
    factors = (ax, by, -ax, cy, bx, cy, -bx, ay, cx, ay, -cx, by)
    total = np.zeros(12)  # an expansion: its parts do not overlap and grow in size
    length = 0
    for k in range(6):
        high, low = _product(factors[2 * k], factors[2 * k + 1])
        for part in (low, high):
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


@njit(cache=True, nogil=True)
def _product(u: float, v: float) -> tuple[float, float]:
    """u * v exactly, as its float and what rounding lost (Dekker)."""
    high = u * v
    scaled = _SPLITTER * u
    u_high = scaled - (scaled - u)
    u_low = u - u_high
    scaled = _SPLITTER * v
    v_high = scaled - (scaled - v)
    v_low = v - v_high
    low = u_low * v_low - (((high - u_high * v_high) - u_low * v_high) - u_high * v_low)
    return high, low
