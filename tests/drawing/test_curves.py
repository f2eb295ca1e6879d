"""Ropes drawn from codes show these codes."""

import hashlib

import numpy as np
import pytest

from knotgym.common import Failed
from knotgym.drawing.circle_packing import pack_circles, planar_map
from knotgym.drawing.curves import _flat, _lifted, drawn_curve
from knotgym.drawing.drawing_config import DrawingConfig
from knotgym.topology import GaussCode, faces, label, with_chirality

TREFOIL = GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c")
KINKS = GaussCode.parse("1-a,2-c,2+c,1+a,3+a,3-a")


def first_drawn(code: GaussCode, seed: int) -> np.ndarray:
    """Draw a code until the rope can take the shape."""
    rng = np.random.default_rng(seed)
    for _ in range(20):
        try:
            return drawn_curve(code, rng)
        except Failed:
            continue
    raise AssertionError(f"20 drawings of {code.chiral} are too tight")


@pytest.mark.parametrize("code", [GaussCode(), GaussCode.parse("1+c,1-c"), KINKS, TREFOIL])
def test_a_drawing_shows_its_code_with_its_chirality_or_with_one(code: GaussCode) -> None:
    assert label(first_drawn(code, 0)) == code
    assert label(first_drawn(code.plain, 0)).plain == code.plain


def test_the_same_generator_draws_the_same_rope_and_another_does_not() -> None:
    one, again, other = (first_drawn(KINKS, seed) for seed in (1, 1, 2))
    assert np.array_equal(one, again) and not np.allclose(one, other, atol=0.01)


def test_a_drawing_is_the_one_recorded_on_any_machine() -> None:
    drawn = drawn_curve(TREFOIL, np.random.default_rng(2))
    assert hashlib.sha256(drawn.tobytes()).hexdigest()[:12] == "4267ef71671e"


@pytest.mark.parametrize("code", [KINKS, TREFOIL])
def test_the_base_lies_on_the_edge_between_its_neighbours(code: GaussCode) -> None:
    rng, config = np.random.default_rng(0), DrawingConfig()
    curve = _lifted(*_flat(code, rng, config), code, rng, 1.0, config)
    before, after = np.linalg.norm(curve[[-1, 1]] - curve[0], axis=1)
    assert before + after == pytest.approx(np.linalg.norm(curve[-1] - curve[1]))


@pytest.mark.parametrize("outer", range(5))
def test_packed_circles_draw_the_triangulation_without_folds(outer: int) -> None:
    code = with_chirality(KINKS)
    of = planar_map(code, outer)
    assert len(faces(code)) == 5
    a, b, c = pack_circles(of.triangles, of.rim, of.nodes)[of.triangles].transpose(1, 2, 0)
    turn = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
    assert turn.min() > 0


def test_loops_are_drawn_in_both_directions() -> None:
    loops = [drawn_curve(GaussCode.parse(""), np.random.default_rng(k)) for k in range(8)]
    areas = [np.linalg.det(np.stack([p[0, :2], p[1, :2]])) for p in loops]  # round the origin
    assert min(areas) < 0 < max(areas)
