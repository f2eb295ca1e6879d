"""Tests of the reader without hue: lines that are drawn are walked, turned pictures agree."""

import runpy
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.common import InvalidFile, InvalidInput
from knotgym.learn import load_rope_reader
from knotgym.photos import PhotoReading, photograph
from knotgym.photos.line_mending import Line, mended
from knotgym.photos.rope_reader import _reading
from knotgym.photos.strand_network import CELL, Fields
from knotgym.states import States, read_states, shipped
from knotgym.topology import GaussCode, RopesCode, find_ropes_crossings, label

from ..scripts import ROOT

pytestmark = pytest.mark.clients
Array = NDArray[np.float64]
SIDE = 256
lifted_lines: Any = runpy.run_path(str(ROOT / "examples/perception/strand_loss.py"))["lifted_lines"]


@pytest.fixture(scope="module")
def states() -> States:
    return read_states(shipped("bench"), images=False)


def same_diagram(reading: PhotoReading, code: GaussCode) -> bool:
    """Return whether a reading is of one closed rope, with this code from some base point."""
    return reading.code is not None and reading.code.smallest() == RopesCode.of(code).smallest()


def projected(points: Array, closed: bool) -> tuple[Array, Tensor]:
    """Return a rope (beads, 3) in pixels of a picture that it fills, and its line (1, m, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    scale = 220 / (high - low)[:2].max()
    pixels = (points - 0.5 * (low + high)) * (scale, -scale, 1) + (SIDE / 2, SIDE / 2, 0)
    path = np.concatenate([pixels, pixels[:1]]) if closed else pixels
    fine = np.linspace(0, len(path) - 1, 512, endpoint=not closed)
    line = np.stack([np.interp(fine, np.arange(len(path)), path[:, k]) for k in (0, 1)], axis=1)
    joined = np.arange(len(line)) < len(line) - (not closed)
    return pixels, torch.from_numpy(np.column_stack([line, joined])[None]).float()


def drawn(points: Array, closed: bool = True) -> Fields:
    """Return what a perfect network would find in a picture of a rope, float64 (beads, 3)."""
    pixels, line = projected(points, closed)
    lines = lifted_lines(line, SIDE // CELL)[0].numpy()
    found = find_ropes_crossings([pixels * (1, -1, 1)], closed)
    y, x = np.mgrid[: SIDE // CELL, : SIDE // CELL]
    upper, nearest = np.zeros((2, *x.shape), np.float32), np.full(x.shape, 16.0)
    for place, at in zip(found.over_place.astype(int), found.position, strict=True):
        step = pixels[(place + 1) % len(pixels)] - pixels[place]
        twice = 2 * np.arctan2(step[1], step[0])
        away = (x - at[0] / CELL + 0.5) ** 2 + (y + at[1] / CELL + 0.5) ** 2
        upper[:, away < nearest] = np.array([np.cos(twice), np.sin(twice)])[:, None]
        nearest = np.minimum(nearest, away)
    return Fields(lines, upper)


def read(fields: Fields) -> PhotoReading:
    return _reading(fields, (SIDE, SIDE), np.zeros(2), 1.0)[0]


@pytest.mark.parametrize("nx", [0, 2, 4, 5])
def test_drawn_lines_are_walked_through_their_crossings(states: States, nx: int) -> None:
    right, opened = 0, 0
    for row in states.rows(nx, "train")[:8]:
        points = states.points[row]
        cut = read(drawn(points[:85], closed=False))
        right += same_diagram(read(drawn(points)), label(points))
        code = label(points[:85], closed=False)
        assert not cut.closed and "end" in cut.reason
        opened += cut.code is not None and cut.code.smallest() == code.smallest()
    assert right >= 7 and opened >= 5  # of 8: strands that nearly touch may be exchanged


@pytest.mark.parametrize("degrees", [9, 14, 20])
def test_strands_that_cross_at_a_flat_angle_are_told_apart(degrees: int) -> None:
    # a bow, whose arms cross below it; the first arm is on top
    slope, way = np.tan(np.radians(degrees / 2)), np.linspace(-1.0, 1.0, 60)
    bend = np.linspace(0.0, np.pi, 30)[1:-1]
    bow = np.column_stack([1 + slope * np.sin(bend), -slope * np.cos(bend), 0 * bend])
    arms = [np.column_stack([side * way, slope * way, side + 0 * way]) for side in (1, -1)]
    points = np.concatenate([arms[0], bow[::-1], arms[1]])
    found = read(drawn(points, closed=False))
    assert found.code is not None and str(found.code.plain.smallest()) in ("1-,1+", "1+,1-")


def test_a_strand_under_a_wide_rope_is_joined_and_one_that_ends_there_is_not() -> None:
    way, dark = np.arange(20.0, 108.0), np.zeros((SIDE // CELL, SIDE // CELL), np.float32)
    frame = np.array([0.0, 0.0, 127.0, 127.0])
    wide = Line(np.column_stack([way, 0.5 * way + 32]), False)
    before = Line(np.column_stack([way[:35], np.full(35, 64.0)]), False)
    behind = Line(np.column_stack([way[53:], np.full(35, 64.0)]), False)
    aside = Line(behind.points + (0.0, 20.0), False)
    assert len(mended([wide, before, behind], dark, frame)) == 2
    assert len(mended([wide, before, aside], dark, frame)) == 3


@pytest.mark.parametrize(
    "picture", [np.zeros((8, 8, 4), np.uint8), np.zeros((8, 8, 3)), np.zeros((0, 9, 3), np.uint8)]
)
def test_a_picture_of_another_kind_is_refused(picture: Any) -> None:
    with pytest.raises(InvalidInput, match=r"uint8 of shape \(height, width, 3\), RGB, or"):
        load_rope_reader().read(picture)


def test_an_empty_picture_has_no_rope_and_there_are_8_views() -> None:
    empty = np.full((40, 64), 90, np.uint8)
    found = load_rope_reader().read(empty, views=1)
    assert found.row == {"ropes": [], "crossings": 0, "closed": False, "reason": "no rope"}
    with pytest.raises(InvalidInput, match="views must be from 1 to 8, got 9"):
        load_rope_reader().read(empty, views=9)


def test_a_learner_of_another_kind_is_refused() -> None:
    with pytest.raises(InvalidFile, match="isn't of learner rope-reader but of 'pictures'"):
        load_rope_reader("pretrained")


def test_photos_are_read_of_any_size_and_shape_whole_and_cut(states: States) -> None:
    reader, rng = load_rope_reader(), np.random.default_rng(0)
    rows = [row for nx in (1, 2, 3, 4) for row in states.rows(nx, "test")[:12]]
    shots = [shot for row in rows if (shot := photograph(states.points[row], SIDE, rng))][:12]
    right, wide, cut = 0, 0, 0
    for shot in shots:
        found = reader.read(shot.image)
        right += same_diagram(found, shot.crossings.code)
        larger = cv2.copyMakeBorder(
            cv2.resize(shot.image, (700, 700)), 0, 0, 90, 200, cv2.BORDER_REPLICATE
        )
        reading = reader.read(larger, views=2)
        wide += same_diagram(reading, shot.crossings.code)
        if reading.ropes:  # in pixels of the picture that was given
            assert 90 <= np.mean(reading.ropes[0].line[:, 0]) <= 790
        cut += reader.read(shot.image[:, : SIDE // 2], views=2).closed
    assert right >= 10 and wide >= 8 and cut <= 1
