"""Rows of pictures of given ropes, without a run that finds the ropes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets import PictureRow

_ORIGIN = {
    **dict.fromkeys(("start", "rope", "pulls", "base_shift", "seed", "row"), 0),
    **dict.fromkeys(("reflect", "switch", "reverse"), False),
    "policy": "random",
}


def picture_rows(
    ropes: Sequence[NDArray[np.float64]],
    split: str = "train",
    cameras: Sequence[tuple[float, float]] | None = None,
) -> list[PictureRow]:
    """Return a row for each rope, float64 (beads, 3), which is said to be one of its own."""
    cameras = cameras or [(0.0, 0.0)] * len(ropes)
    return [
        PictureRow(points, split, {**_ORIGIN, "rope": number, "row": number}, camera)
        for number, (points, camera) in enumerate(zip(ropes, cameras, strict=True))
    ]
