"""What is believed of a rope that is seen in pictures alone: how it lies, and where.

Heights can't be read for sure, so several ropes are kept that may be the one seen. All are moved in
the model as the real one was pulled, and where their beads come to lie in the next picture tells
which is likely. Which bead was pulled isn't seen either; it tells where in the world the rope is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.learn.reader import Reader
from knotgym.learn.rope_model import BEADS, Dynamics
from knotgym.learn.whereabouts import Whereabouts
from knotgym.rendering.picture import draw
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

_TOGETHER = 25.0  # neighbouring beads that err alike
_ASTRAY = 0.5  # levels a pixel by which a rope led astray looks worse than a new reading
_ALIKE = 0.008  # metres in height, between ropes that count as one
_ASKED = 2  # ropes that are asked which bead was pulled, and which code is shown
_SURPRISE = 0.0005  # how likely a bead is pulled that no place of the rope says would be


@dataclass(frozen=True, kw_only=True)
class BeliefConfig:
    """How much is thought possible.

    Attributes:
        ropes: kept at most, that may be the one seen.
        varied: ropes tried beside them after every pull, each a kept one with other heights.
        wave: metres by which heights are varied, about.
        fresh: how likely it is that none of them is, and a new reading is better.
        blur: metres by which vertices foreseen and read differ, about.
        codes: ropes looked at for the codes that a reading may stand for.
    """

    ropes: int = 24
    varied: int = 24
    wave: float = 0.008
    fresh: float = 0.05
    blur: float = 0.003
    codes: int = 30


class RopeBelief:
    """The belief of one episode.

    Attributes:
        ropes: float64 (n, BEADS, 3), metres, the likeliest first, each with its middle at 0.
        velocities: the same, m/s.
        likely: float64 (n,), sums to 1.
        whereabouts: where the middle lies in the world.
        bead: last pulled, most likely.
    """

    def __init__(
        self,
        reader: Reader,
        dynamics: Dynamics,
        met: Array,
        config: BeliefConfig,
        rng: np.random.Generator,
    ) -> None:
        """Begin with the places met in training, float64 (n, 3)."""
        self._reader, self._dynamics, self._config, self._rng = reader, dynamics, config, rng
        self.whereabouts = Whereabouts(met, rng)
        self.ropes = self.velocities = np.zeros((1, BEADS, 3))
        self.likely = np.ones(1)
        self.bead = 0

    def see(self, picture: NDArray[np.uint8]) -> None:
        """Read the rope for the first time, from a picture uint8 (SIZE, SIZE, 3)."""
        read, likely = self._reader.read(picture)
        self._keep(read, np.zeros_like(read), likely)

    def see_pulled(self, picture: NDArray[np.uint8], named: Array, force: Array) -> None:
        """Read it again after an action that named a point of the world, (3,), with a force (3,),
        in units of the largest.
        """
        read, likely = self._reader.read(picture)
        self._find_pulled(read[0], named, force)
        rows = self._rng.choice(len(self.ropes), size=self._config.varied, p=self.likely)
        varied = waved(self.ropes[rows], self._config.wave, self._rng)
        before = np.concatenate([self.ropes, varied])
        after, velocities = self._dynamics.step(
            before,
            np.concatenate([self.velocities, self.velocities[rows]]),
            np.full(len(before), self.bead),
            np.tile(force, (len(before), 1)),
        )
        middles = after.mean(axis=1)
        fit = self._fit(after - middles[:, None], read[0])
        prior = np.concatenate([self.likely, np.full(len(rows), 1 / max(1, len(rows)))])
        carried = prior * np.exp(fit - fit.max())
        best = int(np.argmax(carried))
        self.whereabouts.moved(middles[best])
        followed = self._reader.follow(picture, after - middles[:, None], after - before)
        fresh = self._config.fresh
        if _unlike(read[0], picture) + _ASTRAY < _unlike(followed[best], picture):
            fresh = 1 - fresh
        self._keep(
            np.concatenate([followed, read]),
            np.concatenate([velocities, np.tile(velocities[best], (len(read), 1, 1))]),
            np.concatenate([(1 - fresh) * carried / carried.sum(), fresh * likely]),
        )

    def shown(self, picture: NDArray[np.uint8]) -> dict[GaussCode, float]:
        """Codes, without chirality, that the rope in the picture may show, and how likely."""
        return self._codes(picture, self.ropes[:_ASKED], self.likely[:_ASKED])

    def read_codes(self, picture: NDArray[np.uint8]) -> dict[GaussCode, float]:
        """The same of another rope, such as the goal's."""
        return self._codes(picture, *self._reader.read(picture))

    def drawn(self, count: int) -> tuple[Array, Array]:
        """Ropes that may be the one seen and their velocities, the first of them the likeliest."""
        rows = self._rng.choice(len(self.ropes), size=count, p=self.likely)
        rows[0] = 0
        return self.ropes[rows], self.velocities[rows]

    def _codes(
        self, picture: NDArray[np.uint8], ropes: Array, likely: Array
    ) -> dict[GaussCode, float]:
        # A reading is a millimetre off here and there, so a small kink may be missed or made up.
        count = self._config.codes
        varied = self._reader.varied(picture, ropes, count, self._rng)
        codes: dict[GaussCode, float] = {}
        for code, share in zip(label_many(varied), np.repeat(likely, count), strict=True):
            codes[code.plain] = codes.get(code.plain, 0.0) + float(share)
        total = sum(codes.values())
        return {code: share / total for code, share in codes.items()}

    def _find_pulled(self, read: Array, named: Array, force: Array) -> None:
        """Learn which bead the last action pulled, and so where the rope is."""
        fit = np.full(BEADS, -np.inf)
        for rope, speeds, likely in zip(
            self.ropes[:_ASKED], self.velocities, self.likely, strict=False
        ):
            after, _ = self._dynamics.step(
                np.tile(rope, (BEADS, 1, 1)),
                np.tile(speeds, (BEADS, 1, 1)),
                np.arange(BEADS),
                np.tile(force, (BEADS, 1)),
            )
            own = self._fit(after - after.mean(axis=1, keepdims=True), read)
            fit = np.logaddexp(fit, own + np.log(likely))
        likelihood = np.exp(fit - fit.max())
        shares = self.whereabouts.shares(self.ropes[0], named)
        self.bead = int(np.argmax(likelihood * (shares + _SURPRISE)))
        self.whereabouts.pulled(self.ropes[0], named, likelihood)

    def _fit(self, foreseen: Array, read: Array) -> Array:
        """Logarithms of how likely a rope is read so, for each foreseen, (n,)."""
        off = ((foreseen[..., :2] - read[None, :, :2]) ** 2).sum(axis=2)
        blur = self._config.blur
        return -np.minimum(off, (4 * blur) ** 2).sum(axis=1) / (2 * blur**2 * _TOGETHER)

    def _keep(self, ropes: Array, velocities: Array, likely: Array) -> None:
        """Keep the likeliest of ropes, those that are alike as one."""
        kept: list[int] = []
        total = likely.copy()
        for row in np.argsort(-likely, kind="stable").tolist():
            apart = ropes[kept, :, 2] - ropes[row, :, 2]
            same = np.flatnonzero((apart**2).mean(axis=1) < _ALIKE**2)
            if len(same):
                total[kept[same[0]]] += likely[row]
            elif len(kept) < self._config.ropes:
                kept.append(row)
        kept.sort(key=lambda row: -total[row])
        self.ropes, self.velocities = ropes[kept], velocities[kept]
        self.likely = total[kept] / total[kept].sum()


def waved(ropes: Array, size: float, rng: np.random.Generator) -> Array:
    """Ropes (n, BEADS, 3) with smooth changes of their heights, of about `size` metres."""
    number = rng.integers(1, 9, (len(ropes), 1))
    angle = number * 2 * np.pi * np.arange(BEADS) / BEADS + rng.uniform(0, 2 * np.pi, number.shape)
    changed = ropes.copy()
    changed[..., 2] += size * rng.normal(size=number.shape) * np.sqrt(2) * np.cos(angle)
    return changed


def _unlike(points: Array, picture: NDArray[np.uint8]) -> float:
    """How much the picture that points would give differs from the one seen, levels a pixel."""
    drawn = draw(points).astype(np.int16)
    return float(np.abs(drawn - picture).mean())
