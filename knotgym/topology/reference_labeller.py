"""An independent second opinion on a rope's Gauss code: pyknotid's.

Nothing here shares code with knotgym.topology.crossings beyond the value type. Four traps of
pyknotid 0.5.3 are minded: it needs aliases that NumPy 2 no longer has (lent to it only while it
runs, so not for several threads at once), it drops crossings whose cross product is under an
absolute 1e-5 (the rope is scaled up), it writes to standard output, and an empty code reads "----".
A crossing that falls exactly on a bead remains lost to it.

Source: A. J. Taylor, "pyknotid knot identification toolkit", https://github.com/SPOCKnots/pyknotid
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from knotgym.common.errors import KnotgymError
from knotgym.topology.gauss import GaussCode

_ALIASES: dict[str, type] = {"float": float, "int": int, "complex": complex}
_BEAD = 10.0  # length to which the mean bead is scaled; pyknotid goes wrong under 0.1


class UnreadableCurve(KnotgymError, ValueError):
    """pyknotid cannot be asked about these points."""

    def __init__(self, problem: str) -> None:
        super().__init__(
            f"no curve for pyknotid: {problem}; right would be (beads, 3) finite numbers, at least"
            " 3 beads"
        )


def pyknotid_code(points: ArrayLike) -> GaussCode:
    """Ask pyknotid for the Gauss code of a closed rope, with chirality, seen from +z.

    Args:
        points: (beads, 3), metres; the last bead is joined to the first.

    Raises:
        UnreadableCurve: another shape, not finite, or all beads at one place.
    """
    rope = np.asarray(points, dtype=np.float64)
    if rope.ndim != 2 or rope.shape[1] != 3 or len(rope) < 3:
        raise UnreadableCurve(f"the array has shape {rope.shape}")
    bead = float(np.linalg.norm(np.roll(rope, -1, axis=0) - rope, axis=1).mean())
    if not np.isfinite(bead) or bead == 0.0:
        raise UnreadableCurve(f"the mean bead is {bead} long")
    scaled = (rope - rope.mean(axis=0)) * (_BEAD / bead)
    with _lent_aliases(), contextlib.redirect_stdout(io.StringIO()):
        from pyknotid.spacecurves import SpaceCurve

        text = str(SpaceCurve(scaled, verbose=False).gauss_code(include_closure=True))
    return GaussCode.parse("" if text.startswith("----") else text)


@contextlib.contextmanager
def _lent_aliases() -> Iterator[None]:
    """Give NumPy the names that pyknotid looks for, and take them away again."""
    missing = [name for name in _ALIASES if name not in vars(np)]
    for name in missing:
        setattr(np, name, _ALIASES[name])
    try:
        yield
    finally:
        for name in missing:
            delattr(np, name)
