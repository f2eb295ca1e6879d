"""Spread: how diverse the configurations of a set are.

The measures are comparable between sets: distances between configurations (bead by bead, and as
curves), radii of gyration, heights, and where along the rope the crossings are.

After a change run `pytest tests/states/test_spread.py`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.states.near_duplicates import distances
from knotgym.topology import find_crossings

MOST = 500  # configurations that are compared pairwise


def spread_of(points: NDArray[np.float64]) -> dict[str, Any]:
    """Measure the spread of configurations; their order doesn't matter for up to MOST of them.

    Of more than MOST, only MOST evenly spaced ones are compared pairwise.

    Args:
        points: float64 (n, beads, 3), n at least 1, metres.

    Returns:
        Values for JSON:
        "distance": median and minimum over all pairs, metres: root mean square over the beads,
            after the best rotation about z and translation; None for a single configuration;
        "shape": the same, also at the best base bead and direction along the rope (bead by bead,
            two equal circles traversed in opposite directions are 1.4 radii apart);
        "gyration": minimum and maximum radius of gyration, metres: root mean square distance of the
            vertices from their mean; a circle as long as the rope has 0.212;
        "height": minimum and maximum from the lowest to the highest vertex, metres;
        "visits": mean distance along the rope, in beads, between a crossing in one configuration
            and one in another: a quarter of the beads if crossings are uniform, 0 if all are at one
            position; None without crossings or with one configuration;
        "bare": longest stretch where no configuration crosses, beads; None without crossings.
    """
    few = points
    if len(points) > MOST:
        few = points[np.linspace(0, len(points) - 1, MOST).round().astype(int)]
    pairs = [
        np.concatenate([apart(one, few[k + 1 :]) for k, one in enumerate(few)])
        for apart in (distances, _shape_distances)
    ]
    centred = points - points.mean(axis=1, keepdims=True)
    gyration = np.sqrt((centred**2).sum(axis=2).mean(axis=1))
    height = np.ptp(points[..., 2], axis=1)
    found = [find_crossings(one) for one in few]
    positions = [np.concatenate([one.over_place, one.under_place]) for one in found]
    return {
        "distance": _median_and_minimum(pairs[0]),
        "shape": _median_and_minimum(pairs[1]),
        "gyration": [float(gyration.min()), float(gyration.max())],
        "height": [float(height.min()), float(height.max())],
        "visits": _visit_distance(positions, points.shape[1]),
        "bare": _bare_stretch(np.concatenate(positions), points.shape[1]),
    }


def _shape_distances(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute `distances` minimized also over the base bead and the direction along the rope."""
    a = points - points.mean(axis=0)
    b = others - others.mean(axis=1, keepdims=True)
    best = np.full(len(others), -np.inf)
    for walked in (b, b[:, ::-1]):
        # the agreement of `distances`, for every shift of the base bead at once
        flat = _correlation(walked[..., 0] + 1j * walked[..., 1], a[:, 0] + 1j * a[:, 1])
        upright = _correlation(walked[..., 2], a[:, 2]).real
        best = np.maximum(best, (np.abs(flat) + upright).max(axis=1))
    # |a|^2 + |b|^2 - 2 agreement; rounding can make it negative
    square = np.maximum(0.0, (a**2).sum() + (b**2).sum(axis=(1, 2)) - 2 * best)
    return np.asarray(np.sqrt(square / len(points)))


def _visit_distance(positions: Sequence[NDArray[np.float64]], beads: int) -> float | None:
    """Compute the mean distance, in beads, between visits of different configurations.

    `positions` are those of each configuration's visits along the rope, in [0, beads].

    >>> _visit_distance([np.array([98.0]), np.array([2.0, 48.0])], 100)
    27.0
    """
    total, count = 0.0, 0
    for k, own in enumerate(positions):
        others = np.concatenate([np.empty(0), *positions[k + 1 :]])
        # the rope is closed: the shorter of the two ways along it
        apart = np.abs(own[:, None] - others)
        total += float(np.minimum(apart, beads - apart).sum())
        count += apart.size
    return total / count if count else None


def _bare_stretch(positions: NDArray[np.float64], beads: int) -> float | None:
    """Compute the length, in beads, of the longest stretch of the rope without a visit.

    >>> _bare_stretch(np.array([90.0, 10.0, 40.0]), 100)
    50.0
    """
    if not len(positions):
        return None
    # the gap after the last position wraps around to the first
    ordered = np.sort(positions)
    return float(np.diff(ordered, append=ordered[0] + beads).max())


def _correlation(rows: NDArray[Any], one: NDArray[Any]) -> NDArray[Any]:
    """Correlate rows with `one` at every cyclic shift: complex (n, beads)."""
    # sum_j row[j + s] conj(one[j]) for all s, by the correlation theorem
    return np.asarray(np.fft.ifft(np.fft.fft(rows, axis=1) * np.fft.fft(one).conj(), axis=1))


def _median_and_minimum(values: NDArray[np.float64]) -> list[float] | None:
    return [float(np.median(values)), float(values.min())] if len(values) else None
