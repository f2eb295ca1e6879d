"""The planar map of a Gauss code, triangulated so that circles can be packed on it.

Crossings are nodes, and so are CUTS places on every edge (the strand between two visits). Inside
every face lies a ring of nodes, one for each node on the walk round the face, and a middle one. A
kink's eye, a two-sided face, or a face that comes by one crossing twice are then no trouble: no two
nodes are joined twice, none to itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.topology.diagrams import faces
from knotgym.topology.gauss import GaussCode

CUTS = 3  # nodes inside an edge; two would do for a triangulation

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PlanarMap:
    """A code's map on the sphere, and its triangulation.

    Attributes:
        walk: nodes along the rope from visit 0, int64 (2 nx (CUTS + 1),); crossings come twice.
        left, right: face on either side of each edge, int64 (2 nx,).
        sizes: edges round each face, int64 (nx + 2,).
        triangles: int64 (t, 3), anticlockwise; those with the middle of the outer face left out.
        rim: the outer face's ring, clockwise as seen from inside, int64.
        nodes: how many there are.
    """

    walk: Integers
    left: Integers
    right: Integers
    sizes: Integers
    triangles: Integers
    rim: Integers
    nodes: int


def planar_map(code: GaussCode, outer: int) -> PlanarMap:
    """The map of a code with chirality and a crossing at least.

    Args:
        code: that can be drawn.
        outer: which of `faces(code)` lies outside.
    """
    edges, nx = 2 * code.nx, code.nx
    step = CUTS + 1
    walk = np.empty(edges * step, dtype=np.int64)
    walk[::step] = np.abs(code.visits) - 1
    for cut in range(CUTS):
        walk[cut + 1 :: step] = nx + CUTS * np.arange(edges) + cut
    walks = faces(code)
    side = np.empty(2 * edges, dtype=np.int64)
    nodes, triangles, rim = nx + CUTS * edges, [], np.empty(0, dtype=np.int64)
    for number, darts in enumerate(walks):
        side[darts] = number
        border = np.concatenate([_nodes_of(dart, walk, step) for dart in darts])
        ring = nodes + np.arange(len(border))
        after, ring_after = np.roll(border, -1), np.roll(ring, -1)
        triangles += [
            np.stack([border, after, ring], axis=1),
            np.stack([after, ring_after, ring], axis=1),
        ]
        nodes += len(ring)
        if number == outer:
            rim = ring
        else:
            triangles.append(np.stack([ring, ring_after, np.full(len(ring), nodes)], axis=1))
            nodes += 1
    return PlanarMap(
        walk,
        side[0::2],
        side[1::2],
        np.array([len(darts) for darts in walks]),
        np.concatenate(triangles),
        rim,
        nodes,
    )


def _nodes_of(dart: int, walk: Integers, step: int) -> Integers:
    """The nodes along a dart, its end left out."""
    edge, back = divmod(dart, 2)
    along = np.take(walk, np.arange(edge * step, (edge + 1) * step + 1), mode="wrap")
    return along[:0:-1] if back else along[:-1]
