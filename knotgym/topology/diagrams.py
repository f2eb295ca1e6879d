"""Which Gauss codes a curve in the plane can show, decided for the code at hand.

A code with chirality fixes a surface: crossings are vertices, the strands between visits edges, and
turning left at every crossing walks around the faces. The code can be drawn in the plane just when
that surface is a sphere, that is when the faces number n + 2 (Euler).

Without chirality, the handedness follows from the interlacement of the crossings (H. de Fraysseix
and P. Ossona de Mendez, "On a characterization of Gauss codes", 1999): two crossings interlace when
their visits alternate; in a planar code interlaced crossings turn alike or not according to the
parities of their places and of the number of crossings that interlace both. Each connected part of
the interlacement may then be turned over as a whole, so a planar code has 2 ** parts handedness
patterns. The faces are counted in the end, so a mistaken pattern could not pass.

Edge k runs from visit k to visit k + 1 (cyclic); dart 2 k walks it forwards, dart 2 k + 1
backwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

from knotgym.common.errors import KnotgymError
from knotgym.topology.gauss import NEGATIVE, POSITIVE, GaussCode


class NotPlanar(KnotgymError, ValueError):
    """No curve in the plane shows this code."""

    def __init__(self, code: GaussCode) -> None:
        text = str(code) if code.chirality is None else code.chiral
        super().__init__(
            f"no closed curve shows the code {text!r}; right would be one that is_planar() accepts"
        )


def is_planar(code: GaussCode) -> bool:
    """Say whether a closed curve seen from above can show the code, and its chirality if any.

    >>> is_planar(GaussCode.parse("1+,2-,3+,1-,2+,3-")), is_planar(GaussCode.parse("1+,2-,1-,2+"))
    (True, False)
    """
    if code.chirality is None:
        return _some_turns(code) is not None
    return _has_sphere(following(code))


def drawn(code: GaussCode) -> GaussCode:
    """Return the code with a chirality that can be drawn: its own, or the first there is.

    Raises:
        NotPlanar: there is none, or its own cannot be drawn.
    """
    if code.chirality is not None:
        if _has_sphere(following(code)):
            return code
    elif (turns := _some_turns(code)) is not None:
        part, signs = parts(code), _signs(code.visits, turns)
        # the first letter of each part is as early in the alphabet as it can be
        flips = {number: -signs[part.index(number)] for number in set(part)}
        return GaussCode(
            code.visits, _letters([sign * flips[part[k]] for k, sign in enumerate(signs)])
        )
    raise NotPlanar(code)


def chiralities(code: GaussCode) -> tuple[str, ...]:
    """List the handedness patterns with which the visits can be drawn, in alphabetical order.

    There are none when the code is not planar.

    The code's own chirality is not looked at. There are 2 ** parts patterns: at most 2 ** n, for n
    separate kinks.

    >>> chiralities(GaussCode.parse("1+,2-,3+,1-,2+,3-"))
    ('aaa', 'ccc')
    """
    turns = _some_turns(code)
    if turns is None:
        return ()
    part = parts(code)
    patterns = []
    for flips in product((1, -1), repeat=max(part, default=-1) + 1):
        signs = _signs(code.visits, [turn * flips[part[label]] for label, turn in enumerate(turns)])
        patterns.append(_letters(signs))
    return tuple(sorted(patterns))


def parts(code: GaussCode) -> tuple[int, ...]:
    """Number the connected parts of the interlacement, from 0 in order of first visit.

    Returns one number a label.

    Each part, alone, is the code of one factor of the diagram as a connected sum.

    >>> parts(GaussCode.parse("1+,2-,3+,1-,2+,3-,4+,4-"))
    (0, 0, 0, 1)
    """
    interlaced = _interlacement(code.visits)
    part = [-1] * code.nx
    number = 0
    for label in range(code.nx):
        if part[label] < 0:
            todo = [label]
            part[label] = number
            while todo:
                for other in _labels(interlaced[todo.pop()]):
                    if part[other] < 0:
                        part[other] = number
                        todo.append(other)
            number += 1
    return tuple(part)


def summands(code: GaussCode) -> list[GaussCode]:
    """Cut the diagram into its parts(): the knot is their connected sum.

    >>> [str(summand) for summand in summands(GaussCode.parse("1+,2-,3+,1-,2+,3-,4+,4-"))]
    ['1+,2-,3+,1-,2+,3-', '1+,1-']
    """
    part = parts(code)
    letters = None if code.chirality is None else dict(enumerate(code.chirality, 1))
    return [
        GaussCode.relabelled([visit for visit in code.visits if part[abs(visit) - 1] == k], letters)
        for k in range(max(part, default=-1) + 1)
    ]


def following(code: GaussCode) -> list[int]:
    """Give, per dart, the next one that has the same face on its left.

    Raises:
        UnknownChirality: the code has no chirality.
    """
    return _following(code.visits, _signs(code.visits, code.signs))


def faces(code: GaussCode) -> list[list[int]]:
    """List the faces of a code with chirality: the darts that have each on their left, as walked.

    The flat loop has no darts and lists no faces.

    Raises:
        UnknownChirality: the code has no chirality.
    """
    onwards = following(code)
    seen = [False] * len(onwards)
    walks = []
    for dart in range(len(onwards)):
        face = []
        while not seen[dart]:
            seen[dart] = True
            face.append(dart)
            dart = onwards[dart]
        if face:
            walks.append(face)
    return walks


def planar_codes(nx: int) -> Iterator[GaussCode]:
    """Yield every planar code with nx crossings, without chirality, once each.

    There are 1, 2, 8, 48, 384, 3616, 37888, ... of them.

    Args:
        nx: number of crossings, at least 0.
    """
    for word in _words([0] * (2 * nx), 1):
        if is_planar(GaussCode(_with_heights(word, [1] * nx))):
            for heights in product((1, -1), repeat=nx):
                yield GaussCode(_with_heights(word, list(heights)))


def _words(word: list[int], label: int) -> Iterator[list[int]]:
    """Fill the zeros with pairs of labels, an even number of visits between the two of a pair.

    A curve crosses a loop an even number of times.
    """
    if 0 not in word:
        yield word.copy()
        return
    first = word.index(0)
    word[first] = label
    for second in range(first + 1, len(word), 2):
        if word[second] == 0:
            word[second] = label
            yield from _words(word, label + 1)
            word[second] = 0
    word[first] = 0


def _with_heights(word: list[int], heights: list[int]) -> tuple[int, ...]:
    """Sign the labels: heights says, per label, whether the first visit is over."""
    seen: set[int] = set()
    visits = []
    for label in word:
        visits.append(-label * heights[label - 1] if label in seen else label * heights[label - 1])
        seen.add(label)
    return tuple(visits)


# A turn is, per label, the side to which the second passage of a crossing leads, seen along the
# first: +1 left.


def _signs(visits: tuple[int, ...], turns: list[int] | tuple[int, ...]) -> list[int]:
    """Turns to crossing signs, or signs to turns: they differ where the first visit is under."""
    first: dict[int, int] = {}
    for visit in visits:
        first.setdefault(abs(visit), visit)
    return [turn if visit > 0 else -turn for turn, visit in zip(turns, first.values(), strict=True)]


def _letters(signs: list[int]) -> str:
    return "".join([POSITIVE if sign > 0 else NEGATIVE for sign in signs])


def _places(visits: tuple[int, ...]) -> list[list[int]]:
    """The two places of every label in the walk."""
    places: list[list[int]] = [[] for _ in range(len(visits) // 2)]
    for k, visit in enumerate(visits):
        places[abs(visit) - 1].append(k)
    return places


def _following(visits: tuple[int, ...], turns: list[int]) -> list[int]:
    """Per dart the next one with the same face on its left."""
    count = len(visits)
    onwards = [0] * (2 * count)
    for (first, second), turn in zip(_places(visits), turns, strict=True):
        for here, there, left in ((first, second, turn > 0), (second, first, turn < 0)):
            outwards, back = 2 * there, 2 * ((there - 1) % count) + 1
            onwards[2 * ((here - 1) % count)] = outwards if left else back
            onwards[2 * here + 1] = back if left else outwards
    return onwards


def _has_sphere(darts: list[int]) -> bool:
    """Count the faces; the list is used up."""
    if not darts:
        return True
    number = 0
    for start in range(len(darts)):
        if darts[start] >= 0:
            number += 1
            dart = start
            while darts[dart] >= 0:
                darts[dart], dart = -1, darts[dart]
    return number == len(darts) // 4 + 2


def _interlacement(visits: tuple[int, ...]) -> list[int]:
    """Per label (from 0) the set of labels that interlace it, as bits of an int."""
    interlaced = [0] * (len(visits) // 2)
    open_since: list[int] = []
    for visit in visits:
        label = abs(visit) - 1
        if label not in open_since:
            open_since.append(label)
            continue
        place = open_since.index(label)
        for other in open_since[place + 1 :]:
            interlaced[label] |= 1 << other
            interlaced[other] |= 1 << label
        del open_since[place]
    return interlaced


def _labels(bits: int) -> Iterator[int]:
    while bits:
        low = bits & -bits
        yield low.bit_length() - 1
        bits ^= low


def _some_turns(code: GaussCode) -> list[int] | None:
    """One planar handedness of the visits, as turns, or None when there is none."""
    interlaced = _interlacement(code.visits)
    places = _places(code.visits)
    turns = [0] * code.nx
    for label in range(code.nx):
        if turns[label] == 0:
            turns[label] = 1
            todo = [label]
            while todo:
                known = todo.pop()
                for other in _labels(interlaced[known]):
                    if turns[other] == 0:
                        common = (interlaced[known] & interlaced[other]).bit_count()
                        alike = (common + places[known][0] + places[other][0]) % 2 == 1
                        turns[other] = turns[known] if alike else -turns[known]
                        todo.append(other)
    return turns if _has_sphere(_following(code.visits, turns)) else None
