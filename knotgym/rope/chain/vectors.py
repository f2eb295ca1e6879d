"""Vectors of lanes, in compiled code: three `simd.Lanes` as a tuple (x, y, z).

Products are summed from z to x, each rounded once by `fma`, and always in this order: another
one would round otherwise, and recorded episodes would no longer repeat.

After a change run `pytest tests/rope/chain` and `knotgym suite --recorded`: recordings that ship
must be rebuilt to the bit.
"""

import math
from typing import Any

from knotgym.common import Array, inner
from knotgym.rope.chain.simd import fma, load, put

Vector = tuple[Any, Any, Any]  # lanes


@inner
def vector(array: Array, i: int) -> Vector:
    """Load row i of an array (n, 3, LANES)."""
    return load(array, (i, 0)), load(array, (i, 1)), load(array, (i, 2))


@inner
def put_vector(array: Array, i: int, a: Vector) -> None:
    """Write row i of an array (n, 3, LANES)."""
    put(array, (i, 0), a[0])
    put(array, (i, 1), a[1])
    put(array, (i, 2), a[2])


@inner
def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def along(a: Vector, way: Any, b: Vector) -> Vector:
    """Return a + way * b."""
    # one rounding for each component, where a product and a sum would take two
    return fma(way, b[0], a[0]), fma(way, b[1], a[1]), fma(way, b[2], a[2])


@inner
def dot(a: Vector, b: Vector) -> Any:
    """Return a . b."""
    # z first: the innermost product is the only one that is rounded by itself
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inner
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return (
        # the second product is rounded, the first is not; both orders are right, this one is
        # recorded
        fma(a[1], b[2], -a[2] * b[1]),
        fma(a[2], b[0], -a[0] * b[2]),
        fma(a[0], b[1], -a[1] * b[0]),
    )


@inner
def norm(a: Vector) -> Any:
    """Return |a|."""
    return math.sqrt(dot(a, a))


@inner
def unit(a: Vector) -> Vector:
    """Return a / |a|."""
    # One division instead of three; the length is 1 up to a few roundings.
    shrink = 1.0 / norm(a)
    return shrink * a[0], shrink * a[1], shrink * a[2]
