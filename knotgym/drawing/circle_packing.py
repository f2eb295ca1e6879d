"""Circle packing: one circle per node of a triangulated disc, tangent where nodes are joined.

The radii are computed by the uniform-neighbour iteration of C. Collins and K. Stephenson, "A circle
packing algorithm" (Computational Geometry 25, 2003): each circle grows or shrinks until the circles
around it just close up. Straight lines between the centres of tangent circles then draw the
triangulation without crossings.

What is packed is the triangulated planar map of a Gauss code. Its nodes are the crossings and CUTS
points on every edge (the strand between two visits). Inside every face there is a ring of nodes,
one for each node on the walk around the face, and a centre node. The ring keeps the triangulation
simple, without loops or double edges, also for faces with one or two sides and for faces that meet
a crossing twice.

A drawing follows from its seed to the last bit, and mathematics libraries round sines and angles
each in its own way, one and the same library otherwise on a processor that multiplies and adds at
once. Sums, products, quotients and square roots are the same everywhere, so `sin_cos` and
`_angle_of` consist of them; they round alike everywhere, to 1e-15.

After a change run `pytest tests/drawing`: every map must be a triangulated disc, and packed circles
draw it without folds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, inner, kernel
from knotgym.topology import GaussCode, faces

CUTS = 3  # nodes inside an edge; two are enough for a simple triangulation
# Random codes of 6 crossings need up to 480 sweeps, of 10 up to 1,550. Relaxation moves every node
# afterwards, so what centres need is no fold.
_MAX_SWEEPS = 4000
_TOLERANCE = 1e-7  # allowed deviation of an angle sum from 2 pi, radians
# pi / 2 as a sum of two floats; multiples of the first by small integers are exact
_QUARTER = 1.5707963267341256, 6.077100506506192e-11


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

    walk: Ids
    left: Ids
    right: Ids
    triangles: Ids
    rim: Ids
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


def _nodes_of(dart: int, walk: Ids, step: int) -> Ids:
    """Return the nodes along a dart, without the one at its end."""
    edge, back = divmod(dart, 2)
    along = np.take(walk, np.arange(edge * step, (edge + 1) * step + 1), mode="wrap")
    return along[:0:-1] if back else along[:-1]


def pack_circles(triangles: Ids, rim: Ids, nodes: int) -> Array:
    """Return the centres of the circles, float64 (nodes, 2); circles on the rim have radius 1.

    Args:
        triangles: int64 (t, 3), nodes of each triangle of the disc, counterclockwise.
        rim: int64, the nodes on the border of the disc.
        nodes: number of nodes.
    """
    first, petals = _flowers(triangles, nodes)
    inner = np.ones(nodes, dtype=np.bool_)
    inner[rim] = False
    return _laid_out(_radii(first, petals, inner), first, petals, inner, int(triangles[-1, 0]))


def _flowers(triangles: Ids, nodes: int) -> tuple[Ids, Ids]:
    """List the neighbours ("petals") of each node counterclockwise.

    Returns:
        first: int64 (nodes + 1,); the neighbours of node v are petals[first[v] : first[v + 1]].
        petals: int64.
    """
    # per node: neighbour -> the next neighbour counterclockwise
    onwards: list[dict[int, int]] = [{} for _ in range(nodes)]
    for a, b, c in triangles.tolist():
        onwards[a][b], onwards[b][c], onwards[c][a] = c, a, b
    petals: list[int] = []
    first = np.zeros(nodes + 1, dtype=np.int64)
    for node, after in enumerate(onwards):
        # The neighbours of a rim node form a chain, which starts at the one that follows none;
        # those of an inner node form a cycle.
        start = next(iter(after.keys() - after.values()), next(iter(after)))
        petal = start
        while True:
            petals.append(petal)
            if petal not in after or after[petal] == start:
                break
            petal = after[petal]
        first[node + 1] = len(petals)
    return first, np.array(petals, dtype=np.int64)


@inner
def _between(one: float, own: float, other: float) -> float:
    """Return the angle at a circle of radius `own` between two that touch it and each other."""
    # by the law of cosines, sin^2(angle / 2) = a / (r + a) * b / (r + b)
    square = one / (own + one) * other / (own + other)
    return float(2 * _angle_of(np.sqrt(1 - square), np.sqrt(square)))


@kernel
def _radii(first: Ids, petals: Ids, inner: NDArray[np.bool_]) -> Array:
    """Compute the radii, float64 (nodes,), for which the angles at each inner node sum to 2 pi."""
    nodes = len(inner)
    radii = np.ones(nodes)
    for _ in range(_MAX_SWEEPS):
        worst = 0.0
        for node in range(nodes):
            if not inner[node]:
                continue
            count, radius, turn = first[node + 1] - first[node], radii[node], 0.0
            before = radii[petals[first[node + 1] - 1]]
            for k in range(first[node], first[node + 1]):
                after = radii[petals[k]]
                turn += _between(before, radius, after)
                before = after
            worst = max(worst, abs(turn - 2 * np.pi))
            # Uniform-neighbour model: `count` equal circles with the same angle sum would have the
            # radius beta / (1 - beta) * own. Inside them, this new radius makes the sum 2 pi.
            beta, delta = sin_cos(turn / (2 * count))[0], sin_cos(np.pi / count)[0]
            radii[node] = beta / (1 - beta) * radius * (1 - delta) / delta
        if worst < _TOLERANCE:
            break
    return radii


@kernel
def _laid_out(radii: Array, first: Ids, petals: Ids, inner: NDArray[np.bool_], start: int) -> Array:
    """Place the centres breadth-first from the inner node `start`, float64 (nodes, 2).

    Around each inner node that has been placed, its neighbours follow at known distances and
    angles, counterclockwise from one that has been placed before.
    """
    nodes = len(radii)
    at = np.zeros((nodes, 2))
    placed = np.zeros(nodes, dtype=np.bool_)
    queue = np.empty(nodes, dtype=np.int64)
    placed[start], queue[0], done, known = True, start, 0, 1
    # The start is the origin and its first neighbour lies on the x axis.
    at[petals[first[start]], 0] = radii[start] + radii[petals[first[start]]]
    placed[petals[first[start]]] = True
    queue[known] = petals[first[start]]
    known += 1
    while done < known:
        node = queue[done]
        done += 1
        if not inner[node]:
            continue
        begin, count = first[node], first[node + 1] - first[node]
        known_petal = 0
        while not placed[petals[begin + known_petal]]:
            known_petal += 1
        radius, before = radii[node], petals[begin + known_petal]
        angle = _angle_of(at[before, 0] - at[node, 0], at[before, 1] - at[node, 1])
        for k in range(1, count):
            petal = petals[begin + (known_petal + k) % count]
            one, two = radii[before], radii[petal]
            angle += _between(one, radius, two)
            if not placed[petal]:
                placed[petal] = True
                sine, cosine = sin_cos(angle)
                at[petal, 0] = at[node, 0] + (radius + two) * cosine
                at[petal, 1] = at[node, 1] + (radius + two) * sine
                queue[known] = petal
                known += 1
            before = petal
    return at


@kernel
def sin_cos(x: float) -> tuple[float, float]:
    """Return the sine and the cosine of an angle of a few turns at most, radians."""
    quarters = np.rint(x / (np.pi / 2))
    x = x - quarters * _QUARTER[0] - quarters * _QUARTER[1]
    sine, cosine = 1.0, 1.0  # Taylor series from behind: the first terms left out are below 1e-17
    for k in range(18, 1, -2):
        cosine = 1 - x * x / (k * (k - 1)) * cosine
        sine = 1 - x * x / (k * (k + 1)) * sine
    sine *= x
    for _ in range(int(quarters) % 4):
        sine, cosine = cosine, -sine
    return sine, cosine


@kernel
def _angle_of(x: float, y: float) -> float:
    """Return the angle of a vector from the x axis, in [-pi, pi]; 0 for the zero vector."""
    far = np.sqrt(x * x + y * y)
    if far == 0:
        return 0.0
    tangent = y / (far + abs(x))  # of half the angle, which is halved three times more
    for _ in range(3):
        tangent /= 1 + np.sqrt(1 + tangent * tangent)
    series = 0.0
    for k in range(19, 0, -2):
        series = 1 / k - tangent * tangent * series
    angle = 16 * tangent * series
    if x < 0:
        return float((np.pi if y >= 0 else -np.pi) - angle)
    return float(angle)
