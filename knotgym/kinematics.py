"""From generalized positions to vertices and back, along the kinematic trees of a rope, compiled.

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
    out: Array,
    gaps: Array,
) -> None:
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
                out[row, bead] = q[a : a + 3]
            else:
                world[bead] = _multiply(_multiply(world[up], rest[bead]), _unit(q[a : a + 4]))
            w, x, y, z = world[bead]
            axis[bead, 0] = length * (1 - 2 * (y * y + z * z))
            axis[bead, 1] = length * 2 * (x * y + w * z)
            axis[bead, 2] = length * 2 * (x * z - w * y)
            if up == bead - 1 and up >= 0:
                out[row, bead] = out[row, up] + axis[up]
            elif up >= 0:
                out[row, bead] = out[row, up] - axis[bead]
        gaps[row] = 0.0
        for bead in range(beads):
            apart = out[row, (bead + 1) % beads] - out[row, bead] - axis[bead]
            gaps[row] = max(gaps[row], np.sqrt((apart * apart).sum()))


@numba.njit(cache=True, nogil=True)
def backward(
    points: Array, along: Array, order: Array, parent: Array, at: Array, rest: Array, out: Array
) -> None:
    world = np.empty((len(order), 4))
    for k in range(len(order)):
        bead = order[k]
        up, a = parent[bead], at[bead]
        if up < 0:
            world[bead] = _shortest_arc(np.array([1.0, 0.0, 0.0]), along[bead])
            out[a : a + 3] = points[bead]
            out[a + 3 : a + 7] = world[bead]
        else:
            world[bead] = _multiply(_shortest_arc(along[up], along[bead]), world[up])
            back = _multiply(world[up], rest[bead])
            back[1:] *= -1.0
            out[a : a + 4] = _multiply(back, world[bead])


@numba.njit(cache=True, nogil=True)
def _unit(q: Array) -> Array:
    return q / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)


@numba.njit(cache=True, nogil=True)
def _multiply(a: Array, b: Array) -> Array:
    """Hamilton product of two quaternions, (w, x, y, z)."""
    out = np.empty(4)
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]
    return out


@numba.njit(cache=True, nogil=True)
def _shortest_arc(a: Array, b: Array) -> Array:
    """Quaternion of the smallest rotation that takes unit vector a to unit vector b."""
    out = np.empty(4)
    out[0] = 1 + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if out[0] < 1e-12:  # opposite: half a turn about any perpendicular axis
        out[0] = 0.0
        other = np.array([0.0, 0.0, 1.0]) if abs(a[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        out[1:] = np.cross(a, other)
    else:
        out[1:] = np.cross(a, b)
    return _unit(out)
