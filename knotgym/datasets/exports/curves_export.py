"""Write the closed curves of states to files, which `knotgym dataset import` reads again.

.csv    lines `curve,x,y,z`, metres
.obj    an object of vertices and one closed line a curve
.npz    an array (beads, 3) a curve
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from knotgym.common.errors import InvalidInput
from knotgym.rope.model import Array


def write_curves(path: str | Path, names: Sequence[str], points: Array) -> None:
    """Write closed curves, float64 (n, beads, 3), in the format of the suffix.

    Raises:
        InvalidInput: the suffix is of no format of curves.
    """
    given = Path(path)
    if given.suffix == ".npz":
        np.savez(given, **dict(zip(names, points, strict=True)))
        return
    lines = ["curve,x,y,z"] if given.suffix == ".csv" else []
    first = 1
    for name, curve in zip(names, points.tolist(), strict=True):
        if given.suffix == ".csv":
            lines += [f"{name},{x!r},{y!r},{z!r}" for x, y, z in curve]
        elif given.suffix == ".obj":
            lines += [f"o {name}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in curve)]
            lines.append("l " + " ".join(map(str, [*range(first, first + len(curve)), first])))
            first += len(curve)
        else:
            raise InvalidInput(f"curves are written to .csv, .obj or .npz, got {given.name!r}")
    given.write_text("\n".join(lines) + "\n", encoding="utf-8")
