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
from knotgym.photos import photograph
from knotgym.photos.rope_reader import _crossings_of, _line_in
from knotgym.photos.strand_network import CELL, Fields
from knotgym.states import States, read_states, shipped
from knotgym.topology import GaussCode, Symmetry, find_crossings, images, label

from ..scripts import ROOT

pytestmark = pytest.mark.clients
Array = NDArray[np.float64]
SIDE = 256
lifted_lines: Any = runpy.run_path(str(ROOT / "examples/perception/strand_loss.py"))["lifted_lines"]


@pytest.fixture(scope="module")
def states() -> States:
    return read_states(shipped("bench"), images=False)


def same_diagram(one: GaussCode, other: GaussCode) -> bool:
    """Return whether both are codes of one diagram, from any base points, in any directions."""
    return other in images(one, Symmetry.REVERSE | Symmetry.REBASE)


def projected(points: Array) -> tuple[Array, Tensor]:
    """Return a rope (beads, 3) in pixels of a picture that it fills, and its line (1, 512, 2)."""
    low, high = points.min(axis=0), points.max(axis=0)
    scale = 220 / (high - low)[:2].max()
    pixels = (points - 0.5 * (low + high)) * (scale, -scale, 1) + (SIDE / 2, SIDE / 2, 0)
    fine = np.linspace(0, len(pixels), 512, endpoint=False)
    closed = np.concatenate([pixels, pixels[:1]])
    line = np.stack([np.interp(fine, np.arange(len(closed)), closed[:, k]) for k in (0, 1)], axis=1)
    return pixels, torch.from_numpy(line[None]).float()


def drawn(points: Array) -> Fields:
    """Return what a perfect network would find in a picture of a rope, float64 (beads, 3)."""
    pixels, line = projected(points)
    lines = lifted_lines(line, SIDE // CELL)[0].numpy()
    found = find_crossings(pixels * (1, -1, 1))
    y, x = np.mgrid[: SIDE // CELL, : SIDE // CELL]
    upper, nearest = np.zeros((2, *x.shape), np.float32), np.full(x.shape, 16.0)
    for place, at in zip(found.over_place.astype(int), found.position, strict=True):
        step = pixels[(place + 1) % len(pixels)] - pixels[place]
        twice = 2 * np.arctan2(step[1], step[0])
        away = (x - at[0] / CELL + 0.5) ** 2 + (y + at[1] / CELL + 0.5) ** 2
        upper[:, away < nearest] = np.array([np.cos(twice), np.sin(twice)])[:, None]
        nearest = np.minimum(nearest, away)
    return Fields(lines, upper, np.zeros_like(lines[0]), upper)


@pytest.mark.parametrize("nx", [0, 2, 4, 5])
def test_drawn_lines_are_walked_through_their_crossings(states: States, nx: int) -> None:
    right = 0
    for row in states.rows(nx, "train")[:8]:
        found = _line_in(drawn(states.points[row]))
        code = found and _crossings_of(found[0]).code
        right += code is not None and same_diagram(code, label(states.points[row]))
    assert right >= 7  # of 8: strands that nearly touch may be exchanged


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((8, 9, 3), np.uint8),
        np.zeros((8, 8), np.uint8),
        np.zeros((8, 8, 4), np.uint8),
        np.zeros((8, 8, 3), np.float32),
        np.zeros((0, 0, 3), np.uint8),
        np.uint8(3),
    ],
    ids=["not square", "grey", "with alpha", "float", "empty", "a number"],
)
def test_a_picture_of_another_kind_is_refused(picture: Any) -> None:
    with pytest.raises(InvalidInput, match=r"uint8 of shape \(side, side, 3\), RGB, got"):
        load_rope_reader().read(picture)


def test_an_empty_picture_has_no_rope_and_there_are_8_views() -> None:
    empty = np.full((64, 64, 3), 90, np.uint8)
    assert load_rope_reader().read(empty, views=1) is None
    with pytest.raises(InvalidInput, match="views must be from 1 to 8, got 9"):
        load_rope_reader().read(empty, views=9)


def test_a_learner_of_another_kind_is_refused() -> None:
    with pytest.raises(InvalidFile, match="isn't of learner rope-reader but of 'pictures'"):
        load_rope_reader("pretrained")


def test_photos_are_read_of_any_size(states: States) -> None:
    reader, rng = load_rope_reader(), np.random.default_rng(0)
    rows = [row for nx in (1, 2, 3, 4) for row in states.rows(nx, "test")[:12]]
    shots = [shot for row in rows if (shot := photograph(states.points[row], SIDE, rng))][:16]
    for side in (SIDE, 1024):
        right, ends = 0, list[float]()
        for shot in shots:
            larger = cv2.resize(shot.image, (side, side), interpolation=cv2.INTER_CUBIC)
            reading = reader.read(larger, views=8 if side == SIDE else 1)  # all, averaged
            right += reading is not None and same_diagram(reading.code, shot.crossings.code)
            ends += [] if reading is None else [float(np.ptp(reading.line[:, 0])) / side]
        assert right >= 13, side
        assert 0.2 < np.mean(ends) < 1  # in pixels of the picture that was given
