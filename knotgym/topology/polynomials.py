"""The Alexander and Jones polynomials of a diagram, in exact integers.

A polynomial with integer coefficients is evaluated at a power of two so large that its coefficients
can be read off the digits of the resulting integer (Kronecker substitution). Determinants and state
sums are then ordinary integer arithmetic.

Conventions: the Alexander polynomial is symmetric and 1 at t = 1. The Jones polynomial is in t, and
that of the right-handed trefoil is t + t^3 - t^4.

After a change run `pytest tests/topology/test_knots.py`: all 249 knots of the table must keep their
names, and hard unknots stay unknots.
"""

from functools import lru_cache

from knotgym.topology.diagrams import with_chirality
from knotgym.topology.gauss import GaussCode
from knotgym.topology.notation import pd_code

JonesPolynomial = tuple[tuple[int, int], ...]  # (power of t, coefficient), lowest power first

Matching = frozenset[tuple[int, int]]  # pairs of frontier edges that are joined by an arc


@lru_cache(maxsize=65536)
def alexander_polynomial(code: GaussCode) -> tuple[int, ...]:
    """Return the coefficients of the Alexander polynomial, lowest power first.

    Args:
        code: a planar code; without chirality it gets one from `diagrams.with_chirality`.

    Raises:
        InvalidInput: no closed curve shows the code.

    >>> alexander_polynomial(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))  # trefoil
    (1, -1, 1)
    """
    code = with_chirality(code)
    size = code.nx - 1  # of the matrix
    if size < 1:
        return (1,)
    # The entries of a row are 1 - t, t and -1, whose coefficients have absolute values that sum to
    # at most 4. So no coefficient of the determinant exceeds 4 ** size = 2 ** (2 size), and 2 more
    # bits hold its sign.
    digits = 2 * size + 2
    coefficients = _digits(_determinant(_alexander_matrix(code, 1 << digits)), digits)
    # The determinant is the polynomial up to a unit +-t^k: drop the power, then fix the sign.
    while coefficients[0] == 0:
        del coefficients[0]
    sign = 1 if sum(coefficients) > 0 else -1
    return tuple([sign * coefficient for coefficient in coefficients])


@lru_cache(maxsize=65536)
def jones_polynomial(code: GaussCode) -> JonesPolynomial:
    """Return the nonzero (power of t, coefficient) pairs of the Jones polynomial.

    The Kauffman bracket is summed crossing by crossing over a moving frontier, so the time grows
    with the width of the diagram and not with 2 ** n.

    Args:
        code: a planar code; without chirality it gets one from `diagrams.with_chirality`, and the
            polynomial is known up to mirrored summands.

    Raises:
        InvalidInput: no closed curve shows the code.

    >>> jones_polynomial(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))  # right-handed trefoil
    ((1, 1), (3, 1), (4, -1))
    """
    code = with_chirality(code)
    if not code.nx:
        return ((0, 1),)
    # The bracket is a Laurent polynomial in A. Each of the 2 ** n smoothings has at most n + 1
    # loops of two terms each, so at most 2 * 4 ** n terms add up in a coefficient. A weight is the
    # value of A^lowest times such a polynomial at A = 2 ** digits. `lowest` makes all powers
    # non-negative: n crossings contribute at least A^-n, n + 1 loops at least A^(-2 n - 2).
    digits, lowest = 2 * code.nx + 3, 3 * code.nx + 2
    # A state is a matching of the edges that enter the part of the diagram already summed. States
    # with the same matching continue in the same way, so their weights are added up.
    states: dict[Matching, int] = {frozenset(): 1 << digits * lowest}
    # a PD code names the edges counterclockwise from the incoming lower one, which goes north
    for left, corners in zip(range(code.nx)[::-1], _sweep(pd_code(code)), strict=True):
        new: dict[Matching, int] = {}
        for matching, weight in states.items():
            south, east, north, west = corners
            for joints, term in (
                # A: join the regions swept by turning the upper strand counterclockwise;
                # 1 / A: join those swept by turning it clockwise
                (((south, east), (north, west)), weight << digits),
                (((south, west), (north, east)), weight >> digits),
            ):
                joined, loops = _joined(matching, joints)
                # a closed loop is a factor -A^2 - A^-2, but for one, which the last crossing closes
                for _ in range(loops - (not left)):
                    term = -(term << 2 * digits) - (term >> 2 * digits)
                new[joined] = new.get(joined, 0) + term
        states = new
    # normalize: multiply by (-A^3)^-writhe, and substitute t = A^-4
    writhe = sum(code.signs)
    sign, shift = (-1 if writhe % 2 else 1), lowest + 3 * writhe
    bracket = enumerate(_digits(states[frozenset()], digits))
    return tuple(sorted((-(power - shift) // 4, sign * value) for power, value in bracket if value))


def _digits(number: int, digits: int) -> list[int]:
    """Return a polynomial's coefficients, lowest first, from its value at 2 ** digits.

    Digits are balanced, in [-half, half), because coefficients may be negative.
    """
    half, mask = 1 << (digits - 1), (1 << digits) - 1
    coefficients = []
    while number:
        coefficient = ((number + half) & mask) - half
        coefficients.append(coefficient)
        number = (number - coefficient) >> digits
    return coefficients


def _alexander_matrix(code: GaussCode, t: int) -> list[list[int]]:
    """Return Fox's matrix at t without its last row and column.

    Rows are crossings and columns are arcs, which run from one under-visit to the next. With i the
    arc over a positive crossing, j the arc that arrives under it and k the one that leaves, the row
    is (1 - t) i + t j - k; at a negative crossing j and k change places.
    """
    arc = 0
    over = [0] * code.nx
    before = [0] * code.nx
    for visit in code.visits:
        if visit > 0:
            over[visit - 1] = arc
        else:
            before[-visit - 1] = arc
            arc = (arc + 1) % code.nx
    matrix = []
    for label, sign in enumerate(code.signs[:-1]):
        row = [0] * code.nx
        # added, as an arc may meet itself at a crossing
        row[over[label]] += 1 - t
        after = (before[label] + 1) % code.nx
        row[before[label]] += t if sign > 0 else -1
        row[after] += -1 if sign > 0 else t
        matrix.append(row[:-1])
    return matrix


def _determinant(matrix: list[list[int]]) -> int:
    """Return the determinant by Bareiss's fraction-free elimination; overwrites the matrix.

    Every entry stays an integer: after step k it is a minor of order k + 2 of the original matrix,
    so the division by the previous pivot is exact.
    """
    size, sign, previous = len(matrix), 1, 1
    for k in range(size - 1):
        # there is one, because the Alexander polynomial of a knot is never 0 (it is 1 at t = 1)
        pivot_row = next(row for row in range(k, size) if matrix[row][k])
        if pivot_row != k:
            matrix[k], matrix[pivot_row], sign = matrix[pivot_row], matrix[k], -sign
        top = matrix[k]
        pivot = top[k]
        for row in matrix[k + 1 :]:
            factor = row[k]
            for column in range(k + 1, size):
                row[column] = (row[column] * pivot - factor * top[column]) // previous
        previous = pivot
    return sign * matrix[-1][-1]


def _sweep(corners: list[list[int]]) -> list[list[int]]:
    """Order the crossings greedily so that the frontier stays small.

    The frontier is the set of edges between crossings that come earlier and later. The next
    crossing is always one with the most edges in it.
    """
    left = list(corners)
    frontier: set[int] = set()
    order = []
    while left:
        crossing = max(left, key=lambda edges: len(frontier.intersection(edges)))
        left.remove(crossing)
        order.append(crossing)
        for edge in crossing:  # an edge enters at its first end and leaves at its second
            frontier ^= {edge}
    return order


def _joined(
    matching: Matching, joints: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[Matching, int]:
    """Smooth one crossing: join two pairs of its edges.

    Returns:
        The new matching of the frontier, and the number of loops that closed.
    """
    partner: dict[int, int] = {}
    for one, other in matching:
        partner[one], partner[other] = other, one
    loops = 0
    for one, other in joints:
        if one == other or partner.get(one) == other:  # both ends of one arc: it closes
            loops += 1
            partner.pop(one, None)
            partner.pop(other, None)
        else:
            # an edge that is new to the frontier is its own far end
            start, end = partner.pop(one, one), partner.pop(other, other)
            partner[start], partner[end] = end, start
    return frozenset((one, other) for one, other in partner.items() if one < other), loops
