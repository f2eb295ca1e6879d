"""Which knot a diagram shows, decided exactly or not at all.

A diagram that loses all its crossings with its kinks and bigons shows the unknot. Another is told
by its Alexander polynomial: if that is not 1 the rope is knotted, and if it is 1 with at most 10
crossings left it is not, since the first knots with a trivial one have 11 crossings (tables of
Hoste, Thistlethwaite and Weeks, "The First 1,701,936 Knots", 1998). Beyond that the Jones
polynomial decides, up to 24 crossings: no knot with so few has the unknot's (R. E. Tuzun and A. S.
Sikora, "Verification of the Jones Unknot Conjecture up to 24 Crossings", 2021).

Types are named as in KnotInfo's table (`knot_table`), whatever the handedness: both trefoils are
"3_1", and "3_1#3_1" is the granny knot as well as the square knot. A diagram of up to 10 crossings
is told by its polynomials or as one of the table's own.
"""

from __future__ import annotations

from functools import lru_cache

from knotgym.common.errors import KnotgymError
from knotgym.topology.diagrams import drawn, planar_codes, summands
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT, diagram_of, joined, own_type, tabled_type, type_of
from knotgym.topology.polynomials import alexander_polynomial, jones_polynomial
from knotgym.topology.reidemeister import simplify, without_bigons

UNKNOWN = "unknown"
ALEXANDER_DECIDES = 10
JONES_DECIDES = 24
LISTED_NX = 6  # codes with more crossings are too many for codes_of

# Every knot of at most 7 crossings, composites included. The polynomials differ, so a diagram of at
# most 7 crossings is told by its own.
_TYPES: dict[tuple[int, ...], str] = {
    (1,): UNKNOT,
    (1, -1, 1): "3_1",
    (-1, 3, -1): "4_1",
    (1, -1, 1, -1, 1): "5_1",
    (2, -3, 2): "5_2",
    (-2, 5, -2): "6_1",
    (-1, 3, -3, 3, -1): "6_2",
    (1, -3, 5, -3, 1): "6_3",
    (1, -2, 3, -2, 1): "3_1#3_1",
    (1, -1, 1, -1, 1, -1, 1): "7_1",
    (3, -5, 3): "7_2",
    (2, -3, 3, -3, 2): "7_3",
    (4, -7, 4): "7_4",
    (2, -4, 5, -4, 2): "7_5",
    (-1, 5, -7, 5, -1): "7_6",
    (1, -5, 9, -5, 1): "7_7",
    (-1, 4, -5, 4, -1): "3_1#4_1",
}
_TABLED = 7


class UndecidedKnot(KnotgymError):
    """A diagram that the polynomials do not tell from the unknot, too large for that as a proof."""

    def __init__(self, code: GaussCode) -> None:
        super().__init__(
            f"cannot say whether a diagram of {code.nx} crossings is the unknot: its Alexander and"
            f" Jones polynomials are 1, which proves it up to {JONES_DECIDES} crossings:"
            f" {code.chiral}"
        )


@lru_cache(maxsize=65536)
def is_unknot(code: GaussCode) -> bool:
    """Say whether the rope can be opened to a plain loop.

    Args:
        code: a planar code. Without chirality the answer holds for each of its handedness patterns:
            they differ by mirrored summands.

    Raises:
        NotPlanar: no closed curve shows the code.
        UndecidedKnot: more than 24 crossings are left that the polynomials do not tell.
    """
    return all(_is_trivial(summand) for summand in summands(without_bigons(drawn(code))))


@lru_cache(maxsize=65536)
def knot_type(code: GaussCode) -> str:
    """Name the knot: types of at most 10 crossings joined by "#", or "unknown" if not certain.

    Args:
        code: a planar code; without chirality as for is_unknot().

    Raises:
        NotPlanar: no closed curve shows the code.

    >>> knot_type(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))
    '3_1'
    """
    names: list[str] = []
    for summand in summands(without_bigons(drawn(code))):
        # spares the search for a smaller diagram
        own = own_type(summand) if summand.nx > _TABLED else None
        if own:
            names.append(own)
        else:
            for part in summands(simplify(summand)):
                names.extend(_name(part).split("#"))
    if UNKNOWN in names:
        return UNKNOWN
    return joined(names)


def shows(code: GaussCode, knot: str) -> bool:
    """Say whether a rope that shows the code is this knot, and with chirality, of this hand.

    The Jones polynomial tells hands, but for 9_42, 10_48, 10_71, 10_91, 10_104 and 10_125: there
    either passes.

    Args:
        code: planar.
        knot: a name as of `knot_table.diagram_of`.

    Raises:
        NotPlanar: no closed curve shows the code.
        UnknownKnot: the table has none of the name.

    >>> shows(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"), "m3_1")
    False
    """
    if type_of(knot) == UNKNOT:
        return is_unknot(code)
    if knot_type(code) != type_of(knot):
        return False
    return code.chirality is None or jones_polynomial(code) == jones_polynomial(diagram_of(knot))


def handedness(code: GaussCode) -> int:
    """Tell a knot from its mirror image where the span of its Jones polynomial does.

    Returns:
        +1 when the polynomial leans to positive powers, as the right-handed trefoil's, -1 when to
        negative ones, 0 when it leans nowhere, as for the figure-eight knot, which is its own
        mirror image.

    Raises:
        UnknownChirality: the code has none.
        NotPlanar: no closed curve shows the code.

    >>> handedness(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))
    1
    """
    _ = code.signs
    jones = jones_polynomial(without_bigons(drawn(code)))
    lean = jones[0][0] + jones[-1][0]
    return (lean > 0) - (lean < 0)


@lru_cache(maxsize=32)
def codes_of(knot: str, nx: int) -> tuple[GaussCode, ...]:
    """Every code with nx crossings that a rope of this knot type can show, in order, chirality
    left out; exact.
    """
    certified = is_unknot if knot == UNKNOT else lambda code: knot_type(code) == knot
    return tuple(
        sorted((code for code in planar_codes(nx) if certified(code)), key=lambda code: code.visits)
    )


def _is_trivial(summand: GaussCode) -> bool:
    if alexander_polynomial(summand) != (1,):
        return False
    if summand.nx <= ALEXANDER_DECIDES:
        return True
    if summand.nx <= JONES_DECIDES:
        return jones_polynomial(summand) == ((0, 1),)
    smaller = simplify(summand)
    if smaller.nx < summand.nx:
        return is_unknot(smaller)
    if jones_polynomial(smaller) != ((0, 1),):
        return False
    raise UndecidedKnot(smaller)


def _name(summand: GaussCode) -> str:
    if summand.nx <= _TABLED:
        return _TYPES[alexander_polynomial(summand)]
    try:
        return UNKNOT if _is_trivial(summand) else tabled_type(summand) or UNKNOWN
    except UndecidedKnot:
        return UNKNOWN
