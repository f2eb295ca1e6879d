"""Near-duplicates: configurations so alike that not one may be for training, one for testing.

Two configurations are near-duplicates when one, turned about z and moved, comes within NEAR of the
other: root mean square distance of their beads, which is three pixels of the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NEAR = 0.015  # metres


def apart(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which configurations to keep: those not near an earlier one that is kept.

    Args:
        points: float64 (n, beads, 3), metres.

    Returns:
        bool (n,).
    """
    centred = points - points.mean(axis=1, keepdims=True)
    # those of near-duplicates differ by less than NEAR
    size = np.sqrt((centred**2).sum(axis=(1, 2)) / points.shape[1])
    order = np.argsort(size, kind="stable")
    first, last = (np.searchsorted(size[order], size + sign * NEAR) for sign in (-1, 1))
    kept = np.ones(len(points), dtype=bool)
    for row in range(len(points)):
        like = order[first[row] : last[row]]
        like = like[(like < row) & kept[like]]
        kept[row] = not (len(like) and (distances(points[row], points[like]) < NEAR).any())
    return kept


def repeated(points: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Which rows repeat an earlier one bit for bit: pairs of the first such row and the later one.

    >>> repeated(np.array([[1.0], [2.0], [1.0]]))
    [(0, 2)]
    """
    first: dict[bytes, int] = {}
    pairs = [(first.setdefault(one.tobytes(), row), row) for row, one in enumerate(points)]
    return [(earlier, row) for earlier, row in pairs if earlier != row]


def distances(points: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far each of `others` is from a configuration at best, over turns about z and shifts.

    Args:
        points: float64 (beads, 3), metres.
        others: float64 (n, beads, 3), metres.

    Returns:
        float64 (n,), root mean square distance of the beads, metres.
    """
    a = points - points.mean(axis=0)
    b = others - others.mean(axis=1, keepdims=True)
    flat_a, flat_b = a[:, 0] + 1j * a[:, 1], b[..., 0] + 1j * b[..., 1]
    # the best turn makes the sum of conj(a) b real and positive
    agreement = np.abs(flat_b @ flat_a.conj()) + b[..., 2] @ a[:, 2]
    square = np.maximum(0.0, (a**2).sum() + (b**2).sum(axis=(1, 2)) - 2 * agreement)
    return np.asarray(np.sqrt(square / len(points)))
