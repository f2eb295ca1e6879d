"""Relaxation of a straight-line drawing of a diagram until it is easy to read.

The drawing is a plane graph of straight segments, in which two strands share the node where they
cross. Five forces act on its nodes:

- pressure: every face is a balloon whose pressure is its share divided by its area;
- tension: strands are stretched, with an energy that is quadratic in the length of an edge;
- bending: consecutive segments turn into line;
- right angles: strands that cross turn perpendicular to each other;
- repulsion: strands that come close push each other away.

Nodes move along the force divided by an estimate of its stiffness (a diagonal Newton step). No step
closes the gap between a node and a segment by more than a third, so strands can't pass through each
other (the idea of P. Simonetto et al., "ImPrEd", Computer Graphics Forum 30, 2011). Callers that
rely on the code read it again.

Lengths are fractions of the rope's length: the drawing is rescaled to total length 1 in each
iteration.

After a change run `pytest tests/drawing`: forces must be minus the gradients of their energies;
then `knotgym generate --no-demonstrations --nx 0-4 --every-code 1`: all 401 codes must be drawn.
"""

import numpy as np

from knotgym.common import Array, Ids, inner, kernel

# These were set by eye when drawings were introduced (2026, commits 78e73fb and 2cf8d22).
# `benchmarks/drawing.py` at f6d1acb halves and doubles each. Of 60 codes of nx 6, drawn once, 53 %
# are within the limits. Half the tension leaves 7 %, half the reach 10, twice the reach none;
# bending, push, power and step change it by less than chance (40 to 58 %), crossing and most not at
# all.
# Twice the tension gives 75 %: a better value, which would change every drawn state.
FIRST, LATER = 300, 200  # iterations with the segments as given, and after each splitting
SEGMENTS = 90  # splitting stops at this many segments or more
# Strengths of the forces, relative to the pressure of a face with share 1.
TENSION = 1.0  # balances the pressures
BENDING = 0.0007  # stiffness, per face
CROSSING = 2.0  # stiffness of the right angles at crossings
PUSH, REACH = 80000.0, 0.025  # repulsion between strands, per face; within 6 pixels
MOST, STEP = 0.01, 0.4  # largest displacement of a node; fraction of the Newton step that is taken


def relax_layout(at: Array, walk: Ids, left: Ids, right: Ids, shares: Array) -> tuple[Array, Ids]:
    """Relax a diagram drawn with straight segments.

    The drawing is relaxed with few segments first, then with twice as many, and so on: large moves
    are cheap on the coarse drawing, and later stages only smooth it.

    Args:
        at: float64 (nodes, 2), positions of the nodes; not modified.
        walk: int64 (segments,), nodes along the rope from a crossing on; all edges have the same
            number of segments.
        left, right: int64 (edges,), the faces on either side of each edge.
        shares: float64 (faces,), relative sizes of the faces; 0 for the outer face.

    Returns:
        The positions and the walk after relaxation and splitting.
    """
    strengths = TENSION, BENDING, CROSSING, PUSH, REACH, MOST, STEP
    at, iterations = at.copy(), FIRST
    while True:
        _relax(at, walk, left, right, shares, iterations, strengths)
        if len(walk) >= SEGMENTS:
            return at, walk
        at, walk = _split(at, walk)
        iterations = LATER


def _split(at: Array, walk: Ids) -> tuple[Array, Ids]:
    """Split every segment in two at its midpoint."""
    midpoints = (at[walk] + at[np.roll(walk, -1)]) / 2
    cuts = len(at) + np.arange(len(walk))
    return np.concatenate([at, midpoints]), np.stack([walk, cuts], axis=1).ravel()


@kernel
def _relax(
    at: Array,
    walk: Ids,
    left: Ids,
    right: Ids,
    shares: Array,
    iterations: int,
    strengths: tuple[float, float, float, float, float, float, float],
) -> None:
    """Run the iterations, changing `at`; `strengths` are the constants above.

    `force` (nodes, 2) sums the forces on each node. `stiff` (nodes,) sums their derivatives by the
    node's own position, without signs or cross terms.
    """
    tension, bending, crossing, push, reach, most, step = strengths
    nodes, count, edges = len(at), len(walk), len(left)
    per_edge = count // edges  # segments
    nx = edges // 2
    balloons = shares.sum()
    visits = np.empty((nx, 2), dtype=np.int64)  # index in the walk of both visits of each crossing
    met = np.zeros(nx, dtype=np.int64)
    for k in range(edges):
        node = walk[k * per_edge]
        visits[node, met[node]] = k * per_edge
        met[node] = 1
    force, stiff, limit = np.empty((nodes, 2)), np.empty(nodes), np.empty(nodes)
    length, mean_length = np.empty(count), np.empty(edges)  # of segments; of those of an edge
    area, pressure = np.empty(len(shares)), np.empty(len(shares))
    arc = np.empty(count)  # position of each segment's start along the rope
    pairs, gaps = np.empty((count * count, 2), dtype=np.int64), np.empty((count * count, 4))
    for _ in range(iterations):
        # lengths; then rescale the drawing to total length 1
        total = 0.0
        mean_length[:] = 0.0
        for s in range(count):
            a, b = walk[s], walk[(s + 1) % count]
            length[s] = _length(at[b, 0] - at[a, 0], at[b, 1] - at[a, 1])
            arc[s] = total
            mean_length[s // per_edge] += length[s] / per_edge
            total += length[s]
        at /= total
        length /= total
        mean_length /= total
        arc /= total
        # Areas by the shoelace formula: a segment adds to the face on its left and subtracts from
        # the face on its right. The outer face gets minus the area of all others.
        area[:] = 0.0
        for s in range(count):
            a, b, edge = walk[s], walk[(s + 1) % count], s // per_edge
            swept = 0.5 * (at[a, 0] * at[b, 1] - at[a, 1] * at[b, 0])
            area[left[edge]] += swept
            area[right[edge]] -= swept
        force[:] = 0.0
        stiff[:] = 0.0
        # Pressure p = share / area * min(1 / fair, 1000), `fair` being the area relative to the
        # mean area per share: small faces push harder. If the drawing is stretched by 1 + e, the
        # pressures do the work 2 e * virial, with virial = sum of p * area; tension 1 takes up as
        # much.
        virial, inside = 0.0, 0.0
        for face in range(len(shares)):
            if shares[face] > 0:
                inside += area[face]
        for face in range(len(shares)):
            fair = max(area[face], 1e-60) * balloons / inside
            pressure[face] = shares[face] / max(area[face], 1e-60) * min(1 / fair, 1e3)
            virial += pressure[face] * area[face]
        for s in range(count):
            a, b, edge = walk[s], walk[(s + 1) % count], s // per_edge
            # pressure: the force p * length along the segment's right normal (y, -x), half on
            # either end; the face on the left pushes to the right
            press = pressure[left[edge]] - pressure[right[edge]]
            x, y = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1]
            for node in (a, b):
                force[node, 0] += 0.5 * press * y
                force[node, 1] -= 0.5 * press * x
            # Tension: the energy of an edge is tension * virial * (sum of its segment lengths^2) /
            # mean length, with the mean held fixed. It also spaces the nodes evenly.
            pull = 2 * tension * virial / mean_length[edge]
            force[a, 0] += pull * x
            force[a, 1] += pull * y
            force[b, 0] -= pull * x
            force[b, 1] -= pull * y
            stiff[a] += pull
            stiff[b] += pull
        _stiffen(at, walk, length, force, stiff, bending * balloons)
        _square(at, walk, visits, force, stiff, crossing)
        near = _repel(at, walk, length, arc, force, stiff, reach, push * balloons, pairs, gaps)
        # from here on `force` holds displacements
        _bound(walk, length, force, stiff, step, most)
        _hold_back(walk, force, limit, pairs, gaps, near)
        for node in range(nodes):
            for c in range(2):
                at[node, c] += limit[node] * force[node, c]


@inner
def _length(x: float, y: float) -> float:
    # libm's hypot rounds otherwise where the processor multiplies and adds at once
    return float(np.sqrt(x * x + y * y))


@inner
def _bound(walk: Ids, length: Array, force: Array, stiff: Array, step: float, most: float) -> None:
    """Turn forces into displacements of at most `most` and a third of the adjacent segments.

    The displacement is step * force / stiffness. A crossing is on the walk twice: clearing `stiff`
    marks nodes that have been converted.
    """
    for s in range(len(walk)):
        for node in (walk[s], walk[(s + 1) % len(walk)]):
            if stiff[node] > 0:
                for c in range(2):
                    force[node, c] *= step / stiff[node]
                stiff[node] = 0.0
    for s in range(len(walk)):
        bound = min(most, length[s] / 3)
        for node in (walk[s], walk[(s + 1) % len(walk)]):
            far = _length(force[node, 0], force[node, 1])
            if far > bound:
                for c in range(2):
                    force[node, c] *= bound / far


@inner
def _hold_back(walk: Ids, move: Array, limit: Array, pairs: Ids, gaps: Array, near: int) -> None:
    """Compute the fraction of each displacement that is allowed, float64 (nodes,), in `limit`.

    No gap between a node and a segment may close by more than a third. The point of the segment
    nearest to the node moves by a mean of its ends' displacements, weighted by `along`.
    """
    limit[:] = 1.0
    for k in range(near):
        node, s = pairs[k]
        a, b, along = walk[s], walk[(s + 1) % len(walk)], gaps[k, 3]
        closing = 0.0
        for c in range(2):
            other = (1 - along) * move[a, c] + along * move[b, c]
            closing -= gaps[k, c] * (move[node, c] - other)
        if closing > gaps[k, 2] / 3:
            share = gaps[k, 2] / 3 / closing
            for corner in (node, a, b):
                limit[corner] = min(limit[corner], share)


@kernel
def _stiffen(
    at: Array, walk: Ids, length: Array, force: Array, stiff: Array, bending: float
) -> None:
    """Add the force of bending.

    The energy at a node between segments of lengths `back` and `on` with unit directions t and t'
    is 4 * bending * (1 - t . t') / (back + on), about stiffness times curvature squared times
    length. Its gradient has two parts: the change of the directions (the projections below), and
    that of the lengths in the denominator.
    """
    count = len(walk)
    for s in range(count):
        before, node, after = walk[s - 1], walk[s], walk[(s + 1) % count]
        back, on = length[s - 1], length[s]
        x, y = (at[node, 0] - at[before, 0]) / back, (at[node, 1] - at[before, 1]) / back
        u, v = (at[after, 0] - at[node, 0]) / on, (at[after, 1] - at[node, 1]) / on
        along = x * u + y * v
        weight = 4 * bending / (back + on)
        for side in range(2):
            # d(unit vector) / d(end point) = (1 - t t^T) / length
            if side == 0:  # turn the segment ahead towards the one behind
                a, b, strength = node, after, weight / on
                turn_x, turn_y = x - along * u, y - along * v
            else:  # turn the segment behind towards the one ahead
                a, b, strength = before, node, weight / back
                turn_x, turn_y = u - along * x, v - along * y
            force[b, 0] += strength * turn_x
            force[b, 1] += strength * turn_y
            force[a, 0] -= strength * turn_x
            force[a, 1] -= strength * turn_y
        # lengthening both segments lowers the energy: -dE / d(length) = E / (back + on)
        stretch = weight * (1 - along) / (back + on)
        force[after, 0] += stretch * u
        force[after, 1] += stretch * v
        force[node, 0] += stretch * (x - u)
        force[node, 1] += stretch * (y - v)
        force[before, 0] -= stretch * x
        force[before, 1] -= stretch * y
        stiff[node] += weight * (1 / on + 1 / back) ** 2
        stiff[before] += weight / back**2
        stiff[after] += weight / on**2


@kernel
def _square(at: Array, walk: Ids, visits: Ids, force: Array, stiff: Array, crossing: float) -> None:
    """Add the force that turns crossing strands perpendicular.

    The energy at a crossing is crossing * cos^2(angle). The direction of a strand there is the line
    between the nodes before and after the crossing.
    """
    count = len(walk)
    for node in range(len(visits)):
        for side in range(2):
            own, other = visits[node, side], visits[node, 1 - side]
            a, b = walk[own - 1], walk[(own + 1) % count]
            c, d = walk[other - 1], walk[(other + 1) % count]
            x, y = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1]
            u, v = at[d, 0] - at[c, 0], at[d, 1] - at[c, 1]
            long, across = _length(x, y), _length(u, v)
            cosine = (x * u + y * v) / (long * across)
            strength = 2 * crossing * cosine / long
            turn_x = strength * (u / across - cosine * x / long)
            turn_y = strength * (v / across - cosine * y / long)
            force[b, 0] -= turn_x
            force[b, 1] -= turn_y
            force[a, 0] += turn_x
            force[a, 1] += turn_y
            stiff[a] += 2 * crossing / long**2
            stiff[b] += 2 * crossing / long**2


@kernel
def _repel(
    at: Array,
    walk: Ids,
    length: Array,
    arc: Array,
    force: Array,
    stiff: Array,
    reach: float,
    push: float,
    pairs: Ids,
    gaps: Array,
) -> int:
    """Add the repulsion between strands; list all pairs of a node and a segment within reach.

    Returns:
        The number of pairs. `pairs` holds (node, segment) of each. `gaps` holds the unit vector
        from the nearest point of the segment to the node (2 columns), the distance, and the
        position of that point along the segment, in [0, 1].
    """
    count, close = len(walk), 0
    for t in range(count):
        node = walk[t]
        for s in range(count):
            a = walk[s]
            u, v = at[node, 0] - at[a, 0], at[node, 1] - at[a, 1]
            # Most segments are out of reach whichever way they point; the margin is for rounding.
            away = (1 + 1e-9) * (reach + length[s])
            if max(abs(u), abs(v)) > away:
                continue
            b = walk[(s + 1) % count]
            if node == a or node == b:
                continue
            x, y = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1]
            # nearest point of the segment, as a fraction of its length from a
            along = min(1.0, max(0.0, (u * x + v * y) / max(length[s] * length[s], 1e-300)))
            u, v = u - along * x, v - along * y
            if u * u + v * v > (1 + 1e-9) * reach * reach:
                continue
            far = _length(u, v)
            if far >= reach:
                continue
            pairs[close, 0], pairs[close, 1] = node, s
            gaps[close, 0], gaps[close, 1] = u / max(far, 1e-300), v / max(far, 1e-300)
            gaps[close, 2], gaps[close, 3] = far, along
            close += 1
            # Skip neighbours on the same strand: there the distance is more than half the way
            # along the rope, because the strand hardly bends.
            walked = abs(arc[t] - arc[s] - 0.5 * length[s])
            if far > 0.5 * min(walked, 1 - walked):
                continue
            # push * (1 - d)^2 / (0.1 + d) with d = distance / reach: steep when close, smooth at
            # the end of the reach. The two lengths make it an integral over both strands, so that
            # splitting segments doesn't change it.
            near = far / reach
            strength = (
                push * (1 - near) ** 2 / (0.1 + near) * length[s] * length[t] / max(far, 1e-12)
            )
            force[node, 0] += strength * u
            force[node, 1] += strength * v
            force[a, 0] -= (1 - along) * strength * u
            force[a, 1] -= (1 - along) * strength * v
            force[b, 0] -= along * strength * u
            force[b, 1] -= along * strength * v
            stiff[node] += strength
            stiff[a] += (1 - along) * strength
            stiff[b] += along * strength
    return close
