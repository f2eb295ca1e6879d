"""From generalized positions to vertices and back, along a rope's kinematic trees, compiled.

Quaternions are (w, x, y, z). A tree is given by arrays over the beads: `order`, parents before
children; `parent`, -1 at a root; `at`, where a bead's numbers begin in qpos; `rest`, its
orientation to its parent at zero joint angle.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def forward(
    qpos: Array,
    order: Array,
    parent: Array,
    at: Array,
    rest: Array,
    length: float,
    points: Array,
    gaps: Array,
) -> None:
    """Write the vertices of generalized positions, and how far apart joined ends stand at most.

    Args:
        qpos: float64 (n, nq).
        order, parent, at, rest: the tree, see the module.
        length: of a bead, metres.
        points: float64 (n, beads, 3), metres; written.
        gaps: float64 (n,), metres; written.
    """
    beads = len(order)
    world = np.empty((beads, 4))
    axis = np.empty((beads, 3))
    for row in range(len(qpos)):
        q = qpos[row]
        for k in range(beads):
            bead = order[k]
            up, a = parent[bead], at[bead]
            if up < 0:
                world[bead] = _unit(q[a + 3 : a + 7])
                points[row, bead] = q[a : a + 3]
            else:
                world[bead] = _multiply(_multiply(world[up], rest[bead]), _unit(q[a : a + 4]))
            w, x, y, z = world[bead]
            axis[bead, 0] = length * (1 - 2 * (y * y + z * z))
            axis[bead, 1] = length * 2 * (x * y + w * z)
            axis[bead, 2] = length * 2 * (x * z - w * y)
            if up == bead - 1 and up >= 0:
                points[row, bead] = points[row, up] + axis[up]
            elif up >= 0:
                points[row, bead] = points[row, up] - axis[bead]
        gaps[row] = 0.0
        for bead in range(beads):
            apart = points[row, (bead + 1) % beads] - points[row, bead] - axis[bead]
            gaps[row] = max(gaps[row], np.sqrt((apart * apart).sum()))


@numba.njit(cache=True, nogil=True)
def backward(
    points: Array, along: Array, order: Array, parent: Array, at: Array, rest: Array, qpos: Array
) -> None:
    """Write the generalized positions of a configuration, with the smallest twist of each bead.

    Args:
        points: float64 (beads, 3), metres.
        along: float64 (beads, 3), unit vectors of the beads.
        order, parent, at, rest: the tree, see the module.
        qpos: float64 (nq,); written.
    """
    world = np.empty((len(order), 4))
    for k in range(len(order)):
        bead = order[k]
        up, a = parent[bead], at[bead]
        if up < 0:
            world[bead] = _shortest_arc(np.array([1.0, 0.0, 0.0]), along[bead])
            qpos[a : a + 3] = points[bead]
            qpos[a + 3 : a + 7] = world[bead]
        else:
            world[bead] = _multiply(_shortest_arc(along[up], along[bead]), world[up])
            back = _multiply(world[up], rest[bead])
            back[1:] *= -1.0
            qpos[a : a + 4] = _multiply(back, world[bead])


@numba.njit(cache=True, nogil=True)
def _unit(q: Array) -> Array:
    return q / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)


@numba.njit(cache=True, nogil=True)
def _multiply(a: Array, b: Array) -> Array:
    """Hamilton product of two quaternions, (w, x, y, z)."""
    product = np.empty(4)
    product[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    product[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    product[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    product[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]
    return product


@numba.njit(cache=True, nogil=True)
def _shortest_arc(a: Array, b: Array) -> Array:
    """Quaternion of the smallest rotation that takes unit vector a to unit vector b."""
    arc = np.empty(4)
    arc[0] = 1 + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if arc[0] < 1e-12:  # opposite: half a turn about any perpendicular axis
        arc[0] = 0.0
        other = np.array([0.0, 0.0, 1.0]) if abs(a[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        arc[1:] = np.cross(a, other)
    else:
        arc[1:] = np.cross(a, b)
    return _unit(arc)
