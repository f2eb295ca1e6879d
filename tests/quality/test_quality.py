"""Quality measures agree with lengths and angles of constructed curves; limits name failures."""

import math
from dataclasses import astuple, fields, replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from knotgym.quality import measures
from knotgym.quality.limits import Limits, Quality
from knotgym.quality.measures import base_spacing, noise_survival
from knotgym.rendering import PictureConfig, project
from knotgym.rope import Rope
from knotgym.states import read_states, shipped
from knotgym.topology import Symmetry, find_crossings, strand_spacing, visited

from ..conftest import curled

PIXEL = PictureConfig().view / PictureConfig().size  # metres
RADIUS = PictureConfig().rope_radius / PIXEL  # pixels
PERFECT = Quality(90.0, 128.0, 128.0, 128.0, 900.0, 900.0, 40.0, 20.0, 0.0, 1.0, 0.0)
LIMITS = (Limits(), Limits.UNTWISTED, Limits.UNAMBIGUOUS)


def measure(points: ArrayLike, **settings: Any) -> Quality:
    """Measure in the usual picture of a rope of 100 beads, whatever the number of vertices."""
    return measures.measure(points, config=PictureConfig(), **settings)


def drawn(corners: ArrayLike, vertices: int = 800) -> NDArray[np.float64]:
    """Return a closed polygon from corners in pixels: float64 (vertices, 3), metres."""
    c = np.array(corners, dtype=np.float64)
    closed = np.concatenate([c, c[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0, along[-1], vertices, endpoint=False)
    return PIXEL * np.stack([np.interp(at, along, closed[:, k]) for k in range(3)], axis=1)


def bow_tie(width: float = 30, height: float = 30, above: float = 4) -> NDArray[np.float64]:
    """Return one crossing of straight strands, `above` pixels apart in height, in the middle."""
    w, h = width, height
    return drawn([(-w, -h, 0), (w, h, 0), (w, -h, above), (-w, h, above)])


def zigzag() -> NDArray[np.float64]:
    """Return two crossings, 40 pixels apart."""
    return drawn([(-40, 10, 3), (0, -10, 3), (40, 10, 3), (40, -10, 0), (0, 10, 0), (-40, -10, 0)])


def circle(radius: float, vertices: int = 400) -> NDArray[np.float64]:
    turn = np.linspace(0, 2 * np.pi, vertices, endpoint=False)
    return PIXEL * radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)


def lowered() -> NDArray[np.float64]:
    """Return the zigzag with its right half at half its height."""
    points = zigzag()
    return points * np.where(points[:, :1] > 0, (1, 1, 0.5), 1)


SHIPPED = read_states(shipped(), images=False)
RECTANGLE = drawn([(-30, -20, 0), (30, -20, 0), (30, 20, 0), (-30, 20, 0)])
EYE = drawn([(-40, 30, 0), (1, -1, 0), (-1, -1, 3), (40, 30, 3)])  # the rope fills it
LANE = drawn([(-40, 2.5, 0), (40, 2.5, 0), (40, -2.5, 0), (-40, -2.5, 0)])


@pytest.mark.parametrize(
    ("name", "points", "right", "off"),
    [
        ("crossing_angle", bow_tie(40, 5), 2 * math.degrees(math.atan(1 / 8)), 0.01),
        ("crossing_angle", zigzag(), 2 * math.degrees(math.atan(1 / 2)), 0.01),
        ("crossing_angle", circle(40), 90, 0),
        ("crossing_spacing", zigzag(), 40, 0.01),
        ("crossing_spacing", bow_tie(), 128, 0),
        ("base_spacing", circle(40), 128, 0),
        ("strand_spacing", LANE, 5, 0.01),
        ("clearance", bow_tie(above=2), 2000 * PIXEL, 1e-6),
        ("clearance", lowered(), 1500 * PIXEL, 1e-6),
        ("clearance", circle(40), 20, 0),
        ("margin", circle(50) + [0.3, -2.0, 0.1], 64 - 50 - RADIUS, 0.01),
        ("margin", circle(70), 64 - 70 - RADIUS, 0.01),
        ("total_curvature", circle(40), 1, 1e-6),
        ("total_curvature", RECTANGLE, 1, 1e-6),
        ("total_curvature", bow_tie(above=1e-3), 1.5, 1e-3),
        ("excess_crossing_number", circle(40), 0, 1e-9),
        ("excess_crossing_number", bow_tie(above=0.01), 0, 0.01),
        ("writhe", bow_tie(above=4), -1, 0),
        ("writhe", bow_tie(above=-4), 1, 0),
        ("writhe", zigzag(), 0, 0),
        ("smallest_region", EYE, 0, 0),
        ("smallest_face", circle(40), math.pi * 40**2, 1),
        # the triangle at either end, 20 wide and 20 high; off by a quarter of its perimeter
        ("smallest_face", zigzag(), 200, 5 + math.hypot(20, 10) / 2),
    ],
)
def test_a_measure_is_that_of_the_curve_that_was_drawn(
    name: str, points: NDArray[np.float64], right: float, off: float
) -> None:
    assert getattr(measure(points), name) == pytest.approx(right, abs=off)


def test_base_spacing_is_walked_from_either_end_of_the_base_bead() -> None:
    points = bow_tie()
    bead, side = np.linalg.norm(points[1] - points[0]) / PIXEL, 30 * math.sqrt(2)
    on = int(find_crossings(points).over_place[0])  # a crossing on the base bead
    for moved, walked, off in ((0, side - bead, 0.01), (150, 150 * bead - side, 0.2), (on, 0, 0)):
        found = measure(np.roll(points, -moved, axis=0)).base_spacing
        assert found == pytest.approx(walked, abs=off)


def test_base_spacing_from_another_vertex_is_that_of_the_renumbered_rope() -> None:
    points = zigzag()
    for roll in (0, 3, 100, 333, 799):
        renumbered = np.roll(points, -roll, axis=0)
        assert base_spacing(points, find_crossings(points), [roll])[0] == pytest.approx(
            measure(renumbered).base_spacing, abs=1e-9
        )


def spacing_by_graph(points: NDArray[np.float64], walk: float) -> float:
    """Return the strand spacing by shortest paths over vertices and crossings of the picture."""
    found, beads = find_crossings(points), len(points)
    places = np.concatenate([np.arange(beads), found.over_place, found.under_place])
    # a crossing's two visits are one node of the graph
    nodes = np.concatenate([np.arange(beads), *[beads + np.arange(found.nx)] * 2])
    order = np.argsort(places, kind="stable")
    pixels = points[:, :2] / PIXEL
    spots = np.stack(
        [np.interp(places, np.arange(beads + 1), [*pixels[:, k], pixels[0, k]]) for k in range(2)],
        axis=1,
    )[order]
    lengths = np.linalg.norm(np.roll(spots, -1, axis=0) - spots, axis=1)
    here = nodes[order]
    paths = np.full([beads + found.nx] * 2, np.inf)
    for one, other, length in zip(here, np.roll(here, -1), lengths, strict=True):
        paths[one, other] = paths[other, one] = min(paths[one, other], length)
    for stop in range(len(paths)):
        paths = np.minimum(paths, paths[:, stop, None] + paths[stop])
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    return float(apart[(paths[:beads, :beads] > walk) & ~np.eye(beads, dtype=bool)].min())


def test_states_that_ship_are_legible_and_have_the_measures_stored_with_them() -> None:
    for row, nx in enumerate(SHIPPED.nx.tolist()):
        kept = Quality(**{name: float(values[row]) for name, values in SHIPPED.quality.items()})
        assert Limits().faults(kept, nx) == []
        if row % 20 == 0:
            found = replace(measure(SHIPPED.points[row]), noise_survival=kept.noise_survival)
            assert astuple(found) == pytest.approx(astuple(kept), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("row", range(57, 177, 20))
@pytest.mark.parametrize("walk", [measures.WALK, 40.0])
def test_strands_differ_where_every_path_over_the_picture_is_long(row: int, walk: float) -> None:
    points = np.roll(SHIPPED.points[row], 30, axis=0)  # short paths lead over the base too
    pixels = points[:, :2] / PIXEL
    along, _, at = visited(pixels, find_crossings(points).table)
    found = strand_spacing(pixels, along, at, walk, 500.0)
    assert found == pytest.approx(spacing_by_graph(points, walk), rel=1e-9)
    assert strand_spacing(pixels, along, at, walk, 0.5 * found) == 0.5 * found


def test_the_excess_crossing_number_compares_with_the_average_over_all_views() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6, 3)) * 0.1
    views = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(4000)]
    seen = [find_crossings(points @ view).nx for view in views]
    right = np.mean(seen) - find_crossings(points).nx
    assert measure(points).excess_crossing_number == pytest.approx(right, abs=0.08)
    points[4] = points[1]  # a rope that touches itself is measured too
    assert np.isfinite(measure(points).excess_crossing_number)


def test_excess_crossing_number_is_left_out_when_quick() -> None:
    quality = measure(zigzag(), quick=True)
    assert math.isnan(quality.excess_crossing_number)
    whole = measure(zigzag())
    assert replace(
        quality, excess_crossing_number=whole.excess_crossing_number, noise_survival=0.0
    ) == replace(whole, noise_survival=0.0)


def by_opencv(points: NDArray[np.float64], config: PictureConfig) -> float:
    """Return the smallest of nx + 2 regions beside the rope as OpenCV draws and counts them."""
    pixels, fine = project(points, config), 3
    low = np.floor(pixels.min(axis=0)) - 4
    high = np.ceil(pixels.max(axis=0)) + 4 - low
    canvas = np.ones((int(high[1] * fine), int(high[0] * fine)), dtype=np.uint8)
    corners = np.round((pixels - low) * fine * 16).astype(np.int32)
    thick = round(2 * config.rope_radius * config.pixels_per_metre * fine)
    cv2.polylines(canvas, [corners[:, None]], True, 0, max(2, thick), cv2.LINE_8, 4)
    stats = cv2.connectedComponentsWithStats(canvas, connectivity=8)[2]
    areas = stats[1:, cv2.CC_STAT_AREA]
    return areas.min() / fine**2 if len(areas) == find_crossings(points).nx + 2 else 0.0


@pytest.mark.parametrize("view", [0.66, 1.32, 2.0])  # bands of 6, 3 and 2 dots
def test_regions_are_those_that_opencv_draws_and_counts(view: float) -> None:
    config = PictureConfig(view=view)
    # the last row of one of this pentagon's sides is no dot of OpenCV's
    pentagon = np.random.default_rng(13192).uniform(-0.05, 0.05, (5, 3))
    for points in [*SHIPPED.points[::9], pentagon]:
        assert measures.measure(points, config=config).smallest_region == by_opencv(points, config)


def test_ropes_measured_together_are_measured_as_alone() -> None:
    points = SHIPPED.points[[0, 60, 120, 170]]
    together = measures.measure_all(points, [find_crossings(one) for one in points])
    for one, found in zip(points, together, strict=True):
        assert astuple(found) == pytest.approx(astuple(measure(one)), rel=0, abs=0, nan_ok=True)


@pytest.mark.parametrize("nx", range(5))
def test_a_turn_about_z_changes_no_length_and_no_angle(rope: Rope, nx: int) -> None:
    points = rope.from_curve(curled(nx, 0.4))
    one, other = vars(measure(points)), vars(measure(Symmetry(turn=0.7).vertices(points)))
    for name in one.keys() - {"margin", "smallest_region", "smallest_face", "noise_survival"}:
        assert one[name] == pytest.approx(other[name], rel=1e-6, abs=1e-6), name


def test_a_crossing_at_the_end_of_the_walk_does_not_survive_reset_noise(rope: Rope) -> None:
    assert noise_survival(rope.loop(), 0.015, np.random.default_rng(0)) == 1.0
    points = rope.from_curve(curled(2, 0.3))
    place = find_crossings(points).over_place
    nearest = place[np.argmin(np.abs(place - np.round(place)))]
    survives = [
        noise_survival(np.roll(points, -by, axis=0), 0.05, np.random.default_rng(0))
        for by in (int(np.round(nearest)), 0)
    ]
    assert survives[0] < 0.9 < survives[1]


MAXIMA = ("excess_crossing_number", "total_curvature", "curvature_per_crossing")
BOUNDS = [
    (limits, field.name)
    for limits in LIMITS
    for field in fields(Limits)
    if getattr(limits, field.name) is not None
]


@pytest.mark.parametrize(("limits", "name"), BOUNDS)
def test_a_measure_beyond_its_limit_is_named_one_at_it_is_not(limits: Limits, name: str) -> None:
    bound = getattr(limits, name)
    measured = "total_curvature" if name == "curvature_per_crossing" else name
    if name == "curvature_per_crossing":
        bound *= 4  # three crossings and the loop
    worse = bound + (1e-3 if name in MAXIMA else -1e-3)
    assert limits.faults(replace(PERFECT, **{measured: bound}), 3) == []
    assert limits.faults(replace(PERFECT, **{measured: worse}), 3) == [name]


def test_what_was_not_measured_is_no_fault() -> None:
    unmeasured = replace(PERFECT, noise_survival=math.nan, excess_crossing_number=math.nan)
    assert Limits().faults(unmeasured, 3) == []
