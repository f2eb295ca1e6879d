"""Spread is right for shapes whose spread is known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.datasets import locate, summary
from knotgym.rope import Rope
from knotgym.states.near_duplicates import Spectra, spread_of
from knotgym.states.state_file import read_states
from knotgym.topology import Symmetry

from ..conftest import curled


def circle(radius: float, lift: float = 0.0) -> NDArray[np.float64]:
    """A hundred vertices on a circle; every other one lifted."""
    at = 2 * np.pi * np.arange(100) / 100
    return np.stack([radius * np.cos(at), radius * np.sin(at), lift * (np.arange(100) % 2)], axis=1)


def turned(points: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    return Symmetry(turn=angle).vertices(points) + (0.3, -0.2, 0.1)


def test_circles_are_as_far_from_each_other_as_their_radii_differ() -> None:
    found = spread_of(np.array([circle(0.1), turned(circle(0.13), 1.0), circle(0.2)]))
    assert found["distance"] == pytest.approx((0.07, 0.03))
    assert found["shape"] == pytest.approx((0.07, 0.03))
    assert found["gyration"] == pytest.approx((0.1, 0.2))
    assert found["height"] == pytest.approx((0.0, 0.0), abs=1e-12)
    assert found["visits"] is None and found["bare"] is None


def test_a_circle_walked_the_other_way_from_elsewhere_is_the_same_shape() -> None:
    other = turned(np.roll(circle(0.2)[::-1], 7, axis=0), 1.0)
    found = spread_of(np.array([circle(0.2), other]))
    assert found["distance"] == pytest.approx((0.2 * 2**0.5, 0.2 * 2**0.5))
    assert found["shape"] == pytest.approx((0.0, 0.0), abs=1e-8)


def test_visits_are_as_far_apart_as_the_curls(rope: Rope) -> None:
    one = rope.from_curve(curled(1))
    same = spread_of(np.array([one, turned(one, 1.0)]))
    assert same["visits"] is not None and same["bare"] is not None
    quarter = spread_of(np.array([one, np.roll(one, 25, axis=0)]))
    assert quarter["visits"] is not None and quarter["visits"] > same["visits"]
    # two visits of one crossing are the beads of the curl apart; of the rest nothing crosses
    assert same["visits"] == pytest.approx((100 - same["bare"]) / 2)


def test_the_card_has_the_spread_of_every_nx() -> None:
    states = read_states(images=False)
    rows = summary(locate("readable"))[1]["spread"].rows
    assert [row[0] for row in rows] == [0, 1, 2, 3, 4]
    loops = states.points[states.nx == 0]
    apart = Spectra.of(loops).turned_distances(Spectra.of(loops))
    least = 1000 * apart[np.triu_indices(len(loops), 1)].min()
    assert str(rows[0][1]).endswith(f" / {round(least, 1):.3g}")
