"""How near the strands of a drawn rope come without crossing.

After a change run `pytest tests/quality`: measures of states must be those computed plainly.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from knotgym.common import inner

Array = NDArray[Any]


@numba.njit(cache=True, nogil=True)
def strand_spacing(pixels: Array, over: Array, under: Array, walk: float) -> float:
    """Return the smallest distance in the picture, pixels, of vertices on different strands.

    Two vertices are on different strands if every path between them along the drawing, straight on
    or turning at crossings, is longer than `walk` pixels. Near a crossing the strands that cross
    are connected by a short path, and don't count.
    """
    beads = len(pixels)
    along = np.zeros(beads + 1)
    for i in range(beads):
        x, y = pixels[(i + 1) % beads, 0] - pixels[i, 0], pixels[(i + 1) % beads, 1] - pixels[i, 1]
        along[i + 1] = along[i] + np.sqrt(x * x + y * y)
    total = along[beads]
    # a way that turns at crossings reaches j straight from the last of them, so distances with
    # turns are needed from i alone
    to_visit, from_bead = _walks_to_visits(along, over, under)
    nearest = np.inf
    # from cheap to expensive: along the rope, in the picture, then through any crossing
    for i in range(beads):
        for j in range(i + 1, beads):
            gap = along[j] - along[i]
            gap = min(gap, total - gap)
            if gap <= walk:
                continue
            dx, dy = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
            apart = np.sqrt(dx * dx + dy * dy)
            if apart >= nearest:
                continue
            for visit in range(to_visit.shape[1]):
                gap = min(gap, from_bead[i, visit] + to_visit[j, visit])
            if gap > walk:
                nearest = apart
    return nearest


@inner
def _walks_to_visits(along: Array, over: Array, under: Array) -> tuple[Array, Array]:
    """Return the distances from vertices to visits along the drawing, pixels.

    Args:
        along: float64 (beads + 1,), arc length of the drawing at each vertex, and its total.
        over, under: float64 (nx,), positions of the visits along the rope, beads; visits 2k and
            2k + 1 belong to crossing k.

    Returns:
        float64 (beads, 2 nx) twice: straight along the rope, and with turns at crossings.
    """
    beads, visits = len(along) - 1, 2 * len(over)
    total = along[beads]
    at = np.empty(visits)
    for k in range(len(over)):
        for side, place in enumerate((over[k], under[k])):
            # a place may be `beads`, the end of the closing edge
            i = min(int(place), beads - 1)
            at[2 * k + side] = along[i] + (place - i) * (along[i + 1] - along[i])
    # Shortest paths between visits (Floyd-Warshall). The two visits of a crossing are the same
    # point of the picture, at distance 0.
    between = np.empty((visits, visits))
    for a in range(visits):
        for b in range(visits):
            gap = abs(at[a] - at[b])
            between[a, b] = 0.0 if a // 2 == b // 2 else min(gap, total - gap)
    # The loop over the stop between is the outermost: after round m, paths that turn at no visit
    # beyond m are right.
    for m in range(visits):
        for a in range(visits):
            for b in range(visits):
                between[a, b] = min(between[a, b], between[a, m] + between[m, b])
    straight, turning = np.empty((beads, visits)), np.empty((beads, visits))
    for i in range(beads):
        for b in range(visits):
            gap = abs(along[i] - at[b])
            straight[i, b] = min(gap, total - gap)
        for b in range(visits):
            best = np.inf
            for a in range(visits):
                best = min(best, straight[i, a] + between[a, b])
            turning[i, b] = best
    return straight, turning
