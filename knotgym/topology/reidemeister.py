"""Simpler diagrams of the same knot.

Kinks and bigons (Reidemeister's first and second move) are taken out first. Then strands are
lifted: a stretch of the rope that at each of its crossings passes over, or under a part of itself
walked before, hangs above all the rest, so it may be laid down again along any way between its
ends, crossing over whatever is there. The shortest way through the faces is taken. The same is done
from below. A lift is a chain of Reidemeister moves of all three kinds.

Lifts that keep the number of crossings lead from diagram to diagram in a search of bounded effort,
so a result may still have more crossings than its knot needs. No step draws random numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from knotgym.topology.diagrams import drawn, following, summands
from knotgym.topology.gauss import NEGATIVE, POSITIVE, GaussCode

_DETOURS = 4  # equally short ways tried per lift


def simplify(code: GaussCode, effort: int = 64) -> GaussCode:
    """Return a code with chirality of the same knot, with no more crossings.

    Summands of the diagram are simplified one by one and then strung together, so the base point is
    not kept.

    Args:
        code: a planar code; without chirality it is drawn() first, so its knot is known up to
            mirrored summands.
        effort: how many diagrams a summand's search may look at after the last that had fewer
            crossings.

    Raises:
        NotPlanar: no closed curve shows the code.

    >>> simplify(GaussCode.parse("1+,2+,3-,1-,2-,3+")).nx
    0
    """
    return strung([_least(summand, effort) for summand in summands(without_bigons(drawn(code)))])


def without_bigons(code: GaussCode) -> GaussCode:
    """Take out kinks and bigons until there are none; the base point stays on its strand.

    Args:
        code: planar, with chirality.

    >>> without_bigons(GaussCode.parse("1+a,2-c,2+c,1-a")).nx
    0
    """
    visits = _without_kinks(code.visits)
    signs = code.signs
    while True:
        pair = _bigon(visits, signs)
        if pair is None:
            break
        visits = _without_kinks(
            [visit for visit in visits if visit not in pair and -visit not in pair]
        )
    if len(visits) == len(code.visits):
        return code
    return GaussCode.relabelled(
        visits, {label: POSITIVE if sign > 0 else NEGATIVE for label, sign in enumerate(signs, 1)}
    )


def is_alternating(code: GaussCode) -> bool:
    """Whether the strand goes over and under in turns."""
    return all(
        (visit > 0) != (after > 0)
        for visit, after in zip(code.visits, code.visits[1:], strict=False)
    )


def strung(codes: list[GaussCode]) -> GaussCode:
    """The connected sum: one diagram after the other along the rope."""
    visits: list[int] = []
    letters: list[str] = []
    for code in codes:
        visits.extend(
            visit + len(letters) if visit > 0 else visit - len(letters) for visit in code.visits
        )
        letters.extend(code.chirality or "")
    return GaussCode(tuple(visits), "".join(letters))


def _without_kinks(visits: list[int] | tuple[int, ...]) -> list[int]:
    kept: list[int] = []
    for visit in visits:
        if kept and kept[-1] == -visit:
            kept.pop()
        else:
            kept.append(visit)
    while kept and kept[0] == -kept[-1]:
        kept = kept[1:-1]
    return kept


def _bigon(visits: list[int], signs: tuple[int, ...]) -> tuple[int, int] | None:
    """Two labels of opposite sign that follow each other on the upper and on the lower strand."""
    count = len(visits)
    lower = {-visit: k for k, visit in enumerate(visits) if visit < 0}
    for k in range(count):
        first, second = visits[k - 1], visits[k]
        if (
            first > 0
            and second > 0
            and signs[first - 1] != signs[second - 1]
            and (lower[first] - lower[second]) % count in (1, count - 1)
        ):
            return first, second
    return None


def _least(code: GaussCode, effort: int) -> GaussCode:
    """The summand with fewest crossings that is found: straight down first, then on the level.

    An alternating diagram without crossings that split it has the fewest already (Kauffman,
    Murasugi, Thistlethwaite, 1987).
    """
    code = _descended(code)
    if len(summands(code)) > 1:
        return strung([_least(summand, effort) for summand in summands(code)])
    if is_alternating(code):
        return code
    seen = {_canonical(code)}
    level = deque([code])
    for _ in range(effort):
        if not level or code.nx < 3:
            break
        for neighbour in _lifts(level.popleft(), 0):
            lower = _descended(neighbour)
            if lower.nx < code.nx:
                return _least(lower, effort)
            key = _canonical(lower)
            if key not in seen:
                seen.add(key)
                level.append(lower)
    return code


def _descended(code: GaussCode) -> GaussCode:
    """Repeat lifts that take away crossings until there is none."""
    while True:
        code = without_bigons(code)
        lower = next(_lifts(code, 1), None)
        if lower is None:
            return code
        code = lower


def _lifts(code: GaussCode, gain: int) -> Iterator[GaussCode]:
    """Diagrams after one lift, from above or below, that takes away at least `gain` crossings."""
    for view, back in ((code, False), (code.mirrored(), True)):
        for start in range(len(view.visits)):
            for length, labels in _stretches(view.visits, start, whole=gain > 0):
                for lifted in _laid(view, start + length, labels, len(labels) - gain):
                    yield lifted.mirrored() if back else lifted


def _stretches(
    visits: tuple[int, ...], start: int, whole: bool
) -> list[tuple[int, frozenset[int]]]:
    """Stretches from visit `start` that hang above the rest, all or only the longest.

    Returns their lengths in visits, and the labels met.
    """
    met: set[int] = set()
    found: list[tuple[int, frozenset[int]]] = []
    for length in range(1, len(visits) + 1):
        visit = visits[(start + length - 1) % len(visits)]
        if visit > 0:
            met.add(visit)
        elif -visit not in met:
            break
        if whole:
            found.clear()
        found.append((length, frozenset(met)))
    return found


def _laid(code: GaussCode, end: int, labels: frozenset[int], limit: int) -> Iterator[GaussCode]:
    """Take the stretch before visit `end` off and lay it along shortest ways of few crossings."""
    end %= len(code.visits)
    letters = dict(enumerate(code.chirality or "", 1))
    rest = GaussCode.relabelled(
        [visit for visit in code.visits[end:] + code.visits[:end] if abs(visit) not in labels],
        letters,
    )
    if not rest.visits:
        yield rest
        return
    for way in _ways(following(rest), limit):
        yield _crossed(rest, way)


def _ways(onwards: list[int], limit: int) -> Iterator[list[int]]:
    """Shortest ways from one end of the gap in the last edge to the other.

    Each is the darts stepped over from their left.
    """
    face, borders, source, target = _gap_faces(onwards)
    distance = {target: 0}
    queue = deque([target])
    while queue:
        here = queue.popleft()
        for dart in borders[here]:
            there = face[dart ^ 1]
            if there not in distance:
                distance[there] = distance[here] + 1
                queue.append(there)
    if distance[source] > limit:
        return
    ways: list[tuple[int, list[int]]] = [(source, [])]
    yielded = 0
    while ways and yielded < _DETOURS:
        here, way = ways.pop()
        if here == target:
            yielded += 1
            yield way
        else:
            ways.extend(
                (face[dart ^ 1], [*way, dart])
                for dart in borders[here]
                if distance[face[dart ^ 1]] < distance[here]
            )


def _gap_faces(onwards: list[int]) -> tuple[list[int], list[list[int]], int, int]:
    """The faces of a diagram without its last edge.

    Returns:
        the face on the left of each dart; the darts round each face; and the faces into which the
        stubs at the ends of the missing edge lead, the one it leaves from and the one it arrives
        at.
    """
    leaving, arriving = len(onwards) - 2, len(onwards) - 1  # the missing edge's darts
    face = [-1] * leaving
    borders: list[list[int]] = []
    source = target = -1
    for first in range(leaving):
        if face[first] >= 0:
            continue
        number = len(borders)
        borders.append([])
        dart = first
        while face[dart] < 0:
            face[dart] = number
            borders[number].append(dart)
            dart = onwards[dart]
            while dart >= leaving:  # walk around a stub: on it outwards, back on its other side
                if dart == leaving:
                    source = number
                else:
                    target = number
                dart = onwards[leaving + arriving - dart]
    return face, borders, source, target


def _crossed(rest: GaussCode, way: list[int]) -> GaussCode:
    """Close the gap in the last edge by a strand over the edges of these darts.

    Over a forward dart it is positive.
    """
    letters = dict(enumerate(rest.chirality or "", 1))
    under: dict[int, int] = {}
    for label, dart in enumerate(way, rest.nx + 1):
        under[dart // 2] = -label
        letters[label] = POSITIVE if dart % 2 == 0 else NEGATIVE
    visits: list[int] = []
    for edge, visit in enumerate(rest.visits):
        visits.append(visit)
        if edge in under:
            visits.append(under[edge])
    visits.extend(range(rest.nx + 1, rest.nx + 1 + len(way)))
    return GaussCode.relabelled(visits, letters)


def _canonical(code: GaussCode) -> tuple[tuple[int, ...], str]:
    """The same for all base points."""
    bases = [code.rebased(k) for k in range(len(code.visits))] or [code]
    return min((base.visits, base.chirality or "") for base in bases)
