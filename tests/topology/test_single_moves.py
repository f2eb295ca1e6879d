"""Single Reidemeister moves: all of them, and none that changes the knot."""

from collections import Counter
from itertools import islice

from knotgym.topology.diagrams import chiralities, faces, is_planar, planar_codes
from knotgym.topology.gauss import GaussCode
from knotgym.topology.polynomials import jones_polynomial
from knotgym.topology.single_moves import Removal, removals, sideways


def diagrams(nx: int, every: int) -> list[GaussCode]:
    """Every `every`-th planar code, with each of its chiralities."""
    return [
        GaussCode(code.visits, letters)
        for code in islice(planar_codes(nx), 0, None, every)
        for letters in chiralities(code)
    ]


DIAGRAMS = [code for nx, every in ((1, 1), (2, 1), (3, 5), (4, 41)) for code in diagrams(nx, every)]


def without(code: GaussCode, *labels: int) -> GaussCode:
    letters = dict(enumerate(code.chirality or "", 1))
    return GaussCode.relabelled([v for v in code.visits if abs(v) not in labels], letters)


def test_kinks_and_bigons_are_the_faces_with_one_and_two_sides() -> None:
    for code in DIAGRAMS:
        visits, expected = code.visits, dict[frozenset[int], tuple[bool, GaussCode]]()
        for face in faces(code):
            edges = [dart // 2 for dart in face]
            ends = [(visits[edge], visits[(edge + 1) % len(visits)]) for edge in edges]
            heights = sorted((a > 0) + (b > 0) for a, b in ends)
            labels = frozenset(abs(visit) for pair in ends for visit in pair)
            if len(face) == 1 or len(face) == len(labels) == 2 and heights == [0, 2]:
                expected[labels] = len(face) == 1, without(code, *labels)
        found = Counter((move.kink, move.code) for move in removals(code))
        assert found == Counter(expected.values()), code.chiral


def put_back(move: Removal) -> set[GaussCode]:
    """All codes, without chirality, that have the removed crossings on the arcs of the move."""
    new = move.code.nx + 1
    upper = [new] if move.kink else [new, new + 1]
    codes = set()
    for lower in ([-visit for visit in upper], [-visit for visit in upper[::-1]]):
        if move.over == move.under:
            pieces = [{move.over: upper + lower}, {move.over: lower + upper}]
        else:
            pieces = [{move.over: upper, move.under: lower}]
        for piece in pieces:
            visits: list[int] = []
            for arc in range(2 * move.code.nx + 1):
                visits += [*piece.get(arc, []), *move.code.visits[arc : arc + 1]]
            codes.add(GaussCode.relabelled(visits))
    return codes


def test_what_was_taken_out_lay_on_its_arcs() -> None:
    for code in DIAGRAMS:
        for move in removals(code):
            # where the base point lay inside a kink or bigon it is just outside now
            assert put_back(move) & {code.rebased(k).plain for k in (0, 1, -1)}, (code.chiral, move)


def test_moves_keep_the_knot_and_the_plane() -> None:
    for code in DIAGRAMS[::7]:
        jones = jones_polynomial(code)
        for after in [*(move.code for move in removals(code)), *sideways(code)]:
            assert is_planar(after) and jones_polynomial(after) == jones, (code, after)


def test_moves_sideways_are_taken_back_by_their_like() -> None:
    thirds = 0
    for code in DIAGRAMS:
        after = list(sideways(code))
        thirds += len(after) - 2
        for other in after:
            assert code in set(sideways(other)), (code.chiral, other.chiral)
    assert thirds > 20
