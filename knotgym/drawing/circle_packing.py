"""Circle packing: a circle for every node of a triangulated disc, tangent where nodes are joined.

The radii are found by the iteration of C. Collins and K. Stephenson, "A circle packing algorithm"
(Computational Geometry 25, 2003): a circle grows or shrinks until its neighbours just surround it.
Lines between the middles of tangent circles then draw the triangulation without crossing.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_SWEEPS = 4000
_CLOSED = 1e-7  # radians by which neighbours may miss a full turn


def packed(triangles: Integers, rim: Integers, nodes: int) -> Array:
    """The middles of the circles, float64 (nodes, 2); those on the rim are all of one size.

    Args:
        triangles: int64 (t, 3), anticlockwise, of a disc.
        rim: its border nodes.
        nodes: how many there are.
    """
    first, petals = _flowers(triangles, nodes)
    inner = np.ones(nodes, dtype=np.bool_)
    inner[rim] = False
    return _laid_out(_radii(first, petals, inner), first, petals, inner, int(triangles[-1, 0]))


def _flowers(triangles: Integers, nodes: int) -> tuple[Integers, Integers]:
    """Each node's neighbours in anticlockwise order: those of node v are petals[first[v] :
    first[v + 1]].
    """
    onwards: list[dict[int, int]] = [{} for _ in range(nodes)]
    for a, b, c in triangles.tolist():
        onwards[a][b], onwards[b][c], onwards[c][a] = c, a, b
    petals: list[int] = []
    first = np.zeros(nodes + 1, dtype=np.int64)
    for node, after in enumerate(onwards):
        # a rim node's fan has a beginning, any other's is a cycle
        start = next(iter(after.keys() - after.values()), next(iter(after)))
        petal = start
        while True:
            petals.append(petal)
            if petal not in after or after[petal] == start:
                break
            petal = after[petal]
        first[node + 1] = len(petals)
    return first, np.array(petals, dtype=np.int64)


@numba.njit(cache=True, nogil=True)
def _radii(first: Integers, petals: Integers, inner: NDArray[np.bool_]) -> Array:
    nodes = len(inner)
    radii = np.ones(nodes)
    for _ in range(_SWEEPS):
        worst = 0.0
        for node in range(nodes):
            if not inner[node]:
                continue
            count, own, turn = first[node + 1] - first[node], radii[node], 0.0
            before = radii[petals[first[node + 1] - 1]]
            for k in range(first[node], first[node + 1]):
                after = radii[petals[k]]
                turn += 2 * np.arcsin(np.sqrt(before / (own + before) * after / (own + after)))
                before = after
            worst = max(worst, abs(turn - 2 * np.pi))
            # neighbours all of one size would make this turn, and leave that radius to fill one
            beta, delta = np.sin(turn / (2 * count)), np.sin(np.pi / count)
            radii[node] = beta / (1 - beta) * own * (1 - delta) / delta
        if worst < _CLOSED:
            break
    return radii


@numba.njit(cache=True, nogil=True)
def _laid_out(
    radii: Array, first: Integers, petals: Integers, inner: NDArray[np.bool_], start: int
) -> Array:
    """The middles, laid out from an inner node: around each that lies, its neighbours."""
    nodes = len(radii)
    at = np.zeros((nodes, 2))
    lies = np.zeros(nodes, dtype=np.bool_)
    queue = np.empty(nodes, dtype=np.int64)
    lies[start], queue[0], done, known = True, start, 0, 1
    at[petals[first[start]], 0] = radii[start] + radii[petals[first[start]]]
    lies[petals[first[start]]] = True
    queue[known] = petals[first[start]]
    known += 1
    while done < known:
        node = queue[done]
        done += 1
        if not inner[node]:
            continue
        begin, count = first[node], first[node + 1] - first[node]
        known_petal = 0
        while not lies[petals[begin + known_petal]]:
            known_petal += 1
        own, before = radii[node], petals[begin + known_petal]
        angle = np.arctan2(at[before, 1] - at[node, 1], at[before, 0] - at[node, 0])
        for k in range(1, count):
            petal = petals[begin + (known_petal + k) % count]
            one, two = radii[before], radii[petal]
            angle += 2 * np.arcsin(np.sqrt(one / (own + one) * two / (own + two)))
            if not lies[petal]:
                lies[petal] = True
                at[petal, 0] = at[node, 0] + (own + two) * np.cos(angle)
                at[petal, 1] = at[node, 1] + (own + two) * np.sin(angle)
                queue[known] = petal
                known += 1
            before = petal
    return at
