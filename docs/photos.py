"""Draw the contact sheet of photos, 64 of 1 to 6 crossings.

    python docs/photos.py [FOLDER]

With a folder, the single pictures are written into it, and what they show into codes.json beside
it, for a test of readers who see only pictures.
"""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from knotgym.common import Failed
from knotgym.drawing import drawn_curve
from knotgym.photos import photograph
from knotgym.states import read_states, shipped
from knotgym.topology import Symmetry, canonical, pd_text, uniform_code

PAGES = Path(__file__).parent
_SIDE, _GAP, _ACROSS = 152, 2, 8  # pixels of a tile and between tiles; tiles


def shots(seed: int = 3, size: int = 256) -> list[Any]:
    """Return 64 photos, 10 or 11 of each number of crossings from 1 to 6.

    States have up to five crossings; ropes of six are drawn from random codes.
    """
    rng, states = np.random.default_rng(seed), read_states(shipped("bench"), images=False)
    found: list[Any] = []
    while len(found) < _ACROSS**2:
        wanted = 1 + len(found) % 6
        if wanted < 6:
            points = states.points[rng.choice(np.flatnonzero(states.nx == wanted))]
        else:
            try:
                points = drawn_curve(uniform_code(6, rng), rng)
            except Failed:
                continue
        shot = photograph(points, size, rng)
        if shot is not None and shot.crossings.nx == wanted:
            found.append(shot)
    return found


if __name__ == "__main__":
    made = shots()
    sheet = np.full([_ACROSS * (_SIDE + _GAP) - _GAP] * 2 + [3], 255, np.uint8)
    for number, shot in enumerate(made):
        row, column = (_SIDE + _GAP) * np.array(divmod(number, _ACROSS))
        tile = cv2.resize(shot.image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
        sheet[row : row + _SIDE, column : column + _SIDE] = tile
    cv2.imwrite(str(PAGES / "photos.jpg"), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    if len(sys.argv) > 1:
        folder = Path(sys.argv[1])
        folder.mkdir(parents=True, exist_ok=True)
        codes = dict[str, dict[str, str]]()
        for number, shot in enumerate(made):
            cv2.imwrite(str(folder / f"{number:03d}.png"), shot.image[..., ::-1])
            code = shot.crossings.code
            names = {
                "pd_code": pd_text(code),
                "canonical_code": str(canonical(code, Symmetry.DIAGRAM)),
            }
            codes[f"{number:03d}"] = {"gauss_code": code.chiral, **names}
        (folder.parent / f"{folder.name}-codes.json").write_text(json.dumps(codes, indent=1))
