"""Gauss codes: what one walk along the rope sees of its crossings.

A code is a tuple of visits. The n crossings are labelled 1, 2, ..., n in order of first visit; a
visit is +label where the walker is on the upper strand and -label where it is on the lower one. The
text is "1+,1-,2+,2-", the flat loop "".

Chirality adds one letter a crossing, pyknotid's: "c" for a positive (right-handed) crossing,
(d_over x d_under)_z > 0 with d the direction of walking, "a" for a negative one. Reversing the walk
changes no letter.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from knotgym.common.errors import KnotgymError

POSITIVE = "c"
NEGATIVE = "a"

_SWITCHED = {ord(NEGATIVE): POSITIVE, ord(POSITIVE): NEGATIVE}
_VISIT = re.compile(r"\s*([1-9][0-9]*)\s*([+-])\s*([ac]?)\s*")


class InvalidGaussCode(KnotgymError, ValueError):
    """These visits are no Gauss code."""

    def __init__(self, problem: str, given: object, right: str) -> None:
        super().__init__(f"not a Gauss code, {problem}: got {given!r}; {right}")


class UnknownChirality(KnotgymError, ValueError):
    """The handedness of the crossings was asked of a code that does not hold it."""

    def __init__(self, code: GaussCode) -> None:
        super().__init__(
            f"the code {str(code)!r} does not say how its crossings turn; give one letter a"
            " crossing, as in '1+a,1-a'"
        )


@dataclass(frozen=True, slots=True)
class GaussCode:
    """A based, directed Gauss code; equal and hashed by value.

    Attributes:
        visits: +label over, -label under, in the order of the walk.
        chirality: letter i belongs to label i + 1; None when unknown. The empty code has nothing to
            know: it always holds "".

    Raises:
        InvalidGaussCode: a label is not visited once over and once under, or labels are not in
            order of first visit.

    >>> GaussCode((1, -1), "c").chiral
    '1+c,1-c'
    """

    visits: tuple[int, ...] = ()
    chirality: str | None = None

    def __post_init__(self) -> None:
        if type(self.visits) is not tuple:
            object.__setattr__(self, "visits", tuple(self.visits))
        if not self.visits and self.chirality is None:
            object.__setattr__(self, "chirality", "")
        _check_visits(self.visits)
        letters = self.chirality
        if letters is not None and (len(letters) != self.nx or letters.strip(POSITIVE + NEGATIVE)):
            raise InvalidGaussCode(
                "wrong chirality", letters, f"right would be {self.nx} letters, each 'a' or 'c'"
            )

    @classmethod
    def parse(cls, text: str) -> GaussCode:
        """Read "1+,1-" or "1+a,1-a"; spaces are allowed.

        Raises:
            InvalidGaussCode: the text is malformed, or only some visits have a letter, or a
                crossing has two different ones.

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
                raise InvalidGaussCode(
                    f"cannot read the visit {word.strip()!r}",
                    text,
                    "a visit is a number, + or -, and perhaps a or c",
                )
            label = int(visit[1])
            visits.append(label if visit[2] == "+" else -label)
            if letters.setdefault(label, visit[3]) != visit[3]:
                raise InvalidGaussCode(
                    f"crossing {label} has two different letters",
                    text,
                    "both its visits carry the same letter, or none",
                )
        _check_visits(visits, text)
        chirality = "".join(letters[label] for label in range(1, len(letters) + 1))
        if chirality and len(chirality) != len(letters):
            raise InvalidGaussCode(
                "only some crossings have a letter",
                text,
                "either every visit has a letter or none has",
            )
        return cls(tuple(visits), chirality or None)

    @classmethod
    def relabelled(
        cls, visits: Iterable[int], letters: Mapping[int, str] | None = None
    ) -> GaussCode:
        """Number arbitrary labels in order of first visit; letters go by the old label.

        >>> str(GaussCode.relabelled([7, -3, 3, -7]))
        '1+,2-,2+,1-'
        """
        visits = tuple(visits)
        new = _numbers(visits)
        renamed = tuple([new[abs(visit)] if visit > 0 else -new[abs(visit)] for visit in visits])
        return cls(renamed, None if letters is None else "".join([letters[label] for label in new]))

    def __str__(self) -> str:
        return ",".join([f"{visit}+" if visit > 0 else f"{-visit}-" for visit in self.visits])

    @property
    def chiral(self) -> str:
        """The text with letters.

        Raises:
            UnknownChirality: there are none.
        """
        letters = self._letters()
        labels = [f"{visit}+" if visit > 0 else f"{-visit}-" for visit in self.visits]
        turns = [letters[abs(visit) - 1] for visit in self.visits]
        return ",".join([label + turn for label, turn in zip(labels, turns, strict=True)])

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return len(self.visits) // 2

    @property
    def plain(self) -> GaussCode:
        """The same code without its chirality, as the reward compares it."""
        if self.chirality is None or not self.visits:
            return self
        return trusted_code(self.visits, None)

    @property
    def signs(self) -> tuple[int, ...]:
        """+1 for each "c" and -1 for each "a", in order of labels.

        Raises:
            UnknownChirality: there are no letters.
        """
        return tuple([1 if letter == POSITIVE else -1 for letter in self._letters()])

    @property
    def writhe(self) -> int:
        """The sum of the signs.

        >>> GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c").writhe  # right-handed trefoil
        3
        """
        return sum(self.signs)

    def matches(self, other: GaussCode, chirality: bool = False) -> bool:
        """Say whether both show the same visits and, where asked, the same letters.

        Raises:
            UnknownChirality: letters were asked for and one of the two has none.
        """
        if chirality:
            return self._letters() == other._letters() and self.visits == other.visits
        return self.visits == other.visits

    def mirrored(self) -> GaussCode:
        """Switch every crossing, as seen after z -> -z with the camera left above.

        >>> GaussCode.parse("1+c,1-c").mirrored().chiral
        '1-a,1+a'
        """
        return trusted_code(tuple([-visit for visit in self.visits]), self._flipped())

    def reflected(self) -> GaussCode:
        """Turn the picture over left to right (x -> -x): heights stay, letters change."""
        return trusted_code(self.visits, self._flipped())

    def reversed(self) -> GaussCode:
        """Walk the other way from the same base point.

        >>> str(GaussCode.parse("1+,2-,2+,1-").reversed())
        '1-,2+,2-,1+'
        """
        return self.of_visits(self.visits[::-1])

    def rebased(self, k: int) -> GaussCode:
        """Start the walk just before visit k, counted modulo the number of visits.

        >>> str(GaussCode.parse("1+,2-,2+,1-").rebased(1))
        '1-,1+,2-,2+'
        """
        if not self.visits:
            return self
        k %= len(self.visits)
        return self.of_visits(self.visits[k:] + self.visits[:k])

    def _letters(self) -> str:
        if self.chirality is None:
            raise UnknownChirality(self)
        return self.chirality

    def _flipped(self) -> str | None:
        if self.chirality is None:
            return None
        return self.chirality.translate(_SWITCHED)

    def of_visits(self, visits: tuple[int, ...]) -> GaussCode:
        """The code of its own visits, or of all those of some crossings, in another order.

        Labels are numbered anew; nothing is checked.

        >>> GaussCode.parse("1+a,2+c,2-c,1-a").of_visits((-2, 2)).chiral
        '1-c,1+c'
        """
        new = _numbers(visits)
        renamed = tuple([new[visit] if visit > 0 else -new[-visit] for visit in visits])
        letters = self.chirality
        if letters is not None:
            letters = "".join([letters[label - 1] for label in new])
        return trusted_code(renamed, letters)


def trusted_code(visits: tuple[int, ...], chirality: str | None) -> GaussCode:
    """A code from parts that are known to make one; nothing is checked, which takes a tenth."""
    code = object.__new__(GaussCode)
    object.__setattr__(code, "visits", visits)
    object.__setattr__(code, "chirality", chirality)
    return code


def _numbers(visits: tuple[int, ...]) -> dict[int, int]:
    """Labels -> their numbers in order of first visit."""
    labels = dict.fromkeys([visit if visit > 0 else -visit for visit in visits])
    return {label: number for number, label in enumerate(labels, 1)}


def _check_visits(visits: Iterable[int], given: object = None) -> None:
    """Raise InvalidGaussCode unless every label comes once over and once under, in order.

    `given` is what the error shows.
    """
    given = visits if given is None else given
    awaited: list[int] = []  # per label the visit still to come, 0 when it came
    for visit in visits:
        label = visit if visit > 0 else -visit
        if label == len(awaited) + 1:
            awaited.append(-visit)
        elif not 0 < label <= len(awaited):
            raise InvalidGaussCode(
                f"label {label} comes too early",
                given,
                f"labels go in order of first visit, next is {len(awaited) + 1}",
            )
        elif awaited[label - 1] != visit:
            raise InvalidGaussCode(
                f"crossing {label} is visited amiss",
                given,
                "right would be once over (+) and once under (-)",
            )
        else:
            awaited[label - 1] = 0
    if any(awaited):
        label = next(index for index, visit in enumerate(awaited, 1) if visit)
        raise InvalidGaussCode(
            f"crossing {label} is visited only once",
            given,
            "right would be once over (+) and once under (-)",
        )
