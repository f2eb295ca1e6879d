"""The forces of the relaxation are minus the gradients of the energies that its text gives."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.drawing.layout_relaxation import _square, _stiffen

Array = NDArray[np.float64]
# a figure of eight: node 0 is the crossing, the walk passes it twice
WALK = np.array([0, 1, 2, 3, 0, 4, 5, 6])
AT = np.array(
    [[0.0, 0.0], [0.1, 0.03], [0.17, 0.12], [0.05, 0.1]]  # counterclockwise
    + [[-0.05, -0.11], [-0.16, -0.1], [-0.1, -0.02]]  # clockwise
)
VISITS = np.array([[0, 4]])


def segments(at: Array) -> Array:
    found: Array = at[np.roll(WALK, -1)] - at[WALK]
    return found


def lengths(at: Array) -> Array:
    found: Array = np.linalg.norm(segments(at), axis=1)
    return found


def bending(at: Array) -> float:
    t = segments(at) / lengths(at)[:, None]
    cosine = (t * np.roll(t, 1, axis=0)).sum(axis=1)
    return float((4 * 0.0007 * (1 - cosine) / (lengths(at) + np.roll(lengths(at), 1))).sum())


def square(at: Array) -> float:
    one, other = at[WALK[1]] - at[WALK[7]], at[WALK[5]] - at[WALK[3]]
    cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
    return float(2.0 * cosine**2)


def gradient(energy: Callable[[Array], float], at: Array) -> Array:
    found = np.zeros_like(at)
    for index in np.ndindex(*at.shape):
        step = np.zeros_like(at)
        step[index] = 1e-6
        found[index] = (energy(at + step) - energy(at - step)) / 2e-6
    return found


@pytest.mark.parametrize("name", ["bending", "square"])
def test_a_force_is_minus_the_gradient_of_its_energy(name: str) -> None:
    force, stiff = np.zeros_like(AT), np.zeros(len(AT))
    if name == "bending":
        _stiffen(AT, WALK, lengths(AT), force, stiff, 0.0007)
        slope = gradient(bending, AT)
    else:
        _square(AT, WALK, VISITS, force, stiff, 2.0)
        slope = gradient(square, AT)
    assert np.abs(slope).max() > 1e-3
    assert np.abs(force + slope).max() < 1e-6 * np.abs(slope).max() + 1e-9
