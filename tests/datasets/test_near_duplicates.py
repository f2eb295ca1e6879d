"""Near-duplicates are found whatever symmetry of the rope hides them."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym import states
from knotgym.topology import Symmetry

STATES = states.read_states(states.shipped(), images=False).points[40:70]


def moved(points: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """The same rope after a symmetry drawn at random, and moved."""
    rng = np.random.default_rng(seed)
    reflect, switch, reverse = (bool(one) for one in rng.random(3) < 0.5)
    symmetry = Symmetry(
        reflect=reflect,
        switch=switch,
        turn=float(rng.uniform(-np.pi, np.pi)),
        reverse=reverse,
        base_shift=int(rng.integers(100)),
    )
    return symmetry.vertices(points) + rng.normal(0, 0.1, 3)


@pytest.mark.parametrize("seed", range(8))
def test_a_symmetry_is_no_distance(seed: int) -> None:
    hidden = np.stack([moved(one, seed + k) for k, one in enumerate(STATES)])
    apart, row = states.Spectra.of(hidden).nearest(states.Spectra.of(STATES))
    assert apart.max() < 1e-7 and row.tolist() == list(range(len(STATES)))


def test_the_distance_is_the_least_over_every_symmetry() -> None:
    one, other = (states.Spectra.of(STATES[[row]]) for row in (0, 11))
    every = [
        Symmetry(0.0, reflect, switch, reverse, shift).vertices(STATES[11])
        for reflect, switch in product((False, True), (False, True))
        for reverse, shift in product((False, True), range(100))
    ]
    turned = states.Spectra.of(STATES[:1]).turned_distances(states.Spectra.of(np.stack(every)))
    least = pytest.approx(turned.min())
    assert one.pair_distances(other)[0] == least
    assert other.pair_distances(one)[0] == least
    assert one.nearest(other)[0][0] == least


def test_no_distance_is_below_its_bound() -> None:
    spectra = states.Spectra.of(STATES)
    bounds = spectra._least_distances(spectra)
    for k in range(len(STATES)):
        exact = spectra.take(np.full(len(STATES), k)).pair_distances(spectra)
        assert (bounds[k] <= exact + 1e-6).all()
        apart = np.linalg.norm(spectra.invariants - spectra.invariants[k], axis=1)
        assert (apart <= exact + 1e-6).all() and np.median(apart) > states.NEAR


def test_pairs_are_found_once_and_families_are_numbered() -> None:
    points = np.concatenate([STATES[:4], [moved(STATES[1], 3)], [moved(STATES[1], 4)]])
    assert [(i, j) for i, j, _ in states.pairs_within(points)] == [(1, 4), (1, 5), (4, 5)]
    assert states.families(points).tolist() == [0, 1, 2, 3, 1, 1]
