"""Near-duplicates: configurations too similar to be in different splits.

Two configurations are near-duplicates if a symmetry of the rope (`topology.symmetry`) brings them
within NEAR of each other: root mean square distance over the beads; NEAR is three pixels of the
picture. The symmetries are translation, rotation about z, reflection (x -> -x), switch (z -> -z),
a shift of the base bead and reversal of the direction along the rope. Reflection and switch change
the Gauss code, and a base shift may. The geometry is the same nevertheless: a policy that can untie
one can untie the other.

Method: write the centred x, y of the beads as complex numbers, p[j] and q[j], and the heights as
u[j] and v[j]. For bead shift s the squared distance, minimized over rotations about z, is

    sum |p|^2 + |q|^2 + u^2 + v^2  -  2 (|sum_j q[j + s] conj(p[j])| + sum_j v[j + s] u[j])

The bracket is called the agreement. Reflection conjugates q, a switch negates v, reversal reverses
both. The sums for all s at once are one inverse FFT of a product of spectra. Sums of products of
the spectra's moduli bound the agreement for every symmetry, so that one matrix product rules out
most pairs.

After a change run `pytest tests/datasets/test_near_duplicates.py`: distances are compared with the
least over all symmetries one by one, and no pair within NEAR may be missed.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array

Complex = NDArray[np.complex128]

# Three pixels of 5.2 mm: what neither a picture nor reset noise at its usual scale (0.015) tells
# apart. It is a definition, not a fit; a change makes other splits, so other sets.
NEAR = 0.015  # metres, root mean square over the beads
_BLOCK = 1024  # rows, or pairs, held in memory at once
_WAVES = 5  # frequencies whose moduli tell most configurations apart


class Spectra(NamedTuple):
    """Discrete Fourier transforms, along the rope, of centred configurations.

    Attributes:
        flat: complex128 (n, beads), transform of x + iy.
        upright: complex128 (n, beads), transform of z.
        square: float64 (n,), sum of squared distances of the vertices from their mean, m^2.
        invariants: float64 (n, 3 _WAVES + 1), metres, the same for all that a symmetry makes of a
            configuration. Their distance (a norm) is at most that of the configurations.
    """

    flat: Complex
    upright: Complex
    square: Array
    invariants: Array

    @classmethod
    def of(cls, points: Array) -> Spectra:
        """Transform configurations, float64 (n, beads, 3), metres."""
        centred = points - points.mean(axis=1, keepdims=True)
        flat = np.fft.fft(centred[..., 0] + 1j * centred[..., 1], axis=1)
        upright = np.fft.fft(centred[..., 2], axis=1)
        square, beads = (centred**2).sum(axis=(1, 2)), points.shape[1]
        # Moduli of the lowest frequencies, where most of a rope's shape is. Frequencies k and -k
        # change places by symmetries, so they are sorted; z is real, so its own are equal. What
        # all others hold together is the last number (Parseval).
        waves = np.arange(1, _WAVES + 1)
        sides = np.sort(np.abs(np.stack([flat[:, waves], flat[:, -waves]])), axis=0)
        lowest = np.hstack([*sides, np.sqrt(2) * np.abs(upright[:, waves])])
        rest = np.sqrt(np.maximum(0.0, beads * square - (lowest**2).sum(axis=1)))
        return cls(flat, upright, square, np.column_stack([lowest, rest]) / beads)

    def _least_distances(self, others: Spectra) -> Array:
        """Bound the distance of all pairs from below: float64 (n, len(others)), metres."""
        a, b = np.abs(self.flat), np.abs(others.flat)
        # Parseval: a sum over beads is the sum over frequencies / beads, and its modulus is at most
        # the sum of the moduli. A shift or rotation changes phases only. Reversal or reflection
        # pairs frequency k with -k; both together pair k with k again.
        flat = np.maximum(a @ b.T, a @ _negated(b).T)
        agreement = (flat + np.abs(self.upright) @ np.abs(others.upright).T) / a.shape[1]
        return self._distances(self.square[:, None], others.square[None], agreement)

    def pair_distances(self, others: Spectra) -> Array:
        """Compute the distance of each row, or of one, to that row of others: float64 (n,), m."""
        best = np.full(len(self.flat), -np.inf)
        flat, upright = self.flat.conj(), self.upright.conj()
        for reverse in (False, True):
            flat_other = _negated(others.flat) if reverse else others.flat
            upright_other = _negated(others.upright) if reverse else others.upright
            # a switch may choose the sign
            z = np.abs(np.fft.ifft(upright_other * upright, axis=1).real)
            # reflection: the transform of conj(q) is the conjugate of q's at negated frequencies
            for shown in (flat_other, _negated(flat_other).conj()):
                both = np.abs(np.fft.ifft(shown * flat, axis=1)) + z
                best = np.maximum(best, both.max(axis=1))
        return self._distances(self.square, others.square, best)

    def turned_distances(self, others: Spectra) -> Array:
        """Compute the distances of all pairs, bead by bead: float64 (n, len(others)), metres.

        They are those after the best translation and rotation about z. No other symmetry is tried:
        they tell whether a rope is at a state, not whether two states are near-duplicates.
        """
        # Parseval: a sum over beads of products is the sum over frequencies / beads
        flat = np.abs(self.flat.conj() @ others.flat.T)
        agreement = flat + (self.upright.conj() @ others.upright.T).real
        return self._distances(self.square[:, None], others.square, agreement / self.flat.shape[1])

    def nearest(self, others: Spectra) -> tuple[Array, NDArray[np.int64]]:
        """Find the nearest of others to each configuration, at the best symmetry.

        Returns:
            Distances, float64 (n,), metres, and rows of others, int64 (n,).
        """
        least = self._least_distances(others)
        distance, row = np.full(len(least), np.inf), np.zeros(len(least), dtype=np.int64)
        for k, bounds in enumerate(least):
            # in order of rising bound; stop when no remaining bound is below the best distance
            order = np.argsort(bounds, kind="stable")
            for first in range(0, len(order), 64):
                some = order[first : first + 64]
                if bounds[some[0]] >= distance[k]:
                    break
                apart = self.take(slice(k, k + 1)).pair_distances(others.take(some))
                if apart.min() < distance[k]:
                    distance[k], row[k] = apart.min(), some[apart.argmin()]
        return distance, row

    def take(self, rows: Any) -> Spectra:
        """Select rows, in the order given."""
        return Spectra(*(array[rows] for array in self))

    def _distances(self, square: Array, others: Array, agreement: Array) -> Array:
        # rounding can make the square of a vanishing distance negative
        apart = np.maximum(0.0, square + others - 2 * agreement)
        return np.asarray(np.sqrt(apart / self.flat.shape[1]))


def pairs_within(points: Array, others: Array | None = None) -> list[tuple[int, int, float]]:
    """Find the pairs of configurations that a symmetry brings within NEAR of each other.

    Args:
        points: float64 (n, beads, 3), metres.
        others: float64 (m, beads, 3); None to compare the points with each other, each pair once.

    Returns:
        Row, other row and distance of each pair, sorted.
    """
    a = Spectra.of(points)
    b = a if others is None else Spectra.of(others)
    pairs: list[tuple[int, int, float]] = []
    for first in range(0, len(points), _BLOCK):
        rows = np.arange(first, min(first + _BLOCK, len(points)))
        # one matrix product a block rules out nearly all pairs; the rest is computed exactly
        near = a.take(rows)._least_distances(b) < NEAR
        if others is None:
            near &= np.arange(len(points)) > rows[:, None]
        some, columns = np.nonzero(near)
        for start in range(0, len(some), _BLOCK):
            i, j = rows[some[start : start + _BLOCK]], columns[start : start + _BLOCK]
            apart = a.take(i).pair_distances(b.take(j))
            rows_of = zip(i.tolist(), j.tolist(), apart.tolist(), strict=True)
            pairs += [pair for pair in rows_of if pair[2] < NEAR]
    return pairs


def families(points: Array) -> NDArray[np.int64]:
    """Number the families, int64 (n,): components of the graph that connects near-duplicates."""
    # leader: the lowest row of the component; each pair merges two components
    leader = np.arange(len(points))
    for row, other, _ in pairs_within(points):
        low, high = sorted((leader[row], leader[other]))
        leader[leader == high] = low
    return np.unique(leader, return_inverse=True)[1].astype(np.int64)


def repeated(rows: Iterable[Hashable]) -> list[tuple[int, int]]:
    """List the rows that equal an earlier one, as pairs (first such row, row).

    >>> repeated(["a", "b", "a"])
    [(0, 2)]
    """
    first: dict[Hashable, int] = {}
    pairs = [(first.setdefault(value, row), row) for row, value in enumerate(rows)]
    return [(earlier, row) for earlier, row in pairs if earlier != row]


def _negated(spectra: NDArray[Any]) -> NDArray[Any]:
    """Reorder spectra (n, beads) from frequency k to -k: the spectra of the reversed ropes."""
    return np.roll(spectra[:, ::-1], 1, axis=1)
