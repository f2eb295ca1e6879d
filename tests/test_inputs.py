"""What a function is given it leaves as it was, and what it returns is its own."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.quality import measure
from knotgym.rendering import draw, draw_diagram
from knotgym.rope import MacroAction, Rope
from knotgym.topology import Symmetry, find_crossings, label, pyknotid_code

from .conftest import curled

Points = NDArray[np.float64]
ALL = Symmetry(reflect=True, switch=True, turn=1.0, reverse=True, base_shift=3)
FUNCTIONS: dict[str, Callable[[Points], Any]] = {
    "code": label,
    "crossings": find_crossings,
    "reference": pyknotid_code,
    "measures": measure,
    "picture": draw,
    "diagram": draw_diagram,
    "curve": Rope().from_curve,
    "qpos": Rope().qpos,
    "symmetry": ALL.vertices,
    "noise": lambda points: Rope.noised(points[None], 0.1, [np.random.default_rng(0)]),
    "proposal": lambda points: MacroAction.drawn(points, np.random.default_rng(0)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_points_are_left_alone(name: str) -> None:
    points = Rope().from_curve(curled(2))
    kept = points.copy()
    made = FUNCTIONS[name](points)
    assert np.array_equal(points, kept)
    assert not (isinstance(made, np.ndarray) and np.shares_memory(made, points))
