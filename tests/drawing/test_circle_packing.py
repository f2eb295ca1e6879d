"""Drawings are the same bytes everywhere if their elementary functions are, and are right."""

import hashlib
import math

import numpy as np
import pytest

from knotgym.drawing.circle_packing import _angle_of, sin_cos
from knotgym.drawing.curves import _exp


def test_elementary_functions_are_right() -> None:
    rng = np.random.default_rng(0)
    for x, y in rng.uniform(-20, 20, (2000, 2)) * 10.0 ** rng.integers(-9, 1, (2000, 1)):
        assert sin_cos(x) == pytest.approx((math.sin(x), math.cos(x)), abs=2e-15)
        assert _angle_of(x, y) == pytest.approx(math.atan2(y, x), rel=1e-14)
        assert _exp(x) == pytest.approx(math.exp(x), rel=1e-14)
    assert (_angle_of(0.0, 0.0), _angle_of(-1.0, 0.0), sin_cos(0.0)) == (0.0, math.pi, (0.0, 1.0))


def test_elementary_functions_round_as_recorded() -> None:
    """A digest of results on x86-64: those of another processor must be equal."""
    x = np.linspace(-7, 7, 500)
    found = [[*sin_cos(one), _angle_of(one, 1.7 - one), _exp(one)] for one in x]
    assert hashlib.sha256(np.array(found).tobytes()).hexdigest()[:12] == "628476257872"
