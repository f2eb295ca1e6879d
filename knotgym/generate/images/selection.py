"""Which frames become pictures, with which symmetry, in which split: even over codes, no two
near-duplicates.

A frame may be reflected, switched, walked the other way and renumbered to start at any bead: for a
picture all of these are exact. So a frame with n crossings can show up to 8n codes (without
chirality); it is made to show the one that its split has fewest of. Everything depends on the
frames and their order alone.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from knotgym.datasets.label_limits import BASE, at_base
from knotgym.datasets.near_duplicates import NEAR
from knotgym.rope import Array
from knotgym.topology.crossings import Crossings, find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry

EXTREME = (
    0.3  # share of each quota that may be graded "extreme" (see difficulty) but for its base bead
)
_BLOCK = 2048  # configurations compared at once


class ChosenFrame(NamedTuple):
    """A frame chosen.

    Attributes:
        points: float64 (beads, 3), metres: the configuration as it will be stored.
        code: what it shows, with chirality.
        split: of datasets.images.SPLITS.
        symmetry: that took the frame there.
        frame: its number among all frames.
    """

    points: Array
    code: GaussCode
    split: str
    symmetry: Symmetry
    frame: int


@dataclass(frozen=True)
class _Option:
    """Start the walk between two visits, perhaps backwards, perhaps switched: the visits then
    seen.
    """

    gap: int
    reverse: bool
    switch: bool
    shown: GaussCode


class Chooser:
    """Fills quotas, frame by frame.

    Attributes:
        quota: (split, nx) -> pictures wanted.
        chosen: so far.
        refused: reason -> frames.
    """

    def __init__(
        self, quota: dict[tuple[str, int], int], held_out: frozenset[GaussCode], beads: int
    ) -> None:
        """Begin with nothing; `held_out` are the codes, without chirality, that only "test-code"
        may show.
        """
        self.quota, self.chosen, self.refused = quota, list[ChosenFrame](), Counter[str]()
        self._held_out, self._have, self._extreme = (
            held_out,
            Counter[tuple[str, int]](),
            Counter[tuple[str, int]](),
        )
        self._codes = Counter[tuple[str, GaussCode]]()
        self._waves = np.empty((_BLOCK, 2 * beads), dtype=np.complex128)
        self._squares = np.empty(_BLOCK)

    def lacking(self) -> dict[tuple[str, int], int]:
        """(split, nx) -> pictures still wanted, where there are any."""
        return {
            key: quota - self._have[key]
            for key, quota in self.quota.items()
            if quota > self._have[key]
        }

    def consider(
        self, points: Array, split: str, ease: float, frame: int, rng: np.random.Generator
    ) -> bool:
        """Choose a frame (beads, 3) of a family that belongs to `split`, or not; says which."""
        crossings = find_crossings(points)
        key = split, crossings.nx
        if self.quota.get(key, 0) <= self._have[key]:
            return self._refuse("quota full")
        if ease < 0.5 and self._extreme[key] >= EXTREME * self.quota[key]:
            return self._refuse("extreme enough")
        symmetry = self._symmetry(crossings, len(points), split, rng)
        if symmetry is None:
            return self._refuse("no code wanted")
        moved = symmetry.configuration(points)
        shown = find_crossings(moved)
        if at_base(shown, len(moved)):
            return self._refuse("crossing at the base bead")
        if self._wrong(shown.code, split):  # rounding moved a crossing over a bead
            return self._refuse("code changed")
        if not self._apart(moved):
            return self._refuse("near-duplicate")
        self._have[key] += 1
        self._extreme[key] += ease < 0.5
        self._codes[split, shown.code.plain] += 1
        self.chosen.append(ChosenFrame(moved, shown.code, split, symmetry, frame))
        return True

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False

    def _wrong(self, code: GaussCode, split: str) -> bool:
        return split != "test-nx" and (code.plain in self._held_out) != (split == "test-code")

    def _symmetry(
        self, crossings: Crossings, beads: int, split: str, rng: np.random.Generator
    ) -> Symmetry | None:
        """The symmetry that shows the code that is rarest so far, at a bead drawn from those that
        do.
        """
        reflect, draws = bool(rng.random() < 0.5), rng.random(3)
        if crossings.nx == 0:
            return Symmetry(
                reflect=reflect,
                switch=bool(draws[0] < 0.5),
                reverse=bool(draws[1] < 0.5),
                base_shift=int(draws[2] * beads),
            )
        places = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))
        gaps = [_inside(float(places[k - 1]), float(places[k]), beads) for k in range(len(places))]
        able = [
            option
            for option in _options(crossings.code)
            if gaps[option.gap] and not self._wrong(option.shown, split)
        ]
        if not able:
            return None
        counts = [self._codes[split, option.shown] for option in able]
        rarest = [
            option for option, count in zip(able, counts, strict=True) if count == min(counts)
        ]
        option = rarest[int(draws[0] * len(rarest))]
        base = gaps[option.gap][int(draws[1] * len(gaps[option.gap]))]
        return Symmetry(
            reflect=reflect,
            switch=option.switch,
            reverse=option.reverse,
            base_shift=(-base if option.reverse else base) % beads,
        )

    def _apart(self, points: Array) -> bool:
        """Whether nothing chosen is a near-duplicate; remembers the points if so. As
        `datasets.near.distances`, kept in one array.
        """
        n, beads = len(self.chosen), len(points)
        centred = points - points.mean(axis=0)
        flat, height, square = (
            centred[:, 0] + 1j * centred[:, 1],
            centred[:, 2],
            float((centred**2).sum()),
        )
        if n:
            like = np.flatnonzero(
                np.abs(np.sqrt(self._squares[:n]) - np.sqrt(square)) < NEAR * np.sqrt(beads)
            )
            waves = self._waves[like]
            agreement = np.abs(waves[:, :beads] @ flat.conj()) + waves[:, beads:].real @ height
            if (square + self._squares[like] - 2 * agreement < NEAR**2 * beads).any():
                return False
        if n == len(self._squares):
            self._waves = np.concatenate([self._waves, np.empty_like(self._waves)])
            self._squares = np.concatenate([self._squares, np.empty_like(self._squares)])
        self._waves[n, :beads], self._waves[n, beads:], self._squares[n] = flat, height, square
        return True


def _inside(before: float, after: float, beads: int) -> list[int]:
    """Beads that lie, all of them, at least BASE after one visit and before the next; the gap may
    lie over bead 0.
    """
    if after <= before:
        after += beads
    first, last = int(np.ceil(before + BASE)), int(np.floor(after - 1 - BASE))
    return [bead % beads for bead in range(first, last + 1)]


@lru_cache(maxsize=100_000)
def _options(code: GaussCode) -> tuple[_Option, ...]:
    """Gap k lies just before visit k."""
    out = []
    for gap in range(2 * code.nx):
        forwards = code.plain.rebased(gap)
        for reverse in (False, True):
            walked = forwards.reversed() if reverse else forwards
            out += [
                _Option(gap, reverse, False, walked),
                _Option(gap, reverse, True, walked.mirrored()),
            ]
    return tuple(out)
