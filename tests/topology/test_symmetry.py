"""Symmetries act consistently on ropes and on their codes."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from knotgym.rope import Rope, RopeConfig
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.diagrams import chiralities, planar_codes
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry, canonical, images

Array = NDArray[np.float64]
BEADS = RopeConfig().beads
CODES = [
    GaussCode(code.visits, letters)
    for nx in range(4)
    for code in planar_codes(nx)
    for letters in chiralities(code)
]
codes = st.sampled_from(CODES)
symmetries = st.builds(
    Symmetry,
    reflect=st.booleans(),
    switch=st.booleans(),
    turn=st.floats(-np.pi, np.pi),
    reverse=st.booleans(),
    base_shift=st.integers(-BEADS, 2 * BEADS),
)
rows = st.integers(0, 39)


@pytest.fixture(scope="module")
def configurations(rope: Rope, tangled: Array) -> Array:
    """Moving ropes, float64 (40, beads, 3)."""
    return rope.points(tangled)


def variants(code: GaussCode) -> Iterator[tuple[GaussCode, Symmetry]]:
    """Yield the images of a code with the symmetries that show them."""
    for k, shown in enumerate(images(code)):
        yield shown, Symmetry(reflect=bool(k & 1), switch=bool(k & 2), reverse=bool(k & 4))


@given(codes)
def test_a_class_is_the_same_for_every_variant_and_stands_for_itself(code: GaussCode) -> None:
    assert {canonical(shown) for shown, _ in variants(code)} == {canonical(code)}
    assert canonical(canonical(code)) == canonical(code)
    assert all(GaussCode(shown.visits, shown.chirality) == shown for shown in images(code))


def test_classes_part_the_codes() -> None:
    by_class = {one: {shown for shown, _ in variants(one)} for one in map(canonical, CODES)}
    assert sum(map(len, by_class.values())) == len(set(CODES)) == len(set.union(*by_class.values()))


@given(rows, st.floats(-np.pi, np.pi))
def test_variants_show_what_moved_ropes_show(configurations: Array, row: int, turn: float) -> None:
    points = configurations[row]
    for shown, symmetry in variants(label(points)):
        turned = symmetry._replace(turn=turn)
        assert label(turned.vertices(points)) == shown


def test_a_walk_from_any_vertex_reads_the_rolled_code(configurations: Array) -> None:
    for points in configurations[::4]:
        found = find_crossings(points)
        visits = np.concatenate([found.over_place, found.under_place])
        for first in range(BEADS):
            rebased = found.code.rebased(int((visits < first).sum()))
            assert label(Symmetry(base_shift=first).vertices(points)) == rebased, first


@given(rows, symmetries)
def test_a_bead_keeps_its_distances_and_its_place_under_its_new_number(
    configurations: Array, row: int, symmetry: Symmetry
) -> None:
    points = configurations[row]
    moved = symmetry.vertices(points)
    middles = (points + np.roll(points, -1, axis=0)) / 2
    new = symmetry.beads(np.arange(BEADS), BEADS)
    assert np.allclose(
        ((moved + np.roll(moved, -1, axis=0)) / 2)[new], symmetry.vectors(middles), atol=1e-12
    )
    spread = [np.linalg.norm(one - one.mean(axis=0), axis=1) for one in (moved, points)]
    assert np.ptp(np.sort(spread), axis=0).max() < 1e-12
    assert np.array_equal(Symmetry().vertices(points), points)


@pytest.mark.parametrize(("nx", "diagrams"), [(0, 1), (1, 1), (2, 2), (3, 7)])
def test_diagrams_differ_and_their_form_is_one_of_their_codes(nx: int, diagrams: int) -> None:
    forms = {code: canonical(code, Symmetry.DIAGRAM) for code in planar_codes(nx)}
    assert len(set(forms.values())) == diagrams
    assert all(forms[form] == form for form in forms.values())
    for code, form in forms.items():
        based = [code.rebased(k) for k in range(max(1, 2 * nx))]
        either = [*based, *(one.reversed() for one in based)]
        assert form in {*either, *(one.switched() for one in either)}
