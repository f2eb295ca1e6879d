"""Choose frames for pictures, with a symmetry for each.

Codes are balanced. No two pictures are near-duplicates up to rotation, and none of different splits
up to any symmetry of the rope.

A frame may be reflected, switched (over and under exchanged), reversed and renumbered from any
bead; all of these are exact for a picture. So a frame with n crossings can show up to 8n codes
without chirality; it is made to show the code that is rarest in its split so far. The choice
depends only on the frames and their order.
"""

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from knotgym.common.configuration import Share, configuration
from knotgym.quality.difficulty import grade_of
from knotgym.quality.label_limits import LabelLimits, at_base
from knotgym.rope.model import Array
from knotgym.states.near_duplicates import NEAR, Spectra
from knotgym.topology.crossings import Crossings, find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry

_BLOCK = 2048  # initial capacity for the spectra of chosen configurations


@configuration
class SelectionConfig:
    """Settings of the selection.

    Attributes:
        extreme: maximum share of each quota with grade "extreme", without the base bead (see
            `difficulty`).
    """

    extreme: Share = 0.3


class ChosenFrame(NamedTuple):
    """A chosen frame."""

    points: Array  # float64 (beads, 3), metres, the configuration to store
    code: GaussCode  # its Gauss code with chirality
    split: str  # one of IMAGE_SPLITS
    symmetry: Symmetry  # transformation from the frame to `points`
    frame: int  # index among all frames


@dataclass(frozen=True)
class _Option:
    """The code `shown` if it is read from gap `gap` between two visits, with these symmetries."""

    gap: int
    reverse: bool
    switch: bool
    shown: GaussCode


class Chooser:
    """Fills quotas, frame by frame: `quota` (split, nx) -> requested pictures.

    `chosen` has the chosen frames so far, `refused` reason -> number of refused frames.
    """

    def __init__(
        self,
        quota: dict[tuple[str, int], int],
        held_out: frozenset[GaussCode],
        beads: int,
        config: SelectionConfig,
        limits: LabelLimits,
    ) -> None:
        """Start without chosen frames.

        `held_out` are the codes, without chirality, allowed only in split "test-code".
        """
        self.quota, self.chosen, self.refused = quota, list[ChosenFrame](), Counter[str]()
        self._held_out, self._config, self._limits = held_out, config, limits
        self._have = Counter[tuple[str, int]]()
        self._extreme = Counter[tuple[str, int]]()
        self._codes = Counter[tuple[str, GaussCode]]()
        waves = np.empty((_BLOCK, beads), dtype=np.complex128)
        self._known = Spectra(waves, waves.copy(), np.empty(_BLOCK))  # as many rows as are chosen

    def lacking(self) -> dict[tuple[str, int], int]:
        """Return (split, nx) -> missing pictures, without full quotas."""
        return {
            key: quota - self._have[key]
            for key, quota in self.quota.items()
            if quota > self._have[key]
        }

    def consider(
        self, points: Array, split: str, ease: float, frame: int, rng: np.random.Generator
    ) -> bool:
        """Choose or refuse a frame (beads, 3) of a family in `split`; return True if chosen."""
        # Cheap refusals come first; the comparison with all chosen frames is the last.
        crossings = find_crossings(points)
        key = split, crossings.nx
        if self.quota.get(key, 0) <= self._have[key]:
            return self._refuse("quota full")
        is_extreme = grade_of(ease) == "extreme"
        if is_extreme and self._extreme[key] >= self._config.extreme * self.quota[key]:
            return self._refuse("extreme enough")
        # The generator is the frame's own, so a refused frame doesn't change the draws of others.
        symmetry = self._symmetry(crossings, len(points), split, rng)
        if symmetry is None:
            return self._refuse("no code wanted")
        moved = symmetry.configuration(points)
        shown = find_crossings(moved)
        if at_base(shown, len(moved), self._limits):
            return self._refuse("crossing at the base bead")
        if self._wrong(shown.code, split):  # rounding moved a crossing over a bead
            return self._refuse("code changed")
        if not self._apart(moved, split):
            return self._refuse("near-duplicate")
        self._have[key] += 1
        self._extreme[key] += is_extreme
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
        """Return the symmetry that shows the rarest code so far, with a random base bead."""
        # always the same draws, whether they are used or not
        reflect, draws = bool(rng.random() < 0.5), rng.random(3)
        if crossings.nx == 0:
            return Symmetry(
                reflect=reflect,
                switch=bool(draws[0] < 0.5),
                reverse=bool(draws[1] < 0.5),
                base_shift=int(draws[2] * beads),
            )
        # A base bead lies in the gap between two visits. Gap k is the one before visit k of the
        # walk; gap 0 closes the rope.
        places = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))
        gaps = [
            _inside(before, after, beads, self._limits.base)
            for before, after in zip(np.roll(places, 1).tolist(), places.tolist(), strict=True)
        ]
        able = [
            option
            for option in _options(crossings.code)
            if gaps[option.gap] and not self._wrong(option.shown, split)
        ]
        if not able:
            return None
        # ties between rarest codes, and the bead within the gap, are drawn
        fewest = min(self._codes[split, option.shown] for option in able)
        rarest = [option for option in able if self._codes[split, option.shown] == fewest]
        option = rarest[int(draws[0] * len(rarest))]
        base = gaps[option.gap][int(draws[1] * len(gaps[option.gap]))]
        return Symmetry(
            reflect=reflect,
            switch=option.switch,
            reverse=option.reverse,
            base_shift=(-base if option.reverse else base) % beads,
        )

    def _apart(self, points: Array, split: str) -> bool:
        """Whether no chosen frame is a near-duplicate; if so, remember the points."""
        n, own = len(self.chosen), Spectra.of(points[None])
        # root mean square sizes of near-duplicates differ by less than NEAR
        larger = np.abs(np.sqrt(self._known.square[:n]) - np.sqrt(own.square))
        like = np.flatnonzero(larger < NEAR * np.sqrt(len(points)))
        # within a split only the same shape as it lies counts, across splits any symmetric one
        if (own.turned_distances(self._known.taken(like)) < NEAR).any():
            return False
        elsewhere = [row for row in like.tolist() if self.chosen[row].split != split]
        others = self._known.taken(np.array(elsewhere, dtype=np.int64))
        close = others.taken(np.flatnonzero(own.least_distances(others)[0] < NEAR))
        if (own.taken(np.zeros(len(close.flat), np.int64)).pair_distances(close) < NEAR).any():
            return False
        if n == len(self._known.square):
            # full: double the capacity
            self._known = Spectra(*(np.concatenate([a, np.empty_like(a)]) for a in self._known))
        for known, new in zip(self._known, own, strict=True):
            known[n] = new[0]
        return True


def _inside(before: float, after: float, beads: int, base: float) -> list[int]:
    """Return the beads between two visits with a distance of at least `base` to both.

    The gap may include bead 0.
    """
    if after <= before:
        after += beads
    first, last = int(np.ceil(before + base)), int(np.floor(after - 1 - base))
    return [bead % beads for bead in range(first, last + 1)]


@lru_cache(maxsize=100_000)
def _options(code: GaussCode) -> tuple[_Option, ...]:
    """List the codes that symmetries can make of a diagram; gap k is just before visit k."""
    options = []
    for gap in range(2 * code.nx):
        forwards = code.plain.rebased(gap)
        for reverse in (False, True):
            walked = forwards.reversed() if reverse else forwards
            options.append(_Option(gap, reverse, False, walked))
            options.append(_Option(gap, reverse, True, walked.mirrored()))
    return tuple(options)
