"""Simplification of diagrams without changing the knot.

Kinks and bigons are removed first (Reidemeister's first and second move). Then strands are lifted.
A stretch of rope is liftable if at each of its crossings it passes over, or under an earlier part
of itself: it then lies above everything else, so it may be laid down again along any path between
its ends, over whatever is there. The shortest path through the faces has the fewest crossings. The
same is done from below. A lift is a sequence of Reidemeister moves of all three kinds.

Lifts that keep the number of crossings lead from diagram to diagram in a breadth-first search of
bounded effort, so the result may have more crossings than the knot needs. The search is
deterministic.

After a change run `pytest tests/topology/test_knots.py tests/topology/test_notation.py`: a move
must keep both polynomials, and simplified diagrams their knots.
"""

from collections import deque
from collections.abc import Iterator

from knotgym.topology.diagrams import cycles, face_permutation, summands, with_chirality
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry, canonical

# Neither is delicate: 1 to 8 paths and 16 to 256 diagrams undo the same hard unknots of up to 32
# crossings (all) and leave 60 random diagrams of 11 with as many crossings.
_MAX_PATHS = 4  # equally short paths tried per lift
_EFFORT = 64  # diagrams of a summand that are expanded without finding one with fewer crossings


def simplify(code: GaussCode) -> GaussCode:
    """Return a code with chirality of the same knot, with at most as many crossings.

    The summands of the diagram are simplified one by one and their connected sum is returned, so
    the base point is not kept.

    Args:
        code: a planar code; without chirality it gets one from `diagrams.with_chirality`, so the
            knot is known up to mirrored summands.

    Raises:
        InvalidInput: no closed curve shows the code.

    >>> simplify(GaussCode.parse("1+,2+,3-,1-,2-,3+")).nx
    0
    """
    return connected_sum(
        [_fewest_crossings(summand) for summand in summands(without_bigons(with_chirality(code)))]
    )


def _removals(code: GaussCode) -> Iterator[GaussCode]:
    """Yield the codes without one kink or one bigon, each a first or second move away.

    The base point stays on its strand. A bigon may be the outer face: then the upper strand is
    moved across the whole diagram.

    >>> [one.chiral for one in _removals(GaussCode.parse("1+a,1-a,2-c,2+c"))]
    ['', '1-c,1+c', '1+a,1-a']
    """
    visits, signs = code.visits, code.signs
    count = len(visits)
    # where each visit stands; `-first` is the other visit of the same crossing
    index = {visit: k for k, visit in enumerate(visits)}
    # k and k - 1 are neighbouring visits; with one crossing both pairs are the same kink
    for k in range(1, 2) if count == 2 else range(count):
        first, second = visits[k - 1], visits[k]
        # Two visits of one crossing in a row: the edge between them is a loop.
        kink = first == -second
        if kink or (
            first > 0
            and second > 0
            and signs[first - 1] != signs[second - 1]
            # Both strands meet the same two crossings one after the other, one strand over at both.
            # With signs that differ they cross there and back, and bound a bigon.
            and (index[-first] - index[-second]) % count in (1, count - 1)
        ):
            gone = abs(first), abs(second)
            yield code.of_visits(tuple([visit for visit in visits if abs(visit) not in gone]))


def without_bigons(code: GaussCode) -> GaussCode:
    """Remove kinks and bigons until none are left; the base point stays on its strand.

    Args:
        code: a planar code with chirality.

    >>> without_bigons(GaussCode.parse("1+a,2-c,2+c,1-a")).nx
    0
    """
    # any order leads to a diagram without either; which one may depend on it, the knot doesn't
    while (smaller := next(_removals(code), None)) is not None:
        code = smaller
    return code


def is_alternating(code: GaussCode) -> bool:
    """Return whether the strand goes over and under alternately."""
    return all(
        (visit > 0) != (after > 0)
        for visit, after in zip(code.visits, code.visits[1:], strict=False)
    )


def connected_sum(codes: list[GaussCode]) -> GaussCode:
    """Return the connected sum of diagrams with chirality, one after the other along the rope."""
    visits: list[int] = []
    letters: list[str] = []
    for code in codes:
        visits.extend(
            visit + len(letters) if visit > 0 else visit - len(letters) for visit in code.visits
        )
        letters.extend(code.chirality or "")
    return GaussCode(tuple(visits), "".join(letters))


def _fewest_crossings(code: GaussCode) -> GaussCode:
    """Return the diagram with the fewest crossings that the search finds.

    Lifts that remove crossings are applied greedily. Then a breadth-first search follows lifts that
    keep their number, until a diagram allows removal again.
    """
    code = _without_liftable(code)
    if len(summands(code)) > 1:  # a lift may split the diagram
        return connected_sum([_fewest_crossings(summand) for summand in summands(code)])
    # a reduced alternating diagram is minimal (Kauffman, Murasugi, Thistlethwaite, 1987)
    if is_alternating(code):
        return code
    # Each diagram reached is reduced at once; `level` holds those with as many crossings, up to the
    # base point and reflection, whose lifts have not been tried.
    # without letters, so that reflected summands are one
    seen = {canonical(code, Symmetry.REBASE | Symmetry.PLAIN)}
    level = deque([code])
    for _ in range(_EFFORT):
        if not level or code.nx < 3:  # every knot with fewer than 3 crossings is trivial
            break
        for neighbour in _lifts(level.popleft(), 0):
            lower = _without_liftable(neighbour)
            if lower.nx < code.nx:
                return _fewest_crossings(lower)
            key = canonical(lower, Symmetry.REBASE | Symmetry.PLAIN)
            if key not in seen:
                seen.add(key)
                level.append(lower)
    return code


def _without_liftable(code: GaussCode) -> GaussCode:
    """Apply lifts that remove crossings until none is left."""
    while True:
        code = without_bigons(code)
        lower = next(_lifts(code, 1), None)
        if lower is None:
            return code
        code = lower


def _lifts(code: GaussCode, gain: int) -> Iterator[GaussCode]:
    """Yield the diagrams after one lift that removes at least `gain` crossings.

    Lifts from below are lifts from above of the mirror image.
    """
    # to remove crossings, only the longest stretch from each start is tried
    for view, back in ((code, False), (code.switched(), True)):
        for start in range(len(view.visits)):
            for length, labels in _liftable_stretches(view.visits, start, whole=gain > 0):
                for lifted in _relaid(view, start + length, labels, len(labels) - gain):
                    yield lifted.switched() if back else lifted


def _liftable_stretches(
    visits: tuple[int, ...], start: int, whole: bool
) -> list[tuple[int, frozenset[int]]]:
    """Find the liftable stretches that begin with visit `start`; if `whole`, only the longest.

    Returns:
        For each stretch its length in visits, and the crossings on it.
    """
    # The stretch grows visit by visit. Passing over a strand is always allowed; passing under is
    # allowed if the strand above belongs to the stretch, because it is lifted first.
    met: set[int] = set()
    stretches: list[tuple[int, frozenset[int]]] = []
    for length in range(1, len(visits) + 1):
        visit = visits[(start + length - 1) % len(visits)]
        if visit > 0:
            met.add(visit)
        elif -visit not in met:  # under a strand that doesn't belong to the stretch
            break
        stretches.append((length, frozenset(met)))
    return stretches[-1:] if whole else stretches


def _relaid(code: GaussCode, end: int, labels: frozenset[int], limit: int) -> Iterator[GaussCode]:
    """Remove the stretch before visit `end`; lay it along shortest paths of at most `limit` edges.

    The rest is rebased so that the gap is in its last edge.
    """
    end %= len(code.visits)
    rebased = code.visits[end:] + code.visits[:end]
    rest = code.of_visits(tuple([visit for visit in rebased if abs(visit) not in labels]))
    if not rest.visits:
        yield rest
        return
    for path in _shortest_paths(face_permutation(rest), limit):
        yield _with_overstrand(rest, path)


def _shortest_paths(onwards: list[int], limit: int) -> Iterator[list[int]]:
    """Yield shortest paths through the faces between the two ends of the gap in the last edge.

    A path is the list of darts that it crosses, each from left to right. The faces are the nodes of
    the dual graph; a breadth-first search from the target gives distances, and every step of a
    shortest path decreases the distance.
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
    # depth-first along decreasing distances; every path found this way is a shortest one
    paths: list[tuple[int, list[int]]] = [(source, [])]
    yielded = 0
    while paths and yielded < _MAX_PATHS:
        here, path = paths.pop()
        if here == target:
            yielded += 1
            yield path
        else:
            paths.extend(
                (face[dart ^ 1], [*path, dart])
                for dart in borders[here]
                if distance[face[dart ^ 1]] < distance[here]
            )


def _gap_faces(onwards: list[int]) -> tuple[list[int], list[list[int]], int, int]:
    """Find the faces of a diagram without its last edge.

    The last edge is cut in the middle, so that a stub is left at either end.

    Returns:
        face: the face on the left of each dart.
        borders: the darts around each face.
        source, target: the faces with the stub where the missing edge starts and where it ends.
    """
    leaving, arriving = len(onwards) - 2, len(onwards) - 1  # darts of the missing edge
    # per dart the next one of its face; and the darts before which the stubs stand
    around, before = list[int](), dict[int, int]()
    for dart in range(leaving):
        after = onwards[dart]
        # Walk around a stub: out on one dart of the missing edge, back on the other, whose sum is
        # leaving + arriving.
        while after >= leaving:
            before[after] = dart
            after = onwards[leaving + arriving - after]
        around.append(after)
    borders, face = cycles(around), [0] * leaving
    for number, border in enumerate(borders):
        for dart in border:
            face[dart] = number
    return face, borders, face[before[leaving]], face[before[arriving]]


def _with_overstrand(rest: GaussCode, path: list[int]) -> GaussCode:
    """Close the gap in the last edge with a strand that crosses over the edges of these darts.

    A crossing over a forward dart is positive: the strand goes from left to right of the edge.
    """
    letters = dict(enumerate(rest.chirality or "", 1))
    under: dict[int, int] = {}  # edge -> the new visit on it; a shortest path meets it only once
    for label, dart in enumerate(path, rest.nx + 1):
        under[dart // 2] = -label
        letters[label] = GaussCode.letters_of([1 - 2 * (dart % 2)])
    # edge k starts at visit k, so the new under-visit follows it; the new strand comes last
    visits: list[int] = []
    for edge, visit in enumerate(rest.visits):
        visits.append(visit)
        if edge in under:
            visits.append(under[edge])
    visits.extend(range(rest.nx + 1, rest.nx + 1 + len(path)))
    return GaussCode.relabelled(visits, letters)
