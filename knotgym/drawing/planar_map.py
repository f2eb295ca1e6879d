"""The planar map of a Gauss code, triangulated for circle packing.

The nodes are the crossings and CUTS points on every edge (the strand between two visits). Inside
every face there is a ring of nodes, one for each node on the walk around the face, and a centre
node. The ring keeps the triangulation simple, without loops or double edges, also for faces with
one or two sides and for faces that meet a crossing twice.

After a change run `pytest tests/drawing`: every map must be a triangulated disc that packs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.topology import GaussCode, faces

CUTS = 3  # nodes inside an edge; two are enough for a simple triangulation

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PlanarMap:
    """The triangulated planar map of a code; crossing k is node k - 1.

    Attributes:
        walk: int64 (2 nx (CUTS + 1),), nodes along the rope from visit 0; each crossing occurs
            twice.
        left, right: int64 (2 nx,), the faces on either side of each edge.
        triangles: int64 (t, 3), nodes counterclockwise; the outer face has no centre node.
        rim: int64, the ring of the outer face, clockwise as seen from inside.
        nodes: number of nodes.
    """

    walk: Integers
    left: Integers
    right: Integers
    triangles: Integers
    rim: Integers
    nodes: int


def planar_map(code: GaussCode, outer: int) -> PlanarMap:
    """Triangulate the planar map of a code.

    Args:
        code: a planar code with chirality and at least one crossing.
        outer: index in `faces(code)` of the outer face.
    """
    edges, nx = 2 * code.nx, code.nx
    step = CUTS + 1
    walk = np.empty(edges * step, dtype=np.int64)
    walk[::step] = np.abs(code.visits) - 1
    for cut in range(CUTS):
        walk[cut + 1 :: step] = nx + CUTS * np.arange(edges) + cut
    walks = faces(code)
    side = np.empty(2 * edges, dtype=np.int64)  # the face on the left of each dart
    nodes, triangles, rim = nx + CUTS * edges, [], np.empty(0, dtype=np.int64)
    for number, darts in enumerate(walks):
        side[darts] = number
        border = np.concatenate([_nodes_of(dart, walk, step) for dart in darts])
        ring = nodes + np.arange(len(border))
        after, ring_after = np.roll(border, -1), np.roll(ring, -1)
        # a strip of two triangles per border node between the border and the ring
        #   ring   ring_after        the face is on the left of the border,
        #   border after             so both rows run counterclockwise around it
        triangles += [
            np.stack([border, after, ring], axis=1),
            np.stack([after, ring_after, ring], axis=1),
        ]
        nodes += len(ring)
        # every other face is closed by a fan around a centre node
        if number == outer:
            rim = ring
        else:
            triangles.append(np.stack([ring, ring_after, np.full(len(ring), nodes)], axis=1))
            nodes += 1
    return PlanarMap(walk, side[0::2], side[1::2], np.concatenate(triangles), rim, nodes)


def _nodes_of(dart: int, walk: Integers, step: int) -> Integers:
    """Return the nodes along a dart, without the one at its end."""
    edge, back = divmod(dart, 2)
    along = np.take(walk, np.arange(edge * step, (edge + 1) * step + 1), mode="wrap")
    return along[:0:-1] if back else along[:-1]
