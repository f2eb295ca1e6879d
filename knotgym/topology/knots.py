"""Identification of the knot that a diagram shows; the answer is exact or "unknown".

A diagram that loses all its crossings when kinks and bigons are removed shows the unknot.
Otherwise the Alexander polynomial is computed first. If it isn't 1, the rope is knotted. If it is 1
and at most 10 crossings are left, the rope is unknotted: the smallest nontrivial knots with this
polynomial have 11 crossings (J. Hoste, M. Thistlethwaite and J. Weeks, "The First 1,701,936 Knots",
1998). With up to 24 crossings the Jones polynomial decides: no nontrivial knot with so few has that
of the unknot (R. E. Tuzun and A. S. Sikora, "Verification of the Jones Unknot Conjecture up to 24
Crossings", 2021).

The table has a diagram of each prime knot of up to ten crossings. Names are those of KnotInfo:
Rolfsen's without the pair that he listed twice, 3_1 to 10_165. "m" before a name means the
mirror image and "#" a connected sum, as in "m3_1#4_1". The diagrams in `data/knots.json` were made
from KnotInfo's PD notation (C. Livingston and A. H. Moore, knotinfo.org). A name means the
handedness with KnotInfo's Jones polynomial, so 3_1 is the right-handed trefoil and m3_1 the
left-handed one.

A knot type is a name regardless of handedness: both trefoils are "3_1", and "3_1#3_1" is both the
granny knot and the square knot. A diagram of up to 10 crossings is identified by its polynomials,
or because it is in the table.

After a change run `pytest tests/topology/test_knots.py`: no hard unknot may be called knotted, and
both polynomials of all 249 knots must be those of KnotInfo's own columns.
"""

import json
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import lru_cache
from importlib.resources import files
from itertools import combinations_with_replacement, product
from typing import NamedTuple

from knotgym.common import Failed, InvalidInput
from knotgym.topology.diagrams import planar_codes, summands, with_chirality
from knotgym.topology.gauss import GaussCode
from knotgym.topology.polynomials import JonesPolynomial, alexander_polynomial, jones_polynomial
from knotgym.topology.reidemeister import connected_sum, is_alternating, simplify, without_bigons
from knotgym.topology.symmetry import Symmetry, canonical, images

UNKNOWN = "unknown"
ALEXANDER_DECIDES = 10
JONES_DECIDES = 24
LISTED_NX = 6  # with more crossings there are too many codes for codes_of

# Diagrams of at most so many crossings are named by Alexander polynomials alone: `_small_types`.
_SMALL = 7
UNKNOT = "0_1"
TABLED = 10  # all knots with at most this many crossings are in the table

Polynomials = tuple[tuple[int, ...], JonesPolynomial]

_SUMMAND = re.compile(r"(m?)([0-9]+_[0-9]+)")


@lru_cache(maxsize=65536)
def _is_unknot(code: GaussCode) -> bool:
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
        code: a planar code; chirality is optional as for `_is_unknot`.

    Raises:
        InvalidInput: no closed curve shows the code.

    >>> knot_type(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))
    '3_1'
    """
    names: list[str] = []
    for summand in summands(without_bigons(with_chirality(code))):
        # a diagram in the table is minimal, so don't search for a smaller one
        type_name = _table_type(summand) if summand.nx > _SMALL else None
        if type_name:
            names.append(type_name)
        else:
            for part in summands(simplify(summand)):
                names.extend(_name(part).split("#"))
    if UNKNOWN in names:
        return UNKNOWN
    return _composite_type(names)


class Knot(NamedTuple):
    """A knot of the table, its mirror image, or a sum of such.

    Attributes:
        name: such as "3_1", "m3_1" or "m4_1#3_1", which fixes the handedness.

    Raises (where the table is needed):
        InvalidInput: the table has no such knot.
    """

    name: str

    @property
    def type(self) -> str:
        """The type: without handedness, summands in order of the table.

        >>> Knot("m4_1#3_1").type
        '3_1#4_1'
        """
        return _composite_type([name for _, name in _summands(self.name)])

    @property
    def diagram(self) -> GaussCode:
        """A minimal diagram, with chirality.

        >>> Knot("m3_1").diagram.chiral
        '1+a,2-a,3+a,1-a,2+a,3-a'
        """
        return _diagram_of(self.name)

    def diagrams(self) -> list[GaussCode]:
        """List the codes of `diagram` from every base point, in both directions, from both sides.

        All of them are of the same knot with the same handedness.
        """
        # seen from below, every crossing is switched and the picture is reflected
        sides, rebased = _diagram_of(self.name), Symmetry.REVERSE | Symmetry.REBASE
        closures = {*images(sides, rebased), *images(sides.switched().reflected(), rebased)}
        return sorted(closures, key=lambda image: (image.visits, image.chirality or ""))

    def is_shown_by(self, code: GaussCode) -> bool:
        """Return whether a planar code is of this knot and, if it has chirality, of its handedness.

        The Jones polynomial decides the handedness. It can't for 9_42, 10_48, 10_71, 10_91, 10_104
        and 10_125: there, both are accepted.

        Raises:
            InvalidInput: no closed curve shows the code.

        >>> Knot("m3_1").is_shown_by(GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c"))
        False
        """
        if self.type == UNKNOT:
            return _is_unknot(code)
        # the type first: it is cached by code, and a Jones polynomial is dear
        if knot_type(code) != self.type:
            return False
        return code.chirality is None or jones_polynomial(code) == jones_polynomial(self.diagram)


@lru_cache(maxsize=32)
def codes_of(knot: str, nx: int) -> tuple[GaussCode, ...]:
    """Return all codes of a knot type with nx crossings, without chirality, in order of visits."""
    certified = _is_unknot if knot == UNKNOT else lambda code: knot_type(code) == knot
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
        return _is_unknot(smaller)
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
        return _small_types()[alexander_polynomial(summand)]
    try:
        # The table's polynomials can't tell the unknot from knots beyond the table; the proof can.
        types = [UNKNOT] if _is_trivial(summand) else _types_from_polynomials(summand)
    except Failed:
        return UNKNOWN
    return types[0] if len(types) == 1 else UNKNOWN


@lru_cache(maxsize=1)
def _prime_diagrams() -> dict[str, GaussCode]:
    """Return a minimal diagram with chirality of each of the 249 prime knots, by type."""
    table = json.loads((files("knotgym.topology") / "data" / "knots.json").read_text("utf-8"))
    return {name: GaussCode.parse(text) for name, text in table["diagrams"].items()}


@lru_cache(maxsize=256)
def _diagram_of(knot: str) -> GaussCode:
    factors = [
        (mirror, _prime_diagrams()[name]) for mirror, name in _summands(knot) if name != UNKNOT
    ]
    return connected_sum([code.switched() if mirror else code for mirror, code in factors])


def _composite_type(types: list[str]) -> str:
    """Return the type of the connected sum of knots of these types.

    >>> _composite_type(["10_2", "0_1", "3_1"])
    '3_1#10_2'
    """
    proper = [name for name in types if name != UNKNOT]
    return "#".join(sorted(proper, key=_rank)) or UNKNOT


def _table_type(code: GaussCode) -> str | None:
    """Return the type of a diagram that is in the table, up to the base point; None otherwise.

    Args:
        code: a code with chirality of one summand.
    """
    if not 3 <= code.nx <= TABLED:
        return None
    # without letters: a reflected diagram has the same visits, and types say no handedness
    return _by_diagram().get(canonical(code, Symmetry.DIAGRAM))


def _types_from_polynomials(code: GaussCode) -> list[str]:
    """List the types of the table that both polynomials and the crossing number leave possible.

    Args:
        code: a code with chirality of one summand, as returned by `reidemeister.simplify`.
    """
    if code.nx > TABLED:
        return []
    types = [
        name
        for name in _types_by_polynomials().get(_polynomials(code), ())
        if sum(_rank(part)[0] for part in name.split("#")) <= code.nx
    ]
    if is_alternating(code):
        # A reduced alternating diagram is minimal (Kauffman, Murasugi, Thistlethwaite, 1987), and
        # it is visibly composite if its knot is (Menasco, 1984).
        types = [name for name in types if "#" not in name and _rank(name)[0] == code.nx]
    return types


@lru_cache(maxsize=1)
def _small_types() -> dict[tuple[int, ...], str]:
    """Map Alexander polynomials to the types of at most _SMALL crossings, composite ones included.

    Up to 7 crossings they are all different, and regardless of handedness.
    """
    sums = [names for names in _sums() if sum(_rank(name)[0] for name in names) <= _SMALL]
    diagrams = _prime_diagrams()
    return {(1,): UNKNOT} | {
        alexander_polynomial(connected_sum([diagrams[name] for name in names])): "#".join(names)
        for names in sums
    }


@lru_cache(maxsize=1)
def _by_diagram() -> dict[GaussCode, str]:
    """Map canonical codes, over all base points, directions and sides, to the type."""
    return {canonical(code, Symmetry.DIAGRAM): name for name, code in _prime_diagrams().items()}


@lru_cache(maxsize=1)
def _types_by_polynomials() -> dict[Polynomials, tuple[str, ...]]:
    """Map polynomials to the types that have them, including composite ones.

    The Jones polynomial is taken up to the mirror image.
    """
    named: dict[Polynomials, dict[str, None]] = defaultdict(dict)
    for names in _sums():
        diagrams = [_prime_diagrams()[name] for name in names]
        # the Jones polynomial of a sum depends on the relative handedness of its summands
        # The first summand keeps its hand: mirroring all of them mirrors the sum, and the
        # polynomial is taken up to that.
        for mirrors in product((False, True), repeat=len(names) - 1):
            pairs = zip(diagrams, (False, *mirrors), strict=True)
            sum_ = connected_sum([code.switched() if mirror else code for code, mirror in pairs])
            named[_polynomials(sum_)][_composite_type(list(names))] = None
    return {polynomials: tuple(types) for polynomials, types in named.items()}


def _sums() -> Iterator[tuple[str, ...]]:
    """Yield the summands of every type in the table: prime ones first, then composite ones."""
    names = list(_prime_diagrams())
    yield from ((name,) for name in names)
    # a summand of a composite knot leaves room for another one of three crossings at least
    small = [name for name in names if _rank(name)[0] <= TABLED - 3]
    for count in range(2, TABLED // 3 + 1):
        for several in combinations_with_replacement(small, count):
            if sum(_rank(name)[0] for name in several) <= TABLED:
                yield several


def _polynomials(code: GaussCode) -> Polynomials:
    """Return the Alexander and the Jones polynomial, the latter smallest up to mirroring."""
    jones = jones_polynomial(code)
    mirrored = tuple(sorted((-power, value) for power, value in jones))  # t becomes 1 / t
    return alexander_polynomial(code), min(jones, mirrored)


def _summands(knot: str) -> list[tuple[bool, str]]:
    """Parse a name; return for each summand whether it is mirrored, and its type."""
    factors = []
    for word in knot.split("#"):
        match = _SUMMAND.fullmatch(word)
        if match is None or (match[2] != UNKNOT and match[2] not in _prime_diagrams()):
            raise InvalidInput(
                f"no knot {knot!r}; there are 0_1, the prime knots of up to {TABLED} crossings from"
                " 3_1 to 10_165, mirror images (m3_1), and sums (3_1#4_1)"
            )
        factors.append((bool(match[1]), match[2]))
    return factors


def _rank(name: str) -> tuple[int, int]:
    """Return the crossing number and the index of a prime type."""
    # so 10_2 comes after 9_49, as in the tables, and not before it as text
    crossings, number = name.split("_")
    return int(crossings), int(number)
