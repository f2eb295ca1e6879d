"""Choose frames for pictures: quotas are filled, codes balanced, and near-duplicates refused.

Of the codes that a frame can show, the one is taken that is rarest in its split so far. The choice
depends only on the frames and their order.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from knotgym.generate.images.frames import symmetry_of
from knotgym.generate.images.images_config import ImagesConfig
from knotgym.quality import grade_of
from knotgym.rope import Array
from knotgym.runs import Result
from knotgym.states import NEAR, Spectra, held_form

Quota = tuple[str, int]  # split and nx


class Chosen(NamedTuple):
    """A configuration to be shown.

    Attributes:
        points: float64 (beads, 3), metres.
        split: one of IMAGE_SPLITS.
        source: rope, pulls, and the symmetry that was applied to the frame.
        camera: tilt and heading of the camera in whose axes they were before that, degrees.
    """

    points: Array
    split: str
    source: dict[str, Any]
    camera: tuple[float, float]


class Chooser:
    """Fills quotas, frame by frame.

    Attributes:
        chosen: what was chosen so far.
        refused: reason -> number of refused frames.
    """

    def __init__(
        self, quota: Mapping[Quota, int], held_out: frozenset[str], config: ImagesConfig
    ) -> None:
        """Begin without any frame.

        Args:
            quota: (split, nx) -> number of pictures.
            held_out: codes, as `held_form` gives them, that only splits test-code and test-nx may
                show.
            config: of the pictures.
        """
        self.chosen, self.refused = list[Chosen](), Counter[str]()
        self._quota, self._held_out, self._config = quota, held_out, config
        self._forms = dict[str, str]()  # code -> its `held_form`
        self._have, self._hardest = Counter[Quota](), Counter[Quota]()
        self._codes = Counter[tuple[str, str]]()
        self._known: Spectra | None = None  # of the chosen, in arrays with room for more

    def lacking(self) -> dict[Quota, int]:
        """Return (split, nx) -> missing pictures, without full quotas."""
        return {
            key: quota - self._have[key]
            for key, quota in self._quota.items()
            if quota > self._have[key]
        }

    def consider(self, frames: Result, row: int, split: str) -> bool:
        """Choose or refuse a frame; return whether it is chosen.

        Args:
            frames: as `frames.frames_of` returns them.
            row: which of them.
            split: that its rope is of.
        """
        key = split, int(frames["nx"][row])
        if self._quota.get(key, 0) <= self._have[key]:
            return self._refuse("quota full")
        is_extreme = grade_of(float(frames["ease"][row])) == "extreme"
        if is_extreme and self._hardest[key] >= self._config.extreme * self._quota[key]:
            return self._refuse("extreme enough")
        able = [
            (self._codes[split, code], index, code)
            for index, code in enumerate(frames["codes"][row].tolist())
            if code != "-" and self._may_show(code, split)
        ]
        if not able:
            return self._refuse("no code wanted")
        _, index, code = min(able)
        symmetry = symmetry_of(frames["symmetries"][row, index])
        points = symmetry.vertices(frames["points"][row])
        if not self._is_new(points, split):
            return self._refuse("near-duplicate")
        self._have[key] += 1
        self._hardest[key] += is_extreme
        self._codes[split, code] += 1
        names = ("switch", "reverse", "base_shift")
        source = {
            "rope": int(frames["rope"][row]),
            "pulls": int(frames["pulls"][row]),
            "reflect": symmetry.reflect,
            **{name: getattr(symmetry, name) for name in names},
        }
        tilt, heading = frames["camera"][row].tolist()
        self.chosen.append(Chosen(points, split, source, (tilt, heading)))
        return True

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False

    def _may_show(self, code: str, split: str) -> bool:
        if split == "test-nx":
            return True
        if code not in self._forms:
            self._forms[code] = held_form(code, marked=self._config.marked)
        return (self._forms[code] in self._held_out) == (split == "test-code")

    def _is_new(self, points: Array, split: str) -> bool:
        """Whether no chosen configuration is a near-duplicate; if so, remember the points.

        Within a split only the same shape as it lies counts, across splits any symmetric one.
        """
        n, own = len(self.chosen), Spectra.of(points[None])
        known = self._known
        if known is None or n == len(known.square):  # full: double the room
            room = [np.zeros((max(2048, 2 * n), *one.shape[1:]), one.dtype) for one in own]
            for new, old in zip(room, known or (), strict=False):
                new[:n] = old
            known = self._known = Spectra(*room)
        like = np.flatnonzero(np.linalg.norm(known.invariants[:n] - own.invariants, axis=1) < NEAR)
        if (own.turned_distances(known.take(like)) < NEAR).any():
            return False
        others = like[[self.chosen[row].split != split for row in like.tolist()]]
        same = own.take(np.zeros(len(others), np.int64))
        if (same.pair_distances(known.take(others)) < NEAR).any():
            return False
        for column, new in zip(known, own, strict=True):
            column[n] = new[0]
        return True
