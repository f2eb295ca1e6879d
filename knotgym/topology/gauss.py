"""Gauss codes: the sequence of crossings met on one walk along the rope.

A code is a tuple of visits. The n crossings are labelled 1, 2, ..., n in order of first visit. A
visit is +label on the upper strand and -label on the lower one. As text a code reads "1+,1-,2+,2-",
and the plain loop is "".

Chirality adds one letter per crossing, as in pyknotid: "c" for a positive (right-handed) crossing,
where (d_over x d_under)_z > 0 with d the direction of walking, and "a" for a negative one.
Reversing the walk changes no letter.

After a change run `pytest tests/topology/test_gauss.py`: each symmetry, applied twice, must be
nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

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
        if type(self.visits) is not tuple:
            # Callers pass lists, too; a frozen dataclass can only be set this way.
            object.__setattr__(self, "visits", tuple(self.visits))
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
        label, over, under = next(one for one in counts if one[1:] != (1, 1))
        problem = f"crossing {label} is visited {over} times over and {under} under"
        raise invalid_code(problem, given, "expected once over (+) and once under (-)")


def invalid_code(problem: str, given: object, expected: str, kind: str = "Gauss") -> InvalidInput:
    """Make the error for text or visits that aren't a code of some kind."""
    shown = repr(given)
    shown = shown if len(shown) <= 80 else f"{shown[:77]}..."
    return InvalidInput(f"invalid {kind} code, {problem}: got {shown}; {expected}")
