"""The Alexander and Jones polynomials of a diagram, in exact integers.

A polynomial with integer coefficients is computed by putting a power of two so large for its
variable that the coefficients can be read off the digits of one long integer (Kronecker
substitution): determinants and sums of states are then ordinary integer arithmetic.

Conventions: Alexander is symmetric with value 1 at t = 1; Jones is in t, right-handed trefoil t +
t^3 - t^4.
"""

from __future__ import annotations

from functools import lru_cache

from knotgym.topology.diagrams import drawn
from knotgym.topology.gauss import GaussCode

JonesPolynomial = tuple[tuple[int, int], ...]

Matching = frozenset[tuple[int, int]]


@lru_cache(maxsize=65536)
def alexander_polynomial(code: GaussCode) -> tuple[int, ...]:
    """Return the coefficients, lowest power first; a code without chirality is drawn() first.

    Raises:
        NotPlanar: no closed curve shows the code.

    >>> alexander_polynomial(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))  # trefoil
    (1, -1, 1)
    """
    code = drawn(code)
    # of the matrix; a row has the entries 1 - t, t, -1, so no coefficient exceeds 4 ** size
    size = code.nx - 1
    if size < 1:
        return (1,)
    digits = 2 * size + 2
    coefficients = _digits(_determinant(_alexander_matrix(code, 1 << digits)), digits)
    while coefficients[0] == 0:
        del coefficients[0]
    sign = 1 if sum(coefficients) > 0 else -1
    return tuple([sign * coefficient for coefficient in coefficients])


@lru_cache(maxsize=65536)
def jones_polynomial(code: GaussCode) -> JonesPolynomial:
    """Return the (power of t, coefficient) pairs, none of them 0, lowest power first.

    The Kauffman bracket is summed crossing by crossing over a moving frontier, so the time grows
    with the width of the diagram rather than with 2 ** n. A code without chirality is drawn()
    first: its knot is known up to the mirror.

    Raises:
        NotPlanar: no closed curve shows the code.

    >>> jones_polynomial(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))  # right-handed trefoil
    ((1, 1), (3, 1), (4, -1))
    """
    code = drawn(code)
    if not code.nx:
        return ((0, 1),)
    # The bracket is a polynomial in A; at most 4 ** n terms, two per loop and state, add up to a
    # coefficient.
    digits, lowest = 2 * code.nx + 3, 3 * code.nx + 2
    states: dict[Matching, int] = {frozenset(): 1 << digits * lowest}
    for corners in _sweep(_corners(code)):
        new: dict[Matching, int] = {}
        for matching, weight in states.items():
            south, east, north, west = corners
            for joints, term in (
                # what turning the upper strand left opens: A; and right: 1 / A
                (((south, east), (north, west)), weight << digits),
                (((south, west), (north, east)), weight >> digits),
            ):
                joined, loops = _joined(matching, joints)
                for _ in range(loops):
                    term = -(term << 2 * digits) - (term >> 2 * digits)
                new[joined] = new.get(joined, 0) + term
        states = new
    # Normalized: (-A^3)^-writhe, one loop (-A^2 - 1 / A^2) taken out, t = A^-4.
    bracket = {
        power - lowest: value
        for power, value in enumerate(_digits(states[frozenset()], digits))
        if value
    }
    sign = -1 if code.writhe % 2 else 1
    rest = {power - 3 * code.writhe: sign * value for power, value in bracket.items()}
    jones: dict[int, int] = {}
    while rest:
        power = max(rest)
        value = -rest.pop(power)
        jones[-(power - 2) // 4] = value
        rest[power - 4] = rest.get(power - 4, 0) + value
        if rest[power - 4] == 0:
            del rest[power - 4]
    return tuple(sorted(jones.items()))


def mirrored_jones(jones: JonesPolynomial) -> JonesPolynomial:
    """Return the polynomial of the mirror image: t to 1 / t."""
    return tuple(sorted((-power, value) for power, value in jones))


def _digits(number: int, digits: int) -> list[int]:
    """Read balanced coefficients, lowest first, off a polynomial's value at 2 ** digits."""
    half, mask = 1 << (digits - 1), (1 << digits) - 1
    coefficients = []
    while number:
        coefficient = ((number + half) & mask) - half
        coefficients.append(coefficient)
        number = (number - coefficient) >> digits
    return coefficients


def _alexander_matrix(code: GaussCode, t: int) -> list[list[int]]:
    """Fox's matrix without its last row and column; arcs run from one under-visit to the next."""
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
        row[over[label]] += 1 - t
        after = (before[label] + 1) % code.nx
        row[before[label]] += t if sign > 0 else -1
        row[after] += -1 if sign > 0 else t
        matrix.append(row[:-1])
    return matrix


def _determinant(matrix: list[list[int]]) -> int:
    """Eliminate without fractions (Bareiss); the matrix is used up."""
    size, sign, previous = len(matrix), 1, 1
    for k in range(size - 1):
        pivot_row = next((row for row in range(k, size) if matrix[row][k]), None)
        if pivot_row is None:
            return 0
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


def _corners(code: GaussCode) -> list[tuple[int, int, int, int]]:
    """Per crossing its four edges, counterclockwise from the incoming lower one.

    Edge k leads to visit k. With the lower strand going north the upper one goes east at a positive
    crossing.
    """
    count = len(code.visits)
    lower: dict[int, int] = {}
    upper: dict[int, int] = {}
    for k, visit in enumerate(code.visits):
        (upper if visit > 0 else lower)[abs(visit)] = k
    corners = []
    for label, sign in enumerate(code.signs, 1):
        south, north = lower[label], (lower[label] + 1) % count
        west, east = upper[label], (upper[label] + 1) % count
        corners.append((south, east, north, west) if sign > 0 else (south, west, north, east))
    return corners


def _sweep(corners: list[tuple[int, int, int, int]]) -> list[tuple[int, int, int, int]]:
    """Order the crossings so that few edges lie between those done and those to do.

    Next is always the best connected one.
    """
    left = list(corners)
    frontier: set[int] = set()
    order = []
    while left:
        crossing = max(left, key=lambda edges: len(frontier.intersection(edges)))
        left.remove(crossing)
        order.append(crossing)
        for edge in crossing:
            frontier ^= {edge}
    return order


def _joined(
    matching: Matching, joints: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[Matching, int]:
    """Join edges of the frontier: the new pairs of ends, and how many loops closed."""
    partner: dict[int, int] = {}
    for one, other in matching:
        partner[one], partner[other] = other, one
    loops = 0
    for one, other in joints:
        if one == other or partner.get(one) == other:
            loops += 1
            partner.pop(one, None)
            partner.pop(other, None)
        else:
            start, end = partner.pop(one, one), partner.pop(other, other)
            partner[start], partner[end] = end, start
    return frozenset((one, other) for one, other in partner.items() if one < other), loops
