"""Write the closed curves of states to files, which `knotgym dataset import` reads again.

.csv    lines `curve,x,y,z`, metres
.obj    an object of vertices and one closed line a curve
.npz    an array (beads, 3) a curve
"""

from pathlib import Path

import numpy as np

from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.common.errors import InvalidInput
from knotgym.datasets.located import Located
from knotgym.rope.model import Array
from knotgym.states.state_file import read_states


def to_curves(source: Located, out: Path, overwrite: bool) -> str:
    """Write the curves of states atomically, and return a one-line summary.

    Raises:
        InvalidInput: the source holds no states, or as `write_curves`.
        Occupied: `out` exists, and `overwrite` is False.
    """
    if source.states is None:
        raise InvalidInput(f"{source.title} holds no states, whose curves could be exported")
    points = read_states(source.states, images=False).points
    require_output(out, folder=False, overwrite=overwrite)
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_curves(temporary, points)
    return f"{len(points)} curves"


def write_curves(path: Path, points: Array) -> None:
    """Write closed curves, float64 (n, beads, 3), in the format of the suffix.

    Raises:
        InvalidInput: the suffix is of no format of curves.
    """
    curves = {f"state{row}": curve for row, curve in enumerate(points)}
    if path.suffix == ".npz":
        np.savez(path, **curves)
        return
    lines = ["curve,x,y,z"] if path.suffix == ".csv" else []
    first = 1  # vertices are counted over the whole file
    for name, curve in curves.items():
        if path.suffix == ".csv":
            lines += [f"{name},{x!r},{y!r},{z!r}" for x, y, z in curve.tolist()]
        elif path.suffix == ".obj":
            lines += [f"o {name}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in curve.tolist())]
            lines.append("l " + " ".join(map(str, [*range(first, first + len(curve)), first])))
            first += len(curve)
        else:
            raise InvalidInput(f"curves are written to .csv, .obj or .npz, got {path.name!r}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
