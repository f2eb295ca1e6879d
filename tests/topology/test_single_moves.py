"""Single Reidemeister moves: all of them, and none that changes the knot."""

from collections import Counter
from itertools import islice

from knotgym.topology.diagrams import chiralities, faces, is_planar, planar_codes
from knotgym.topology.gauss import GaussCode
from knotgym.topology.polynomials import jones_polynomial
from knotgym.topology.reidemeister import _removals


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
        visits, expected = code.visits, dict[frozenset[int], GaussCode]()
        for face in faces(code):
            edges = [dart // 2 for dart in face]
            ends = [(visits[edge], visits[(edge + 1) % len(visits)]) for edge in edges]
            heights = sorted((a > 0) + (b > 0) for a, b in ends)
            labels = frozenset(abs(visit) for pair in ends for visit in pair)
            if len(face) == 1 or len(face) == len(labels) == 2 and heights == [0, 2]:
                expected[labels] = without(code, *labels)
        found = Counter(_removals(code))
        assert found == Counter(expected.values()), code.chiral


def test_moves_keep_the_knot_and_the_plane() -> None:
    for code in DIAGRAMS[::7]:
        jones = jones_polynomial(code)
        for after in _removals(code):
            assert is_planar(after) and jones_polynomial(after) == jones, (code, after)
