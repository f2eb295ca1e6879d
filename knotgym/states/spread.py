"""Spread: how unlike each other a set's configurations are.

Each number means the same for any set of the rope: how far from each other the ropes lie, bead by
bead and as mere curves, how crumpled they are, how high they reach, and where along the rope they
cross.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.states.near_duplicates import distances
from knotgym.topology.crossings import find_crossings

MOST = 500  # configurations that pairs are made of


@dataclass(frozen=True)
class Spread:
    """The spread of at least one configuration.

    Attributes:
        distance: median and least distance of all pairs, metres: root mean square over the beads,
            after the best turn about z and the best shift; None of a single one.
        shape: the same of the curves alone, at the best base bead and direction of walking too. The
            bead by bead distance of two equal circles walked in opposite directions is 1.4 radii.
        gyration: least and largest radius of gyration, metres: root mean square distance of the
            vertices from their mean. A circle as long as the rope has 0.212.
        height: least and largest height of the highest vertex above the lowest, metres.
        visits: how far along the rope a visit to a crossing is from one in another configuration,
            on average, beads: a quarter of the rope's if crossings lie anywhere, 0 if always at one
            place; None without crossings, or of a single one.
        bare: the longest stretch of the rope where no configuration crosses, beads; None without
            crossings.
    """

    distance: tuple[float, float] | None
    shape: tuple[float, float] | None
    gyration: tuple[float, float]
    height: tuple[float, float]
    visits: float | None
    bare: float | None

    def as_json(self) -> dict[str, Any]:
        """JSON-able, tuples as lists."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in asdict(self).items()
        }


def spread_of(points: NDArray[np.float64]) -> Spread:
    """Measure configurations, the same for any order of them.

    Of more than MOST, pairs are made of MOST that are evenly taken.

    Args:
        points: float64 (n, beads, 3), n at least 1, metres.
    """
    few = points
    if len(points) > MOST:
        few = points[np.linspace(0, len(points) - 1, MOST).round().astype(int)]
    pairs = [
        np.concatenate([apart(one, few[k + 1 :]) for k, one in enumerate(few)])
        for apart in (distances, shape_distances)
    ]
    centred = points - points.mean(axis=1, keepdims=True)
    gyration = np.sqrt((centred**2).sum(axis=2).mean(axis=1))
    height = np.ptp(points[..., 2], axis=1)
    places = [_places(one) for one in few]
    return Spread(
        distance=_middle_and_least(pairs[0]),
        shape=_middle_and_least(pairs[1]),
        gyration=(float(gyration.min()), float(gyration.max())),
        height=(float(height.min()), float(height.max())),
        visits=visit_distance(places, points.shape[1]),
        bare=bare_stretch(np.concatenate(places), points.shape[1]),
    )


def shape_distances(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """As `distances`, also over the base bead and the direction that each is walked in.

    Args:
        points: float64 (beads, 3), metres.
        others: float64 (n, beads, 3), metres.

    Returns:
        float64 (n,), root mean square distance of the beads, metres.
    """
    a = points - points.mean(axis=0)
    b = others - others.mean(axis=1, keepdims=True)
    best = np.full(len(others), -np.inf)
    for walked in (b, b[:, ::-1]):
        # sums over beads for every base bead at once, see `distances`
        flat = _correlation(walked[..., 0] + 1j * walked[..., 1], a[:, 0] + 1j * a[:, 1])
        upright = _correlation(walked[..., 2], a[:, 2]).real
        best = np.maximum(best, (np.abs(flat) + upright).max(axis=1))
    square = np.maximum(0.0, (a**2).sum() + (b**2).sum(axis=(1, 2)) - 2 * best)
    return np.asarray(np.sqrt(square / len(points)))


def visit_distance(places: Sequence[NDArray[np.float64]], beads: int) -> float | None:
    """Mean distance along the rope of visits in different configurations, beads.

    Args:
        places: of the visits of each configuration, in [0, beads].
        beads: of the rope.

    >>> visit_distance([np.array([98.0]), np.array([2.0, 48.0])], 100)
    27.0
    """
    total, count = 0.0, 0
    for k, own in enumerate(places):
        others = np.concatenate([np.empty(0), *places[k + 1 :]])
        for place in own:
            apart = np.abs(others - place)
            total += float(np.minimum(apart, beads - apart).sum())
            count += len(others)
    return total / count if count else None


def bare_stretch(places: NDArray[np.float64], beads: int) -> float | None:
    """Length of the longest stretch of the rope without a visit, beads.

    >>> bare_stretch(np.array([90.0, 10.0, 40.0]), 100)
    50.0
    """
    if not len(places):
        return None
    ordered = np.sort(places)
    return float(np.diff(ordered, append=ordered[0] + beads).max())


def _correlation(rows: NDArray[Any], one: NDArray[Any]) -> NDArray[Any]:
    """Sums of row times conjugate of `one` at every cyclic shift: complex (n, beads)."""
    return np.asarray(np.fft.ifft(np.fft.fft(rows, axis=1) * np.fft.fft(one).conj(), axis=1))


def _middle_and_least(values: NDArray[np.float64]) -> tuple[float, float] | None:
    return (float(np.median(values)), float(values.min())) if len(values) else None


def _places(points: NDArray[np.float64]) -> NDArray[np.float64]:
    crossings = find_crossings(points)
    return np.concatenate([crossings.over_place, crossings.under_place])
