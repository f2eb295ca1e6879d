"""The knots there are to ten crossings: a diagram of each prime one, and of their sums.

The names are KnotInfo's, Rolfsen's without the pair he listed twice: 3_1 to 10_165, with "m" before
a name the mirror image and "#" between names a connected sum, as in "m3_1#4_1". `data/knots.json`
holds the diagrams, made from the PD notation of KnotInfo (C. Livingston and A. H. Moore,
knotinfo.org); a name means the hand whose Jones polynomial stands there, so that 3_1 is the
right-handed trefoil, m3_1 the left-handed one.

Types are names without hand.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import lru_cache
from importlib.resources import files
from itertools import combinations_with_replacement, product

from knotgym.common.errors import KnotgymError
from knotgym.topology.gauss import GaussCode
from knotgym.topology.polynomials import (
    JonesPolynomial,
    alexander_polynomial,
    jones_polynomial,
    mirrored_jones,
)
from knotgym.topology.reidemeister import is_alternating, strung

UNKNOT = "0_1"
TABLED = 10  # crossings up to which all knots are in the table

Polynomials = tuple[tuple[int, ...], JonesPolynomial]

_SUMMAND = re.compile(r"(m?)([0-9]+_[0-9]+)")


class UnknownKnot(KnotgymError, ValueError):
    """A name that stands for no knot of the table."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"no knot {name!r}; there are 0_1, the prime knots of up to {TABLED} crossings from 3_1"
            " to 10_165, mirror images (m3_1), and sums (3_1#4_1)"
        )


@lru_cache(maxsize=1)
def prime_diagrams() -> dict[str, GaussCode]:
    """Type -> its diagram with fewest crossings, with chirality, of the 249 prime knots."""
    table = json.loads((files("knotgym.topology") / "data" / "knots.json").read_text("utf-8"))
    return {name: GaussCode.parse(text) for name, text in table["diagrams"].items()}


@lru_cache(maxsize=256)
def diagram_of(knot: str) -> GaussCode:
    """A diagram with fewest crossings of a knot by name, hand and all.

    Raises:
        UnknownKnot: the table has none of the name.

    >>> diagram_of("m3_1").chiral
    '1+a,2-a,3+a,1-a,2+a,3-a'
    """
    codes = []
    for mirror, name in _summands(knot):
        if name != UNKNOT:
            code = prime_diagrams()[name]
            codes.append(code.mirrored() if mirror else code)
    return strung(codes)


def type_of(knot: str) -> str:
    """The type that a name stands for: hands left out, summands in order.

    Raises:
        UnknownKnot: the table has none of the name.

    >>> type_of("m4_1#3_1")
    '3_1#4_1'
    """
    return joined([name for _, name in _summands(knot)])


def joined(types: list[str]) -> str:
    """The type of the connected sum.

    >>> joined(["10_2", "0_1", "3_1"])
    '3_1#10_2'
    """
    proper = [name for name in types if name != UNKNOT]
    return "#".join(sorted(proper, key=_rank)) or UNKNOT


def based_diagrams(code: GaussCode) -> list[GaussCode]:
    """A diagram with chirality from every base point, in both directions, and from below: all of
    the same knot with its hand.
    """
    found: set[GaussCode] = set()
    for side in (code, code.mirrored().reflected()):
        for way in (side, side.reversed()):
            found.update(way.rebased(k) for k in range(max(1, len(way.visits))))
    return sorted(found, key=lambda one: (one.visits, one.chirality or ""))


def own_type(code: GaussCode) -> str | None:
    """The type of a diagram that is the table's own, from whatever base point; None for others.

    Args:
        code: with chirality, without crossings that split it.
    """
    if not 3 <= code.nx <= TABLED:
        return None
    return _by_diagram().get(min(one.visits for one in based_diagrams(code)))


def tabled_type(code: GaussCode) -> str | None:
    """The type told by polynomials and the number of crossings; None where that is no proof.

    Args:
        code: with chirality, of a knot, as `reidemeister.simplify` leaves its summands.
    """
    if code.nx > TABLED:
        return None
    types = [
        name
        for name in _by_polynomials().get(_polynomials(code), ())
        if sum(_rank(one)[0] for one in name.split("#")) <= code.nx
    ]
    if is_alternating(code):
        # it has no crossing too many (Kauffman, Murasugi, Thistlethwaite, 1987) and no summands
        # that it doesn't show (Menasco, 1984)
        types = [name for name in types if "#" not in name and _rank(name)[0] == code.nx]
    return types[0] if len(types) == 1 else None


def alike() -> list[tuple[str, ...]]:
    """Types that have the same Alexander and, up to the mirror, Jones polynomials."""
    return [types for types in _by_polynomials().values() if len(types) > 1]


@lru_cache(maxsize=1)
def _by_diagram() -> dict[tuple[int, ...], str]:
    """Visits, smallest over all base points, directions and sides -> type."""
    return {
        min(one.visits for one in based_diagrams(code)): name
        for name, code in prime_diagrams().items()
    }


@lru_cache(maxsize=1)
def _by_polynomials() -> dict[Polynomials, tuple[str, ...]]:
    """Polynomials -> types of all knots of the table, composites among them."""
    found: dict[Polynomials, dict[str, None]] = defaultdict(dict)
    for names in _sums():
        diagrams = [prime_diagrams()[name] for name in names]
        for mirrors in product((False, True), repeat=len(names) - 1):
            hands = [
                code.mirrored() if mirror else code
                for code, mirror in zip(diagrams, (False, *mirrors), strict=True)
            ]
            found[_polynomials(strung(hands))][joined(list(names))] = None
    return {polynomials: tuple(types) for polynomials, types in found.items()}


def _sums() -> Iterator[tuple[str, ...]]:
    """The prime types, and the sums of several that have no more crossings than the table."""
    names = list(prime_diagrams())
    yield from ((name,) for name in names)
    small = [name for name in names if _rank(name)[0] <= TABLED - 3]
    for count in range(2, TABLED // 3 + 1):
        for summands in combinations_with_replacement(small, count):
            if sum(_rank(name)[0] for name in summands) <= TABLED:
                yield summands


def _polynomials(code: GaussCode) -> Polynomials:
    """Both polynomials, the Jones polynomial the lesser of the two hands'."""
    jones = jones_polynomial(code)
    return alexander_polynomial(code), min(jones, mirrored_jones(jones))


def _summands(knot: str) -> list[tuple[bool, str]]:
    """Per summand of a name, whether it is mirrored, and its type."""
    found = []
    for word in knot.split("#"):
        match = _SUMMAND.fullmatch(word)
        if match is None or (match[2] != UNKNOT and match[2] not in prime_diagrams()):
            raise UnknownKnot(knot)
        found.append((bool(match[1]), match[2]))
    return found


def _rank(name: str) -> tuple[int, int]:
    crossings, number = name.split("_")
    return int(crossings), int(number)
