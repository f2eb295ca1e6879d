"""Starts of action sequences: the plain loop, a knot's minimal diagram, or a user's curve."""

import warnings
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from knotgym.common.errors import Failed, InvalidFile, InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.drawing.drawn_curve import drawn_curve
from knotgym.quality.measures import Limits, measure
from knotgym.rope.model import Array, Rope
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT, diagram_of, type_of
from knotgym.topology.knots import UNKNOWN, knot_type, shows

# Maximum drawings for a start. All of the 249 prime knots but 10_26 can be placed within _DRAWINGS.
# After _ENOUGH drawings, the most legible one so far is used.
_DRAWINGS, _ENOUGH = 400, 40


class Start(NamedTuple):
    """The state from which action sequences start."""

    knot: str  # name in the knot table, including handedness
    points: Array  # float64 (beads, 3), metres
    code: GaussCode  # its Gauss code with chirality


def start_of(knot: str) -> Start:
    """Return the start for a knot; it doesn't depend on the seed of the run.

    Args:
        knot: a name of the knot table ("8_19", "m3_1", "3_1#4_1"), or a file with a closed curve:
            .npy, or text with three numbers per line.

    Raises:
        InvalidFile, InvalidInput: `knot` is neither in the table nor a file, or the file
            doesn't contain a rope of a known knot.
        Failed: no drawing of the knot could be placed.
    """
    rope = Rope()
    try:
        diagram = diagram_of(knot)
    except InvalidInput as error:
        path = Path(knot)
        if not path.is_file():
            raise InvalidFile(f"{error}; or a file with a closed curve") from error
        points = rope.from_curve(_curve_in(path))
        code = label(points)
        return Start(_name_of(code, path), points, code)
    if type_of(knot) == UNKNOT:
        return Start(UNKNOT, rope.loop(), label(rope.loop()))
    rng = generator(Stream.START, 0)
    tightest: Failed | None = None
    best: tuple[float, Array] | None = None
    for number in range(_DRAWINGS):
        if best is not None and number >= _ENOUGH:
            break
        try:
            points = drawn_curve(diagram, rng, rope)
        except Failed as error:
            tightest = error
            continue
        quality = measure(points, quick=True)
        objective = Limits().objective(quality, diagram.nx)
        best = min(best or (np.inf, points), (objective, points), key=lambda one: one[0])
        if not Limits().faults(quality, diagram.nx):
            break
    if best is None:
        raise Failed(f"no drawing of {knot} can be laid as a rope: {tightest}")
    return Start(knot, best[1], diagram)


def _name_of(code: GaussCode, path: Path) -> str:
    """Return the name in the knot table of the knot that a curve's code shows."""
    kind = knot_type(code)
    if kind == UNKNOWN:
        raise InvalidFile(f"the knot of {path} can't be certified: knots of up to 10 crossings can")
    summands = kind.split("#")
    for hands in product(("", "m"), repeat=len(summands)):
        name = "#".join(map("".join, zip(hands, summands, strict=True)))
        if shows(code, name):
            return name
    raise InvalidFile(f"the handedness of {kind}, the knot of {path}, can't be determined")


def _curve_in(path: Path) -> Array:
    """Read the closed curve in a file, float64 (n, 3)."""
    try:
        with warnings.catch_warnings(action="error"):  # NumPy only warns of a text without numbers
            if path.suffix == ".npy":
                curve = np.load(path, mmap_mode="r", allow_pickle=False)
            else:
                curve = np.loadtxt(path, delimiter="," if path.suffix == ".csv" else None)
    except (ValueError, OSError, EOFError, OverflowError, MemoryError, UserWarning) as error:
        raise InvalidFile(f"{path} holds no curve: {' '.join(str(error).split())}") from error
    if not isinstance(curve, np.ndarray) or curve.dtype.kind not in "fiu":
        raise InvalidFile(f"{path} holds no curve: it isn't one array of real numbers")
    return np.asarray(curve, dtype=np.float64)
