"""Gauss codes: the sequence of crossings met on one walk along the rope.

A code is a tuple of visits. The n crossings are labelled 1, 2, ..., n in order of first visit. A
visit is +label on the upper strand and -label on the lower one. As text a code reads "1+,1-,2+,2-",
and the plain loop is "".

Chirality adds one letter per crossing, as in pyknotid: "c" for a positive (right-handed) crossing,
where (d_over x d_under)_z > 0 with d the direction of walking, and "a" for a negative one.
Reversing the walk changes no letter.

The code of an open curve is read from end to end. Nothing tells its two ends apart, and nothing
orders several curves but the caller; so codes of such `RopesCode`s are compared by `smallest`. As
text, curves are separated by ";", and whether they are closed is said beside it: "1+,1-;2+,2-".

After a change run `pytest tests/topology/test_gauss.py tests/topology/test_ropes.py`: each
symmetry, applied twice, must be nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from operator import index

from knotgym.common import InvalidInput

_SWITCHED = str.maketrans("ac", "ca")
_VISIT = re.compile(r"\s*([1-9][0-9]*)\s*([+-])\s*([ac]?)\s*")


@dataclass(frozen=True, slots=True)
class GaussCode:
    """A Gauss code with a base point and a direction; compared and hashed by value.

    Attributes:
        visits: +label over, -label under, in the order of the walk.
        chirality: letter i belongs to label i + 1; None if unknown. It is always "" for the empty
            code.

    Raises:
        InvalidInput: a label is not visited once over and once under, labels are not in order
            of first visit, or the chirality doesn't have one letter per crossing.

    >>> GaussCode((1, -1), "c").chiral
    '1+c,1-c'
    """

    visits: tuple[int, ...] = ()
    chirality: str | None = None

    def __post_init__(self) -> None:
        # Callers pass lists, too; a frozen dataclass can only be set this way.
        with InvalidInput.instead("visits of a Gauss code are whole numbers", TypeError):
            object.__setattr__(self, "visits", tuple(map(index, self.visits)))
        if not self.visits and self.chirality is None:
            object.__setattr__(self, "chirality", "")
        _check_visits(self.visits)
        letters = self.chirality
        if letters is not None and (len(letters) != self.nx or letters.strip("ac")):
            expected = f"expected {self.nx} letters, each 'a' or 'c'"
            raise invalid_code("wrong chirality", letters, expected)

    @classmethod
    def parse(cls, text: str) -> GaussCode:
        """Parse "1+,1-" or "1+a,1-a"; spaces are allowed.

        Raises:
            InvalidInput: the text is malformed, only some visits have a letter, or the two
                visits of a crossing have different letters.

        >>> GaussCode.parse("1+a, 2-c, 2+c, 1-a").chirality
        'ac'
        """
        if not text.strip():
            return cls()
        visits: list[int] = []
        letters: dict[int, str] = {}
        for word in text.split(","):
            visit = _VISIT.fullmatch(word)
            if visit is None:
                expected = "a visit is a number, + or -, and optionally a or c"
                raise invalid_code(f"cannot read the visit {word.strip()!r}", text, expected)
            label = int(visit[1])
            visits.append(label if visit[2] == "+" else -label)
            # both visits name the crossing's letter, "" if they have none
            if letters.setdefault(label, visit[3]) != visit[3]:
                expected = "both of its visits must have the same letter, or none"
                raise invalid_code(f"crossing {label} has two different letters", text, expected)
        _check_visits(visits, text)
        chirality = "".join(letters[label] for label in range(1, len(letters) + 1))
        if chirality and len(chirality) != len(letters):
            expected = "either all visits must have a letter or none"
            raise invalid_code("only some crossings have a letter", text, expected)
        return cls(tuple(visits), chirality or None)

    @classmethod
    def trusted(cls, visits: tuple[int, ...], chirality: str | None) -> GaussCode:
        """Make a code without checking it, which takes a tenth of the time."""
        # `__post_init__` is what takes nine tenths of the time: codes made from codes, or by the
        # labeller, are right already.
        code = object.__new__(cls)
        object.__setattr__(code, "visits", visits)
        object.__setattr__(code, "chirality", chirality)
        return code

    @classmethod
    def relabelled(
        cls, visits: Iterable[int], letters: Mapping[int, str] | None = None
    ) -> GaussCode:
        """Make a code from arbitrary labels, renumbering them in order of first visit.

        Args:
            visits: +label over, -label under, in the order of the walk.
            letters: chirality letter of each old label; None if unknown.

        >>> str(GaussCode.relabelled([7, -3, 3, -7]))
        '1+,2-,2+,1-'
        """
        visits = tuple(visits)
        new = _numbers(visits)
        renamed = tuple([new[abs(visit)] if visit > 0 else -new[abs(visit)] for visit in visits])
        return cls(renamed, None if letters is None else "".join([letters[label] for label in new]))

    @staticmethod
    def letters_of(signs: Iterable[float]) -> str:
        """Write crossing signs as chirality letters.

        >>> GaussCode.letters_of([1, -1])
        'ca'
        """
        return "".join(["c" if sign > 0 else "a" for sign in signs])

    def __str__(self) -> str:
        # a list, as `join` would first make one of a generator
        return ",".join([f"{visit}+" if visit > 0 else f"{-visit}-" for visit in self.visits])

    @property
    def chiral(self) -> str:
        """The code as text with chirality letters.

        Raises:
            InvalidInput: the chirality is unknown.
        """
        letters = self._letters()
        return ",".join(
            [f"{abs(v)}{'+' if v > 0 else '-'}{letters[abs(v) - 1]}" for v in self.visits]
        )

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return len(self.visits) // 2

    @property
    def plain(self) -> GaussCode:
        """The same code without chirality; the reward compares these."""
        # the plain loop has chirality "", which says as much as None
        if self.chirality is None or not self.visits:
            return self
        return GaussCode.trusted(self.visits, None)

    @property
    def signs(self) -> tuple[int, ...]:
        """Crossing signs in order of labels: +1 for "c" and -1 for "a".

        Raises:
            InvalidInput: the chirality is unknown.
        """
        return tuple([1 if letter == "c" else -1 for letter in self._letters()])

    def matches(self, other: GaussCode) -> bool:
        """Return whether both codes have the same visits, whatever their chirality."""
        return self.visits == other.visits

    def switched(self) -> GaussCode:
        """Return the code after z -> -z, seen from above as before: every crossing is switched.

        >>> GaussCode.parse("1+c,1-c").switched().chiral
        '1-a,1+a'
        """
        # Over becomes under. The strands keep their directions and exchange their heights, so each
        # sign (d_over x d_under) changes, too.
        return GaussCode.trusted(tuple([-visit for visit in self.visits]), self._flipped())

    def reflected(self) -> GaussCode:
        """Return the code after x -> -x: heights stay the same, every letter changes."""
        # heights stay, and x -> -x turns every left turn into a right one
        return GaussCode.trusted(self.visits, self._flipped())

    def reversed(self) -> GaussCode:
        """Return the code of the walk in the other direction from the same base point.

        >>> str(GaussCode.parse("1+,2-,2+,1-").reversed())
        '1-,2+,2-,1+'
        """
        # both strands of a crossing turn round, so its sign stays; labels are renumbered as they
        # come
        return self.of_visits(self.visits[::-1])

    def rebased(self, k: int) -> GaussCode:
        """Return the code of the walk that starts just before visit k, modulo the visit count.

        >>> str(GaussCode.parse("1+,2-,2+,1-").rebased(1))
        '1-,1+,2-,2+'
        """
        if not self.visits:
            return self
        k %= len(self.visits)
        return self.of_visits(self.visits[k:] + self.visits[:k])

    def _letters(self) -> str:
        if self.chirality is None:
            expected = "give one letter per crossing, as '1+a,1-a'"
            raise invalid_code("its chirality is unknown", str(self), expected)
        return self.chirality

    def _flipped(self) -> str | None:
        return None if self.chirality is None else self.chirality.translate(_SWITCHED)

    def of_visits(self, visits: tuple[int, ...]) -> GaussCode:
        """Make a code from this code's visits in another order, or from some of its crossings.

        Labels are renumbered; nothing is checked.

        Args:
            visits: both visits of each crossing that is kept.

        >>> GaussCode.parse("1+a,2+c,2-c,1-a").of_visits((-2, 2)).chiral
        '1-c,1+c'
        """
        new = _numbers(visits)
        renamed = tuple([new[visit] if visit > 0 else -new[-visit] for visit in visits])
        letters = self.chirality
        if letters is not None:
            letters = "".join([letters[label - 1] for label in new])
        return GaussCode.trusted(renamed, letters)


@dataclass(frozen=True, slots=True)
class RopesCode:
    """The Gauss code of one or more curves, each open or closed; compared and hashed by value.

    Attributes:
        visits: of each curve, +label over, -label under, in the order of its walk. Labels are 1, 2,
            ... in order of first visit, through one curve after the other.
        closed: whether each curve is closed.
        chirality: as in `GaussCode`, with the directions in which the curves are walked; reversing
            one of two curves that cross changes the letters of their crossings.

    Raises:
        InvalidInput: as `GaussCode`; or not every curve is said to be open or closed.

    >>> str(RopesCode(((1, -2), (2, -1)), (True, True)))
    '1+,2-;2+,1-'
    """

    visits: tuple[tuple[int, ...], ...]
    closed: tuple[bool, ...]
    chirality: str | None = None

    def __post_init__(self) -> None:
        code = GaussCode(tuple(chain(*self.visits)), self.chirality)  # refuses what isn't one
        object.__setattr__(self, "chirality", code.chirality)  # "" without crossings
        if len(self.closed) != len(self.visits) or not self.visits:
            problem = f"{len(self.closed)} curves are said to be open or closed"
            raise invalid_code(
                problem, self.visits, "expected one or more, and as many as there are"
            )

    @classmethod
    def parse(cls, text: str, closed: bool | Sequence[bool] = True) -> RopesCode:
        """Parse "1+,2-;2+,1-", with letters or without.

        Args:
            closed: whether each curve is closed, or all are.

        Raises:
            InvalidInput: the text is malformed, or as above.

        >>> RopesCode.parse("1-,1+", closed=False).nx
        1
        """
        parts = [part.strip() for part in text.split(";")]
        code = GaussCode.parse(",".join(filter(None, parts)))
        lengths = [part.count(",") + 1 if part else 0 for part in parts]
        each = (closed,) * len(parts) if isinstance(closed, bool) else tuple(closed)
        return cls(split_visits(code.visits, lengths), each, code.chirality)

    @classmethod
    def of(cls, code: GaussCode) -> RopesCode:
        """Return the code of one closed curve."""
        return cls((code.visits,), (True,), code.chirality)

    def __str__(self) -> str:
        return ";".join(self.texts)

    @property
    def texts(self) -> list[str]:
        """The visits of each curve as text.

        >>> RopesCode.parse("1+,2-;2+,1-").texts
        ['1+,2-', '2+,1-']
        """
        return [
            ",".join([f"{abs(v)}{'+' if v > 0 else '-'}" for v in visit]) for visit in self.visits
        ]

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return sum(map(len, self.visits)) // 2

    @property
    def plain(self) -> RopesCode:
        """The same code without chirality."""
        return RopesCode(self.visits, self.closed)

    def rope(self, k: int) -> GaussCode:
        """Return the code of one closed curve alone, without its crossings with the others.

        Raises:
            InvalidInput: the curve is open.

        >>> str(RopesCode.parse("1+,2-,2+,3-;1-,3+").rope(0))
        '1-,1+'
        """
        if not self.closed[k]:
            expected = "only a closed curve has a Gauss code that starts anywhere, and a knot type"
            raise invalid_code(f"curve {k + 1} is open", self.texts[k], expected)
        mine = {*self.visits[k]}
        letters = self.chirality
        return GaussCode.relabelled(
            [visit for visit in self.visits[k] if -visit in mine],
            None if letters is None else dict(enumerate(letters, 1)),
        )

    def reversed(self, k: int = 0) -> RopesCode:
        """Return the code with curve k walked the other way.

        >>> str(RopesCode.parse("1+,2-,2+,1-", closed=False).reversed())
        '1-,2+,2-,1+'
        """
        letters = self.chirality
        if letters is not None:
            # only where this curve crosses another: both strands of its own crossings turn round
            labels = {*map(abs, self.visits[k])} - {
                abs(v) for v in self.visits[k] if -v in self.visits[k]
            }
            turned = {"a": "c", "c": "a"}
            letters = "".join(
                [
                    turned[letter] if label in labels else letter
                    for label, letter in enumerate(letters, 1)
                ]
            )
        visits = [*self.visits]
        visits[k] = visits[k][::-1]
        return self._relabelled(visits, letters)

    def smallest(self, *, ordered: bool = True) -> RopesCode:
        """Return the smallest code of these curves, in this or any order, walked in any direction.

        Closed curves are walked from any place, open ones from either end. Codes are compared by
        their visits, curve by curve, then by chirality: equal codes are those of one picture.

        >>> str(RopesCode.parse("1+,1-", closed=False).smallest())
        '1-,1+'
        """
        best = [self]
        for k in range(len(self.visits)):
            # labels of a curve depend on those before it alone, so only the smallest are followed
            starts = best if ordered else [rebased for code in best for rebased in code._brought(k)]
            begins = {code: (code.closed[: k + 1], code.visits[: k + 1])
                     for start in starts for code in start._walks(k)}  # fmt: skip
            least = min(begins.values())
            best = [code for code, begin in begins.items() if begin == least]
        return min(best, key=lambda code: code.chirality or "")

    def _brought(self, k: int) -> Iterator[RopesCode]:
        """Yield the codes with each curve from k on brought to place k."""
        for j in range(k, len(self.visits)):
            order = [*range(k), j, *(i for i in range(k, len(self.visits)) if i != j)]
            moved = replace(self, closed=tuple(self.closed[i] for i in order))
            yield moved._relabelled([self.visits[i] for i in order], self.chirality)

    def _walks(self, k: int) -> Iterator[RopesCode]:
        """Yield the codes with curve k walked both ways and, if it is closed, from every place."""
        for code in (self, self.reversed(k)):
            walk = code.visits[k]
            for start in range(max(len(walk), 1) if self.closed[k] else 1):
                visits = [*code.visits]
                visits[k] = walk[start:] + walk[:start]
                yield code._relabelled(visits, code.chirality)

    def _relabelled(self, visits: Sequence[tuple[int, ...]], letters: str | None) -> RopesCode:
        named = None if letters is None else dict(enumerate(letters, 1))
        code = GaussCode.relabelled(chain(*visits), named)
        return RopesCode(
            split_visits(code.visits, [*map(len, visits)]), self.closed, code.chirality
        )


def split_visits(visits: tuple[int, ...], lengths: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Cut the visits of all curves into those of each."""
    walk = iter(visits)
    return tuple([tuple([next(walk) for _ in range(length)]) for length in lengths])


def _numbers(visits: Sequence[int]) -> dict[int, int]:
    """Map labels to 1, 2, ... in order of first visit."""
    # a dict keeps the order of first insertion, which is that of first visits
    labels = dict.fromkeys([visit if visit > 0 else -visit for visit in visits])
    return {label: number for number, label in enumerate(labels, 1)}


def _check_visits(visits: Sequence[int], given: object = None) -> None:
    """Check that each label is visited once over and once under, in order of first visit.

    Args:
        visits: +label over, -label under.
        given: what the error quotes; the visits if None.

    Raises:
        InvalidInput: they are not a Gauss code.
    """
    given = visits if given is None else given
    numbers = _numbers(visits)
    if any(label != number for label, number in numbers.items()):
        expected = "in order of first visit they are 1, 2, 3, ..."
        raise invalid_code("its labels are out of order", given, expected)
    if not len(visits) == len({*visits}) == 2 * len(numbers):
        counts = ((k, visits.count(k), visits.count(-k)) for k in numbers)
        label, over, under = next(count for count in counts if count[1:] != (1, 1))
        problem = f"crossing {label} is visited {over} times over and {under} under"
        raise invalid_code(problem, given, "expected once over (+) and once under (-)")


def invalid_code(problem: str, given: object, expected: str, kind: str = "Gauss") -> InvalidInput:
    """Make the error for text or visits that aren't a code of some kind."""
    shown = repr(given)
    shown = shown if len(shown) <= 80 else f"{shown[:77]}..."
    return InvalidInput(f"invalid {kind} code, {problem}: got {shown}; {expected}")
