"""Identification of the knot that a diagram shows; the answer is exact or "unknown".

A diagram that loses all its crossings when kinks and bigons are removed shows the unknot.
Otherwise the Alexander polynomial is computed first. If it isn't 1, the rope is knotted. If it is 1
and at most 10 crossings are left, the rope is unknotted: the smallest nontrivial knots with this
polynomial have 11 crossings (J. Hoste, M. Thistlethwaite and J. Weeks, "The First 1,701,936 Knots",
1998). With up to 24 crossings the Jones polynomial decides: no nontrivial knot with so few has that
of the unknot (R. E. Tuzun and A. S. Sikora, "Verification of the Jones Unknot Conjecture up to 24
Crossings", 2021).

Types are named as in KnotInfo's table (`knot_table`), regardless of handedness: both trefoils are
"3_1", and "3_1#3_1" is both the granny knot and the square knot. A diagram of up to 10 crossings is
identified by its polynomials, or because it is in the table.

After a change run `pytest tests/topology/test_knots.py`: no hard unknot may be called knotted, and
all 249 knots of the table keep their names.
"""

from functools import lru_cache

from knotgym.common import Failed
from knotgym.topology.diagrams import planar_codes, summands, with_chirality
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import (
    UNKNOT,
    composite_type,
    diagram_of,
    small_types,
    table_type,
    type_of,
    types_from_polynomials,
)
from knotgym.topology.polynomials import alexander_polynomial, jones_polynomial
from knotgym.topology.reidemeister import simplify, without_bigons

UNKNOWN = "unknown"
ALEXANDER_DECIDES = 10
JONES_DECIDES = 24
LISTED_NX = 6  # with more crossings there are too many codes for codes_of

# Diagrams of at most 7 crossings are named by their Alexander polynomials alone, see `small_types`.
_SMALL = 7


@lru_cache(maxsize=65536)
def is_unknot(code: GaussCode) -> bool:
    """Return whether the rope can be opened to a plain loop.

    Args:
        code: a planar code. Without chirality the answer holds for all of its handedness patterns,
            because they differ only by mirrored summands.

    Raises:
        InvalidInput: no closed curve shows the code.
        Failed: the polynomials are trivial, and more than 24 crossings are left.
    """
    # The genus of a sum is the sum of the genera, so a connected sum is trivial only if all of its
    # summands are.
    return all(_is_trivial(summand) for summand in summands(without_bigons(with_chirality(code))))


@lru_cache(maxsize=65536)
def knot_type(code: GaussCode) -> str:
    """Return the knot type: types of at most 10 crossings joined by "#", or "unknown".

    Args:
        code: a planar code; chirality is optional as for `is_unknot`.

    Raises:
        InvalidInput: no closed curve shows the code.

    >>> knot_type(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))
    '3_1'
    """
    names: list[str] = []
    for summand in summands(without_bigons(with_chirality(code))):
        # a diagram in the table is minimal, so don't search for a smaller one
        own = table_type(summand) if summand.nx > _SMALL else None
        if own:
            names.append(own)
        else:
            for part in summands(simplify(summand)):
                names.extend(_name(part).split("#"))
    if UNKNOWN in names:
        return UNKNOWN
    return composite_type(names)


def possible_types(code: GaussCode) -> list[str]:
    """List the types that a prime diagram of unknown type may have; empty if nothing is known.

    Knots such as 5_1 and 10_132 share both polynomials, so some diagrams can't be told apart.
    """
    parts = summands(simplify(without_bigons(with_chirality(code))))
    return types_from_polynomials(parts[0]) if len(parts) == 1 else []


def shows(code: GaussCode, knot: str) -> bool:
    """Return whether the code is of this knot and, if it has chirality, of this handedness.

    The Jones polynomial decides the handedness. It can't for 9_42, 10_48, 10_71, 10_91, 10_104 and
    10_125: there, both are accepted.

    Args:
        code: a planar code.
        knot: a name as for `knot_table.diagram_of`.

    Raises:
        InvalidInput: no closed curve shows the code.
        InvalidInput: the table has no such knot.

    >>> shows(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"), "m3_1")
    False
    """
    if type_of(knot) == UNKNOT:
        return is_unknot(code)
    # the type first: it is cached by code, and a Jones polynomial is dear
    if knot_type(code) != type_of(knot):
        return False
    return code.chirality is None or jones_polynomial(code) == jones_polynomial(diagram_of(knot))


@lru_cache(maxsize=32)
def codes_of(knot: str, nx: int) -> tuple[GaussCode, ...]:
    """Return all codes of a knot type with nx crossings, without chirality, in order of visits."""
    certified = is_unknot if knot == UNKNOT else lambda code: knot_type(code) == knot
    return tuple(
        sorted((code for code in planar_codes(nx) if certified(code)), key=lambda code: code.visits)
    )


def _is_trivial(summand: GaussCode) -> bool:
    # from cheap to dear: the Alexander polynomial tells most knots from the unknot
    if alexander_polynomial(summand) != (1,):
        return False
    if summand.nx <= ALEXANDER_DECIDES:
        return True
    # Beyond the proof's reach fewer crossings may bring it back within, so the diagram is
    # simplified and asked about again.
    if summand.nx > JONES_DECIDES and (smaller := simplify(summand)).nx < summand.nx:
        return is_unknot(smaller)
    if jones_polynomial(summand) != ((0, 1),):
        return False
    if summand.nx <= JONES_DECIDES:
        return True
    raise Failed(
        f"can't decide whether a diagram of {summand.nx} crossings is the unknot: its Alexander and"
        f" Jones polynomials are 1, which is a proof up to {JONES_DECIDES} crossings only:"
        f" {summand.chiral}"
    )


def _name(summand: GaussCode) -> str:
    # No search for a minimal diagram: up to seven crossings the Alexander polynomials of all types
    # differ.
    if summand.nx <= _SMALL:
        return small_types(_SMALL)[alexander_polynomial(summand)]
    try:
        # The table's polynomials can't tell the unknot from knots beyond the table; the proof can.
        types = [UNKNOT] if _is_trivial(summand) else types_from_polynomials(summand)
    except Failed:
        return UNKNOWN
    return types[0] if len(types) == 1 else UNKNOWN
