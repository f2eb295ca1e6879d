"""A drawn diagram eased: faces blown up, strands kept apart, bends spread, and the code kept.

The diagram is a plane graph of straight segments, two strands sharing the node where they cross.
Every face is a balloon whose pressure is its share over its area, the strands are stretched and
stiff, and strands that come near push each other away. No move closes a gap between a node and a
segment by more than a third, so that strands don't pass each other (the idea of P. Simonetto et
al., "ImPrEd", Computer Graphics Forum 30, 2011); whoever needs the code reads it again.

Lengths are shares of the rope's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import check_numbers

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class EasingConfig:
    """How strong the forces are, against a pressure of one face's share over its area.

    Attributes:
        first: iterations with the segments as they are given.
        later: iterations each time that all segments have been split in two.
        segments: of which there are as many at least in the end.
        tension: of the strands, 1 where it just balances the pressures.
        power: of a face's area; 0 for a pressure of its share over its area, more for faces more
            alike in size.
        bending: stiffness, per face.
        reach: within which strands push each other away; 0.025 are 6 pixels.
        push: of strands on top of each other, per face.
        crossing: stiffness of right angles between strands that cross.
        most: that a node moves at once.
        step: share of what each force alone would mend that is mended at once.
    """

    first: int = 300
    later: int = 200
    segments: int = 90
    tension: float = 1.0
    power: float = 1.0
    bending: float = 0.0007
    reach: float = 0.025
    push: float = 80000.0
    crossing: float = 2.0
    most: float = 0.01
    step: float = 0.4

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("first", "later", "segments"),
            positive=("reach", "most", "step"),
            non_negative=("tension", "power", "bending", "push", "crossing"),
        )


def eased(
    at: Array,
    walk: Integers,
    left: Integers,
    right: Integers,
    shares: Array,
    config: EasingConfig,
) -> tuple[Array, Integers]:
    """Ease a diagram drawn with straight segments.

    Args:
        at: float64 (nodes, 2), places; left alone.
        walk: int64 (segments,), nodes along the rope, as many on each edge; begins at a crossing.
        left, right: face on either side of each edge.
        shares: float64 (faces,), what pressures are in proportion to; 0 for the outer face.
        config: how.

    Returns:
        Places and walk, the segments split in two at each stage but the first.
    """
    at = at.copy()
    iterations = config.first
    while True:
        _ease(
            at,
            walk,
            left,
            right,
            shares,
            iterations,
            config.tension,
            config.bending,
            config.reach,
            config.push,
            config.crossing,
            config.power,
            config.most,
            config.step,
        )
        if len(walk) >= config.segments:
            return at, walk
        at, walk = _split(at, walk)
        iterations = config.later


def _split(at: Array, walk: Integers) -> tuple[Array, Integers]:
    """Every segment cut in two at its middle."""
    middles = (at[walk] + at[np.roll(walk, -1)]) / 2
    cuts = len(at) + np.arange(len(walk))
    return np.concatenate([at, middles]), np.stack([walk, cuts], axis=1).ravel()


@numba.njit(cache=True, nogil=True)
def _ease(
    at: Array,
    walk: Integers,
    left: Integers,
    right: Integers,
    shares: Array,
    iterations: int,
    tension: float,
    bending: float,
    reach: float,
    push: float,
    crossing: float,
    power: float,
    most: float,
    step: float,
) -> None:
    nodes, count, edges = len(at), len(walk), len(left)
    per_edge = count // edges
    nx = edges // 2
    balloons = shares.sum()
    visits = np.empty((nx, 2), dtype=np.int64)  # of each crossing, places in the walk
    met = np.zeros(nx, dtype=np.int64)
    for k in range(edges):
        node = walk[k * per_edge]
        visits[node, met[node]] = k * per_edge
        met[node] = 1
    force, stiff, limit = np.empty((nodes, 2)), np.empty(nodes), np.empty(nodes)
    length, own = np.empty(count), np.empty(edges)
    area, pressure, place = np.empty(len(shares)), np.empty(len(shares)), np.empty(count)
    pairs, gaps = np.empty((count * count, 2), dtype=np.int64), np.empty((count * count, 4))
    for _ in range(iterations):
        total = 0.0
        own[:] = 0.0
        for s in range(count):
            a, b = walk[s], walk[(s + 1) % count]
            length[s] = np.hypot(at[b, 0] - at[a, 0], at[b, 1] - at[a, 1])
            place[s] = total
            own[s // per_edge] += length[s] / per_edge
            total += length[s]
        at /= total
        length /= total
        own /= total
        place /= total
        area[:] = 0.0
        for s in range(count):
            a, b, edge = walk[s], walk[(s + 1) % count], s // per_edge
            swept = 0.5 * (at[a, 0] * at[b, 1] - at[a, 1] * at[b, 0])
            area[left[edge]] += swept
            area[right[edge]] -= swept
        force[:] = 0.0
        stiff[:] = 0.0
        virial, inside = 0.0, 0.0
        for face in range(len(shares)):
            if shares[face] > 0:
                inside += area[face]
        for face in range(len(shares)):
            fair = max(area[face], 1e-60) * balloons / inside
            pressure[face] = shares[face] / max(area[face], 1e-60) * min(fair**-power, 1e3)
            virial += pressure[face] * area[face]
        for s in range(count):
            a, b, edge = walk[s], walk[(s + 1) % count], s // per_edge
            # balloons: half of a segment's force on either end
            press = pressure[left[edge]] - pressure[right[edge]]
            x, y = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1]
            for node in (a, b):
                force[node, 0] += 0.5 * press * y
                force[node, 1] -= 0.5 * press * x
            # stretched strands
            pull = 2 * tension * virial / own[edge]
            force[a, 0] += pull * x
            force[a, 1] += pull * y
            force[b, 0] -= pull * x
            force[b, 1] -= pull * y
            stiff[a] += pull
            stiff[b] += pull
        _stiffen(at, walk, length, force, stiff, bending * balloons)
        _square(at, walk, visits, force, stiff, crossing)
        near = _repel(at, walk, length, place, force, stiff, reach, push * balloons, pairs, gaps)
        _bound(walk, length, force, stiff, step, most)
        _hold_back(walk, force, limit, pairs, gaps, near)
        for node in range(nodes):
            for c in range(2):
                at[node, c] += limit[node] * force[node, c]


@numba.njit(cache=True, nogil=True)
def _bound(
    walk: Integers, length: Array, force: Array, stiff: Array, step: float, most: float
) -> None:
    """Turn forces into moves, none of them further than a third of the node's own segments."""
    for s in range(len(walk)):
        for node in (walk[s], walk[(s + 1) % len(walk)]):
            if stiff[node] > 0:
                for c in range(2):
                    force[node, c] *= step / stiff[node]
                stiff[node] = 0.0
    for s in range(len(walk)):
        bound = min(most, length[s] / 3)
        for node in (walk[s], walk[(s + 1) % len(walk)]):
            far = np.hypot(force[node, 0], force[node, 1])
            if far > bound:
                for c in range(2):
                    force[node, c] *= bound / far


@numba.njit(cache=True, nogil=True)
def _hold_back(
    walk: Integers, move: Array, limit: Array, pairs: Integers, gaps: Array, near: int
) -> None:
    """The share of every move that may be made: no gap closes by more than a third."""
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
            for one in (node, a, b):
                limit[one] = min(limit[one], share)


@numba.njit(cache=True, nogil=True)
def _stiffen(
    at: Array, walk: Integers, length: Array, force: Array, stiff: Array, bending: float
) -> None:
    """Add what turns segments that follow each other into line: the bends want to be spread."""
    count = len(walk)
    for s in range(count):
        before, node, after = walk[s - 1], walk[s], walk[(s + 1) % count]
        back, on = length[s - 1], length[s]
        x, y = (at[node, 0] - at[before, 0]) / back, (at[node, 1] - at[before, 1]) / back
        u, v = (at[after, 0] - at[node, 0]) / on, (at[after, 1] - at[node, 1]) / on
        along = x * u + y * v
        weight = 4 * bending / (back + on)
        for side in range(2):
            if side == 0:  # the segment ahead turns towards the one behind
                a, b, strength = node, after, weight / on
                turn_x, turn_y = x - along * u, y - along * v
            else:
                a, b, strength = before, node, weight / back
                turn_x, turn_y = u - along * x, v - along * y
            force[b, 0] += strength * turn_x
            force[b, 1] += strength * turn_y
            force[a, 0] -= strength * turn_x
            force[a, 1] -= strength * turn_y
        # the same bend over a longer stretch is a lesser one
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


@numba.njit(cache=True, nogil=True)
def _square(
    at: Array,
    walk: Integers,
    visits: Integers,
    force: Array,
    stiff: Array,
    crossing: float,
) -> None:
    """Add what turns strands that cross to a right angle."""
    count = len(walk)
    for node in range(len(visits)):
        for side in range(2):
            own, other = visits[node, side], visits[node, 1 - side]
            a, b = walk[own - 1], walk[(own + 1) % count]
            c, d = walk[other - 1], walk[(other + 1) % count]
            x, y = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1]
            u, v = at[d, 0] - at[c, 0], at[d, 1] - at[c, 1]
            long, across = np.hypot(x, y), np.hypot(u, v)
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


@numba.njit(cache=True, nogil=True)
def _repel(
    at: Array,
    walk: Integers,
    length: Array,
    place: Array,
    force: Array,
    stiff: Array,
    reach: float,
    push: float,
    pairs: Integers,
    gaps: Array,
) -> int:
    """Add what keeps strands apart; list the nodes and segments within reach of each other.

    Returns:
        How many pairs there are; of each, `gaps` holds the direction from segment to node, the
        distance, and the nearest place on the segment.
    """
    count, found = len(walk), 0
    for t in range(count):
        node = walk[t]
        for s in range(count):
            a, b = walk[s], walk[(s + 1) % count]
            if node == a or node == b:
                continue
            x, y = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1]
            u, v = at[node, 0] - at[a, 0], at[node, 1] - at[a, 1]
            along = min(1.0, max(0.0, (u * x + v * y) / max(length[s] * length[s], 1e-300)))
            u, v = u - along * x, v - along * y
            far = np.hypot(u, v)
            if far >= reach:
                continue
            pairs[found, 0], pairs[found, 1] = node, s
            gaps[found, 0], gaps[found, 1] = u / max(far, 1e-300), v / max(far, 1e-300)
            gaps[found, 2], gaps[found, 3] = far, along
            found += 1
            walked = abs(place[t] - place[s] - 0.5 * length[s])
            if far > 0.5 * min(walked, 1 - walked):  # one strand, hardly bent
                continue
            # a segment's and a node's own share of the strand, so that splitting changes nothing
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
    return found
