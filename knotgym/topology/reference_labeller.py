"""Independent check of a rope's Gauss code with pyknotid.

Only the types for codes and errors are shared with `knotgym.topology.crossings`. Five problems of
pyknotid 0.5.3 are worked around: it needs aliases that NumPy 2 removed (restored only while it
runs, so this isn't thread-safe); it drops crossings whose cross product is below an absolute 1e-5
(the rope is scaled up); it prints to standard output; it writes an empty code as "----"; and it
imports plots that need fontconfig. It still misses a crossing that falls exactly on a bead. Its own
search for crossings is compiled, as its Cython build does, which takes a twentieth of the time.

Source: A. J. Taylor, "pyknotid knot identification toolkit", https://github.com/SPOCKnots/pyknotid
"""

import io
import sys
from contextlib import redirect_stdout
from functools import cache
from types import ModuleType
from typing import Any
from unittest import mock

import numba
import numpy as np
from numpy.typing import ArrayLike

from knotgym.common import InvalidInput
from knotgym.topology.gauss import GaussCode

_ALIASES: dict[str, Any] = {"float": float, "int": int, "complex": complex}
_BEAD = 10.0  # mean distance of beads after scaling; pyknotid makes mistakes below 0.1
_EXPECTED = "expected (beads, 3) finite numbers, at least 3 beads, for pyknotid"


def pyknotid_code(points: ArrayLike) -> GaussCode:
    """Read the Gauss code of a closed rope with pyknotid, with chirality, seen from +z.

    Args:
        points: (beads, 3), metres; the last bead is joined to the first.

    Raises:
        InvalidInput: the shape is wrong, a number isn't finite, or all beads coincide.
    """
    rope = np.asarray(points, dtype=np.float64)
    if rope.ndim != 2 or rope.shape[1] != 3 or len(rope) < 3:
        raise InvalidInput(f"no closed rope: the array has shape {rope.shape}; {_EXPECTED}")
    # the mean bead as the unit of length: pyknotid's thresholds are absolute
    bead = float(np.linalg.norm(np.roll(rope, -1, axis=0) - rope, axis=1).mean())
    if not np.isfinite(bead) or bead == 0.0:
        raise InvalidInput(f"no closed rope: the mean distance of beads is {bead}; {_EXPECTED}")
    scaled = (rope - rope.mean(axis=0)) * (_BEAD / bead)
    # lent while it runs: names that NumPy removed
    with mock.patch.multiple(np, create=True, **_ALIASES), redirect_stdout(io.StringIO()):
        text = str(_space_curve()(scaled, verbose=False).gauss_code(include_closure=True))
    return GaussCode.parse("" if text.startswith("----") else text)


@cache
def _space_curve() -> Any:
    """Return pyknotid's class, whose functions that find crossings are compiled."""
    # pyknotid imports its plots, too, whose libraries need fontconfig: a bare machine has none
    plots: Any = ModuleType("pyknotid.visualise")
    plots.__getattr__ = lambda name: None
    sys.modules[plots.__name__] = plots
    try:
        from pyknotid.spacecurves import SpaceCurve, helpers
    finally:
        del sys.modules[plots.__name__]
    # in the order in which they call each other, so that each finds compiled what it calls
    for name in ("cross_product", "sign", "do_vectors_intersect", "find_crossings"):
        setattr(helpers, name, numba.njit(cache=True)(getattr(helpers, name)))
    return SpaceCurve
