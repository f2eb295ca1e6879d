"""Planar diagrams of Gauss codes: planarity, chirality, faces, summands, and lists of codes.

A code with chirality is a combinatorial map on a surface: crossings are vertices, the strands
between visits are edges, and walking on with a left turn at every crossing traces the faces. The
code is planar if and only if that surface is a sphere, that is, if it has n + 2 faces (Euler).

Without chirality, the handedness of the crossings follows from their interlacement (H. de Fraysseix
and P. Ossona de Mendez, "On a characterization of Gauss codes", 1999). Two crossings interlace if
their visits alternate. In a planar code, whether two interlaced crossings turn the same way depends
on the parity of their positions in the code and of the number of crossings that interlace both.
Each connected component of the interlacement graph may be flipped as a whole, so a planar code has
2 ** components handedness patterns. The faces are counted at the end, so a wrong pattern can't
pass.

Edge k runs from visit k to visit k + 1 (cyclic). Dart 2 k is edge k walked forwards, dart 2 k + 1
is edge k walked backwards.

After a change run `pytest tests/topology/test_diagrams.py`,
where samples are compared with the exact lists (chi-square): there are 1, 2, 8, 48, 384 and 3,616
planar codes, and chiralities are those of a search over all patterns.
"""

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from knotgym.common import InvalidInput
from knotgym.topology.gauss import GaussCode


def is_planar(code: GaussCode) -> bool:
    """Return whether a closed curve seen from above can have this code, with its chirality if any.

    >>> is_planar(GaussCode.parse("1+,2-,3+,1-,2+,3-")), is_planar(GaussCode.parse("1+,2-,1-,2+"))
    (True, False)
    """
    if code.chirality is None:
        return _planar_turns(code) is not None
    return _is_sphere(face_permutation(code))


def with_chirality(code: GaussCode) -> GaussCode:
    """Return the code with a planar chirality: its own, or the alphabetically first one.

    Raises:
        InvalidInput: the code has no planar chirality, or its own is not planar.
    """
    if code.chirality is not None:
        if _is_sphere(face_permutation(code)):
            return code
    elif (turned := _planar_turns(code)) is not None:
        part, signs = turned[0], _signs(code.visits, turned[1])
        # flip each part so that its first letter is "a"
        flips = {number: -signs[part.index(number)] for number in set(part)}
        return GaussCode(
            code.visits,
            GaussCode.letters_of([sign * flips[part[k]] for k, sign in enumerate(signs)]),
        )
    text = str(code) if code.chirality is None else code.chiral
    raise InvalidInput(f"no closed curve that is drawn in the plane shows the code {text!r}")


def chiralities(code: GaussCode) -> tuple[str, ...]:
    """List the planar handedness patterns of the visits, in alphabetical order.

    The code's own chirality is ignored. A code that is not planar has no patterns; any other has
    2 ** parts, at most 2 ** n (n separate kinks).

    >>> chiralities(GaussCode.parse("1+,2-,3+,1-,2+,3-"))
    ('aaa', 'ccc')
    """
    turned = _planar_turns(code)
    if turned is None:
        return ()
    part, turns = turned
    patterns = []
    # Components may be flipped independently, so there are 2 ** parts patterns.
    for flips in product((1, -1), repeat=max(part, default=-1) + 1):  # one per part
        signs = _signs(code.visits, [turn * flips[part[label]] for label, turn in enumerate(turns)])
        patterns.append(GaussCode.letters_of(signs))
    return tuple(sorted(patterns))


def summands(code: GaussCode) -> list[GaussCode]:
    """Cut the diagram into the connected components of its interlacement graph, in order of first
    visit; the knot is the connected sum of theirs.

    >>> [str(summand) for summand in summands(GaussCode.parse("1+,2-,3+,1-,2+,3-,4+,4-"))]
    ['1+,2-,3+,1-,2+,3-', '1+,1-']
    """
    part, _ = _walked(code.visits)
    return [
        code.of_visits(tuple([visit for visit in code.visits if part[abs(visit) - 1] == k]))
        for k in range(max(part, default=-1) + 1)
    ]


def face_permutation(code: GaussCode) -> list[int]:
    """Return, for each dart, the next dart with the same face on its left.

    Raises:
        InvalidInput: the code has no chirality.
    """
    return _face_permutation(code.visits, _signs(code.visits, code.signs))


def faces(code: GaussCode) -> list[list[int]]:
    """List the faces of a code with chirality, each as the cycle of darts that have it on the left.

    The plain loop has no darts, so its list is empty.

    Raises:
        InvalidInput: the code has no chirality.
    """
    return cycles(face_permutation(code))


def planar_codes(nx: int) -> Iterator[GaussCode]:
    """Yield every planar code with nx crossings, without chirality, once each.

    Their numbers are 1, 2, 8, 48, 384, 3616, 37888, ...

    Args:
        nx: number of crossings, at least 0.
    """
    # As in `uniform_code`, each label has one even and one odd position: a permutation pairs them.
    words = set[tuple[int, ...]]()
    for odd in permutations(range(nx)):
        labels = [label for pair in enumerate(odd) for label in pair]
        new = {label: number for number, label in enumerate(dict.fromkeys(labels), 1)}
        words.add(tuple(new[label] for label in labels))
    # Planarity depends only on the order of the labels: test each word once, then choose heights.
    for word in sorted(words):
        if is_planar(GaussCode(_with_heights(word, [1] * nx))):
            for heights in product((1, -1), repeat=nx):
                yield GaussCode(_with_heights(word, list(heights)))


def uniform_code(nx: int, rng: np.random.Generator) -> GaussCode:
    """Sample a planar code with nx crossings, uniformly from `planar_codes(nx)`.

    A closed curve crosses a loop an even number of times, so the two visits of a crossing have
    positions of opposite parity in the code. A uniform permutation pairs even positions with odd
    ones; pairings that are not planar are rejected (1,804 of 10,000 are kept at 10 crossings). The
    ones kept are equally likely, and so are the 2 ** n choices of upper strands. Rejecting codes of
    other knots keeps the distribution uniform.
    """
    while True:
        word = np.empty(2 * nx, dtype=np.int64)
        # even positions hold each label once, odd ones a permutation of them: every pairing of
        # opposite parities, equally often
        word[0::2] = np.arange(1, nx + 1)
        word[1::2] = rng.permutation(nx) + 1
        over = rng.integers(2, size=nx)
        code = GaussCode.relabelled(_with_heights(word.tolist(), (2 * over - 1).tolist()))
        if is_planar(code):
            return code


def _with_heights(word: Sequence[int], heights: list[int]) -> tuple[int, ...]:
    """Turn labels into visits; heights[label - 1] is +1 if the label's first visit is over."""
    seen: set[int] = set()
    visits = []
    for label in word:
        visits.append(-label * heights[label - 1] if label in seen else label * heights[label - 1])
        seen.add(label)
    return tuple(visits)


# A crossing turns left (+1) if its second passage leads to the left of its first, else right (-1).
# Its sign compares the over strand with the under strand instead, so the two numbers differ where
# the first visit is under.


def _signs(visits: tuple[int, ...], turns: list[int] | tuple[int, ...]) -> list[int]:
    """Convert turns to crossing signs, or signs to turns; the conversion is its own inverse."""
    first: dict[int, int] = {}
    for visit in visits:
        # only whether the first visit is over matters
        first.setdefault(abs(visit), visit)
    return [turn if visit > 0 else -turn for turn, visit in zip(turns, first.values(), strict=True)]


def _code_positions(visits: tuple[int, ...]) -> list[list[int]]:
    """Return, for each label, the indices of its two visits."""
    positions: list[list[int]] = [[] for _ in range(len(visits) // 2)]
    for k, visit in enumerate(visits):
        positions[abs(visit) - 1].append(k)
    return positions


def _face_permutation(visits: tuple[int, ...], turns: list[int]) -> list[int]:
    count = len(visits)
    onwards = [0] * (2 * count)
    for (first, second), turn in zip(_code_positions(visits), turns, strict=True):
        # `left`: the passage `there` leads to the left as seen along the passage `here`
        for here, there, left in ((first, second, turn > 0), (second, first, turn < 0)):
            # the two darts that leave the crossing along the other strand
            outwards, back = 2 * there, 2 * ((there - 1) % count) + 1
            # turn left both from the dart that arrives forwards at `here` and from the one that
            # arrives there backwards, for which left and right are swapped
            onwards[2 * ((here - 1) % count)] = outwards if left else back
            onwards[2 * here + 1] = back if left else outwards
    return onwards


def _is_sphere(permutation: list[int]) -> bool:
    """Count the faces, and apply Euler's formula."""
    # n crossings, 2 n edges, 4 n darts: n - 2 n + faces = 2; the plain loop has no darts
    return not permutation or len(cycles(permutation)) == len(permutation) // 4 + 2


def cycles(permutation: list[int]) -> list[list[int]]:
    """List the cycles of a permutation, in order of their first members."""
    seen = [False] * len(permutation)
    walks = []
    for dart in range(len(permutation)):
        cycle = []
        while not seen[dart]:
            seen[dart] = True
            cycle.append(dart)
            dart = permutation[dart]
        if cycle:
            walks.append(cycle)
    return walks


def _interlacement(positions: list[list[int]]) -> list[set[int]]:
    """Return, for each label (from 0), the labels whose visits alternate with its own."""
    return [
        {other for other, (c, e) in enumerate(positions) if (a < c < b) != (a < e < b)}
        for a, b in positions
    ]


def _walked(visits: tuple[int, ...]) -> tuple[list[int], list[int]]:
    """Walk the interlacement graph, depth first from each label that wasn't reached before.

    Returns:
        The number of each label's component, from 0 in order of first visit; and turns. In each
        component the first crossing turns left, and the parity rule of de Fraysseix and Ossona de
        Mendez fixes the others: these are a planar handedness of the visits if there is one.
    """
    positions = _code_positions(visits)
    interlaced = _interlacement(positions)
    part, turns, number = [-1] * len(interlaced), [1] * len(interlaced), 0
    for label in range(len(interlaced)):
        if part[label] >= 0:
            continue
        part[label], todo = number, [label]
        while todo:
            known = todo.pop()
            for other in interlaced[known]:
                if part[other] < 0:
                    part[other] = number
                    # common: how many crossings interlace both
                    common = len(interlaced[known] & interlaced[other])
                    alike = (common + positions[known][0] + positions[other][0]) % 2 == 1
                    turns[other] = turns[known] if alike else -turns[known]
                    todo.append(other)
        number += 1
    return part, turns


def _planar_turns(code: GaussCode) -> tuple[list[int], list[int]] | None:
    """Return what `_walked` does, or None if no handedness of the visits is planar."""
    part, turns = _walked(code.visits)
    # the rule holds for planar codes alone, so the faces are counted, too
    return (part, turns) if _is_sphere(_face_permutation(code.visits, turns)) else None
