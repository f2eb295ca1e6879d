"""Crossings of closed polylines: what is found, what is not, and what exact ties do."""

import runpy
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba import njit

from knotgym.common import InvalidInput
from knotgym.states import read_states, shipped
from knotgym.topology import exact_signs
from knotgym.topology.crossings import Crossings, find_crossings, label, label_many
from knotgym.topology.diagrams import is_planar
from knotgym.topology.gauss import GaussCode
from knotgym.topology.reference_labeller import pyknotid_code

from ..fresh_interpreter import modules_after
from ..scripts import ROOT


@njit
def side(points: np.ndarray, a: int, b: int, c: int) -> int:
    """Call `exact_signs.side`, which Python can't."""
    return int(exact_signs.side(points, a, b, c))


def visit_spacing(crossings: Crossings, beads: int) -> float:
    """The smallest distance of consecutive visits, beads; small where strands nearly meet."""
    places = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))
    return float(np.diff(places, append=places[:1] + beads).min(initial=np.inf))


# An eight whose strands meet at (0, 0); the one from the lower left is over.
EIGHT = np.array(
    [
        [-1.0, -1.0, 1.0],
        [1.0, 1.0, 1.0],
        [2.0, 0.0, 0.0],
        [1.0, -1.0, -1.0],
        [-1.0, 1.0, -1.0],
        [-2.0, 0.0, 0.0],
    ]
)
seeds = st.integers(0, 2**32 - 1)


def random_curve(seed: int, beads: int = 100, modes: int = 5) -> np.ndarray:
    """A closed Fourier curve, 1.33 m long."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, beads, endpoint=False)
    points = np.zeros((beads, 3))
    for mode in range(1, modes + 1):
        for wave in (np.cos(mode * angle), np.sin(mode * angle)):
            points += wave[:, None] * rng.normal(size=3) / mode
    points *= 1.33 / np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum()
    return points


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = points.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def grid_curves(largest: int) -> st.SearchStrategy[np.ndarray]:
    """Closed curves on an integer grid, with many exact ties."""
    return st.integers(3, 12).flatmap(
        lambda beads: arrays(np.float64, (beads, 3), elements=st.integers(0, largest).map(float))
    )


def test_an_eight_has_one_crossing_and_a_triangle_none() -> None:
    assert label(EIGHT).chiral == "1+c,1-c"
    assert label(np.eye(3)) == GaussCode() and label_many(np.zeros((0, 100, 3))) == []
    # of equal heights the first strand is over
    assert str(label(EIGHT * [1.0, 1.0, 0.0])) == "1+,1-"


def test_a_crossing_is_described_in_place() -> None:
    crossings = find_crossings(EIGHT)
    assert (crossings.over_place.tolist(), crossings.under_place.tolist()) == ([0.5], [3.5])
    assert crossings.position.tolist() == [[0.0, 0.0]]
    assert crossings.over_z.tolist() + crossings.under_z.tolist() == [1.0, -1.0]
    assert crossings.sign.tolist() == [1]


def require_strands_at_crossings(points: np.ndarray, crossings: Crossings) -> None:
    """Check that both strands pass each crossing's position, at its heights."""
    closed = np.vstack([points, points[:1]])
    for places, heights in (
        (crossings.over_place, crossings.over_z),
        (crossings.under_place, crossings.under_z),
    ):
        assert ((places >= 0) & (places <= len(points))).all()
        at = [np.interp(places, np.arange(len(closed)), column) for column in closed.T]
        np.testing.assert_allclose(at, [*crossings.position.T, heights], atol=1e-9)


@given(seeds)
def test_all_readers_agree_and_described_crossings_spell_the_code(seed: int) -> None:
    ropes = np.array([random_curve(seed), random_curve(seed + 1)])
    crossings = find_crossings(ropes[0])
    assert label_many(ropes) == [*map(label, ropes)]
    assert label(ropes[0]) == crossings.code and is_planar(crossings.code)
    visits = [(place, k + 1) for k, place in enumerate(crossings.over_place)]
    visits += [(place, -k - 1) for k, place in enumerate(crossings.under_place)]
    assert tuple(visit for _, visit in sorted(visits)) == crossings.code.visits
    assert tuple(crossings.sign) == crossings.code.signs
    assert (crossings.over_z > crossings.under_z).all()
    require_strands_at_crossings(ropes[0], crossings)


@given(
    seeds,
    st.floats(-4.0, 4.0),
    st.floats(1e-3, 1e3),
    arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)),
)
def test_codes_survive_moving(seed: int, angle: float, scale: float, shift: np.ndarray) -> None:
    points = random_curve(seed)
    assume(visit_spacing(find_crossings(points), 100) > 1e-6)
    assert label(turned(points, angle)) == label((points + shift) * scale) == label(points)


@pytest.mark.parametrize("offset", [0.0, 1e-300, 1e-17, -1e-17, 1e-9, -1e-9])
def test_a_strand_over_a_bead_counts_once(offset: float) -> None:
    over, under = [offset, 0.0, 1.0], [0.0, 0.0, -1.0]  # beads where the other strand passes
    assert str(label(np.insert(EIGHT, 1, over, axis=0))) == "1+,1-"
    eight = np.insert(EIGHT, [1, 4], [over, under], axis=0)
    for base in range(len(eight)):
        for flip in (1.0, -1.0):
            assert label(np.roll(eight, base, axis=0) * [flip, 1.0, 1.0]).nx == 1


def repeated_in(rope: np.ndarray) -> dict[str, np.ndarray]:
    """A rope in which vertices are written again, as by tools that close or resample curves."""
    twice = np.repeat(rope, 2, axis=0)
    noise = np.random.default_rng(0).uniform(-1, 1, twice.shape)
    return {
        "the first at the end": np.vstack([rope, rope[:1]]),
        "the first at once": np.vstack([rope[:1], rope]),
        "one": np.insert(rope, 5, rope[5], axis=0),
        "every one": twice,
        "every one thrice": np.repeat(rope, 3, axis=0),
        **{f"within {size} m": twice + size * noise for size in (1e-17, 1e-16)},
    }


def test_vertices_that_are_repeated_change_no_code() -> None:
    states = read_states(shipped(), images=False).points[::4]
    for rope in [*states, EIGHT, *map(random_curve, range(30))]:
        code = label(rope)
        for which, again in repeated_in(rope).items():
            shown = (label(again), *label_many(again[None]), label(again, most=code.nx))
            assert shown == (code, code, code), which


def test_places_are_those_of_the_edges_that_have_a_length() -> None:
    for start in range(6):
        rope = np.roll(EIGHT, start, axis=0)
        at = find_crossings(rope)
        for repeats in ([1, 1, 3, 1, 1, 2], [2, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1]):
            again = np.vstack([np.repeat(rope, repeats, axis=0), rope[:1]])
            ends = np.cumsum(repeats) - 1  # the last of each, from where its edge leads on
            found = find_crossings(again)
            for name in ("over_place", "under_place"):
                old = getattr(at, name)
                new = ends[old.astype(int)] + old % 1
                assert getattr(found, name).tolist() == new.tolist()
            assert found.position.tolist() == at.position.tolist()


def test_a_curve_of_one_or_two_spots_has_no_crossings() -> None:
    for spots in (1, 2):
        assert label(np.repeat(EIGHT[:spots], 5, axis=0)) == GaussCode()


def runs_along_itself(points: np.ndarray) -> bool:
    """Whether two edges overlap in more than a point, or one has no length; exact for integers."""
    start = points[:, :2]
    for i, (x, y) in enumerate(np.roll(start, -1, axis=0) - start):
        apart = start - start[i]
        ends = np.stack([apart, np.roll(apart, -1, axis=0)])  # of all edges
        parallel = (ends @ (-y, x) == 0).all(axis=0)
        reach, length = ends @ (x, y), x**2 + y**2
        along = parallel & (reach.max(axis=0) > 0) & (reach.min(axis=0) < length)
        if np.delete(along, i).any() or not length:
            return True
    return False


@settings(max_examples=100, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    st.sampled_from([4, 30, 1000])
    .flatmap(grid_curves)
    .filter(lambda points: not runs_along_itself(points))
)
def test_exact_ties_still_give_planar_codes(points: np.ndarray) -> None:
    crossings = find_crossings(points)
    # otherwise three strands may meet in a point
    assume(visit_spacing(crossings, len(points)) > 1e-9)
    assert is_planar(crossings.code)


@settings(max_examples=300)
@given(st.sampled_from([1, 2, 4]).flatmap(grid_curves))
def test_strands_that_run_along_each_other_cross_within_both_edges(points: np.ndarray) -> None:
    require_strands_at_crossings(points, find_crossings(points))


# a few ulps beside a diagonal, near and far, so that even differences are rounded
near = st.tuples(st.sampled_from([0.1, 0.5, 12.0, 24.0]), *[st.integers(-3, 3)] * 2)


@settings(max_examples=300)
@given(st.lists(near, min_size=3, max_size=3), st.sampled_from([1.0, -1.0, 3.0, 0.7, 1e-12]))
def test_sides_are_exact(corners: list[tuple[float, int, int]], stretch: float) -> None:
    points = np.array([(at + x * 2.0**-53, at + y * 2.0**-53) for at, x, y in corners])
    points *= [1.0, stretch]
    (ax, ay), (bx, by), (cx, cy) = [[Fraction(value) for value in row] for row in points.tolist()]
    exact = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    assert exact == 0 or (side(points, 0, 1, 2) > 0) == (exact > 0)


def test_labels_are_exact_where_strands_meet_within_rounding() -> None:
    """Three strands near one point, in the plane and in height, beside rational numbers."""
    labels = runpy.run_path(str(ROOT / "benchmarks" / "labels.py"))["labels"]
    rng, close = np.random.default_rng(0), 0
    for _ in range(200):
        points = rng.normal(size=(6, 3))
        points[:, 2] *= 1e-9  # nearly as high
        meet = points[0] + rng.random() * (points[1] - points[0])
        for k in (2, 4):  # edges 2 and 4 pass the same place on edge 0
            points[k + 1] = meet + rng.random() * (meet - points[k])
        expected, margin = labels(points)
        if margin:
            close += margin <= 1
            assert label(points).chiral == expected
    assert close > 100


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        *((np.zeros(shape), "shape") for shape in ((2, 3), (4, 2), (1, 4, 3))),
        *((np.where(np.eye(6, 3), value, EIGHT), "finite") for value in (np.nan, np.inf, -np.inf)),
    ],
)
def test_what_is_no_curve_is_refused(points: np.ndarray, problem: str) -> None:
    for reader in (label, find_crossings, pyknotid_code):
        with pytest.raises(InvalidInput, match=problem):
            reader(points)
    if problem == "finite":
        with pytest.raises(InvalidInput, match="rope 1"):
            label_many(np.array([EIGHT, points]))


def test_many_crossings_are_all_found() -> None:
    # every edge crosses all but itself and two neighbours
    star = 2.0 * np.pi * np.arange(101) * 50 / 101
    points = np.column_stack([np.cos(star), np.sin(star), np.cos(7.0 * star)])
    assert label(points).nx == 101 * 98 // 2
    with pytest.raises(InvalidInput, match="more than 4948 crossings"):
        label(points, most=101 * 98 // 2 - 1)
    several = label_many(np.stack([points, np.roll(points, 1, axis=0), points]))
    assert several == [label(points), label(np.roll(points, 1, axis=0)), label(points)]


def test_pyknotid_agrees() -> None:
    """On 40 curves; `benchmarks/labels.py` compares millions of ropes with another labeller."""
    for seed in range(40):
        points = random_curve(seed, modes=1 + seed % 8)
        assert label(points) == pyknotid_code(points), seed


def test_pyknotid_needs_no_library_for_plots() -> None:
    """Its plots import vispy, which needs fontconfig: a bare machine has none."""
    read = "from knotgym.topology.reference_labeller import pyknotid_code"
    modules = modules_after(f"{read}\npyknotid_code([[0, 0, 0], [1, 0, 0], [0, 1, 0]])")
    assert "pyknotid.spacecurves" in modules and "vispy" not in modules


def test_scale_prints_and_patches_of_pyknotid_are_hidden(capfd: pytest.CaptureFixture[str]) -> None:
    for scale in (1e-6, 0.013, 1.0, 1e6):
        assert pyknotid_code(EIGHT * scale).chiral == "1+c,1-c"
    assert not {"float", "int", "complex"} & set(vars(np))
    assert capfd.readouterr() == ("", "")
