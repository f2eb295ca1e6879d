"""Near-duplicates: configurations so alike that not one may be for training, one for testing.

Two configurations are near-duplicates when a symmetry of the rope (`topology.symmetry`) brings one
within NEAR of the other: root mean square distance of their beads, which is three pixels of the
picture. The symmetries are moves and turns about z, reflection (x -> -x) and switch (z -> -z), the
other base bead and the other direction of walking. A reflection or a switch changes the Gauss code
and a shifted base may; all the same it is one geometry, and who has learned to untie the one has
learned the other.

Distances are found by cyclic correlation. With the flat parts as complex numbers, p of one rope and
q of the other, both centred, the best turn about z of q shifted by s agrees with p by
|sum_j q[j + s] conj(p[j])|; a reflection conjugates q, a switch changes the sign of the agreement
in z, walking the other way reverses q. All shifts at once are an inverse Fourier transform of a
product of transforms. The moduli of those transforms bound the agreement from above, whatever the
symmetry, and so most pairs are ruled out by a product of matrices.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NEAR = 0.015  # metres
_BLOCK = 1024  # rows, or pairs, at once in memory


class Spectra(NamedTuple):
    """Configurations, centred, as Fourier transforms along the rope.

    Attributes:
        flat: complex128 (n, beads), of x + iy.
        upright: complex128 (n, beads), of z.
        square: float64 (n,), sum of squared distances of the vertices from their mean, m^2.
    """

    flat: Complex
    upright: Complex
    square: Array

    @classmethod
    def of(cls, points: Array) -> Spectra:
        """Those of configurations float64 (n, beads, 3), metres."""
        centred = points - points.mean(axis=1, keepdims=True)
        return cls(
            np.fft.fft(centred[..., 0] + 1j * centred[..., 1], axis=1),
            np.fft.fft(centred[..., 2], axis=1),
            (centred**2).sum(axis=(1, 2)),
        )

    def least_distances(self, others: Spectra) -> Array:
        """Bounds that no symmetry's distance is below: float64 (n, len(others)), metres."""
        a, b = np.abs(self.flat), np.abs(others.flat)
        # Parseval: a sum over beads is one over frequencies divided by their number, and at most
        # that of the moduli. Walking the other way or reflecting pairs frequency k with -k.
        flat = np.maximum(a @ b.T, a @ _negated(b).T)
        agreement = (flat + np.abs(self.upright) @ np.abs(others.upright).T) / a.shape[1]
        return self._distances(self.square[:, None], others.square[None], agreement)

    def pair_distances(self, others: Spectra) -> Array:
        """The distance of row k to row k of others, at the best symmetry: float64 (n,), metres."""
        best = np.full(len(self.flat), -np.inf)
        flat, upright = self.flat.conj(), self.upright.conj()
        for reverse in (False, True):
            walked = _negated(others.flat) if reverse else others.flat
            raised = _negated(others.upright) if reverse else others.upright
            z = np.abs(np.fft.ifft(raised * upright, axis=1).real)
            # the transform of the conjugate is the conjugate at the negative frequencies
            for seen in (walked, _negated(walked).conj()):
                both = np.abs(np.fft.ifft(seen * flat, axis=1)) + z
                best = np.maximum(best, both.max(axis=1))
        return self._distances(self.square, others.square, best)

    def turned_distances(self, others: Spectra) -> Array:
        """The `distances` of the one row to all rows of others: float64 (len(others),), metres."""
        # Parseval again: agreement bead by bead is agreement frequency by frequency
        flat = np.abs(others.flat @ self.flat[0].conj())
        agreement = flat + (others.upright @ self.upright[0].conj()).real
        return self._distances(self.square, others.square, agreement / self.flat.shape[1])

    def taken(self, rows: NDArray[np.integer]) -> Spectra:
        """Some rows, in that order."""
        return Spectra(*(one[rows] for one in self))

    def _distances(self, square: Array, others: Array, agreement: Array) -> Array:
        apart = np.maximum(0.0, square + others - 2 * agreement)
        return np.asarray(np.sqrt(apart / self.flat.shape[1]))


def pairs_within(
    points: Array, others: Array | None = None, limit: float = NEAR
) -> list[tuple[int, int, float]]:
    """The pairs of a row and a row of others that a symmetry brings nearer than a limit.

    Args:
        points: float64 (n, beads, 3), metres.
        others: float64 (m, beads, 3), metres; None for pairs of rows of `points`, each once.
        limit: metres.

    Returns:
        Row, other row and distance of each pair, in order.
    """
    a = Spectra.of(points)
    b = a if others is None else Spectra.of(others)
    found: list[tuple[int, int, float]] = []
    for first in range(0, len(points), _BLOCK):
        rows = np.arange(first, min(first + _BLOCK, len(points)))
        near = a.taken(rows).least_distances(b) < limit
        if others is None:
            near &= np.arange(len(points)) > rows[:, None]
        some, columns = np.nonzero(near)
        for start in range(0, len(some), _BLOCK):
            i, j = rows[some[start : start + _BLOCK]], columns[start : start + _BLOCK]
            apart = a.taken(i).pair_distances(b.taken(j))
            found += [
                (int(row), int(other), float(distance))
                for row, other, distance in zip(i, j, apart, strict=True)
                if distance < limit
            ]
    return found


def families(points: Array, within: float = NEAR) -> NDArray[np.int64]:
    """Number configurations so that those that a symmetry brings near each other share a number.

    Args:
        points: float64 (n, beads, 3), metres.
        within: metres.
    """
    leader = np.arange(len(points))
    for row, other, _ in pairs_within(points, limit=within):
        low, high = sorted((leader[row], leader[other]))
        leader[leader == high] = low
    return np.unique(leader, return_inverse=True)[1].astype(np.int64)


def nearest(points: Array, others: Array) -> tuple[Array, NDArray[np.int64]]:
    """How near the nearest of others is to each configuration, and which it is, at the best
    symmetry.

    Args:
        points: float64 (n, beads, 3), metres.
        others: float64 (m, beads, 3), at least one, metres.

    Returns:
        float64 (n,), metres, and int64 (n,).
    """
    a, b = Spectra.of(points), Spectra.of(others)
    least = a.least_distances(b)
    distance, row = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    for k, bounds in enumerate(least):
        # by rising bound, until none of those left can be nearer than what was found
        order = np.argsort(bounds, kind="stable")
        for first in range(0, len(order), 64):
            some = order[first : first + 64]
            if bounds[some[0]] >= distance[k]:
                break
            apart = a.taken(np.full(len(some), k)).pair_distances(b.taken(some))
            if apart.min() < distance[k]:
                distance[k], row[k] = apart.min(), some[apart.argmin()]
    return distance, row


def apart(points: Array) -> NDArray[np.bool_]:
    """Which configurations to keep: those not near an earlier one that is kept, by `distances`.

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


def repeated(points: Array) -> list[tuple[int, int]]:
    """Which rows repeat an earlier one bit for bit: pairs of the first such row and the later one.

    >>> repeated(np.array([[1.0], [2.0], [1.0]]))
    [(0, 2)]
    """
    first: dict[bytes, int] = {}
    pairs = [(first.setdefault(one.tobytes(), row), row) for row, one in enumerate(points)]
    return [(earlier, row) for earlier, row in pairs if earlier != row]


def distances(points: Array, others: Array) -> Array:
    """How far each of `others` is from a configuration, bead by bead, after the best turn about z.

    No other symmetry is tried: this tells whether a rope lies at a state, not whether two states
    are alike.

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


def _negated(spectra: NDArray[Any]) -> NDArray[Any]:
    """Spectra (n, beads) at the negative frequencies: those of the ropes walked the other way."""
    return np.roll(spectra[:, ::-1], 1, axis=1)
