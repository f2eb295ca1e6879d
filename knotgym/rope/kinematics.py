"""Compiled forward and inverse kinematics: generalized positions to vertices and back.

Quaternions are (w, x, y, z). The kinematic trees are described by arrays over the beads: `order`
lists parents before their children; `parent` is -1 at a root; `at` is the index in qpos at which a
bead's numbers begin; `rest` is its orientation relative to its parent at zero joint angle.

After a change run `pytest tests/rope/test_rope.py`: positions must be MuJoCo's, and qpos of a curve
lead back to it.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from knotgym.common import inner

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
    """Compute the vertices of generalized positions and the largest gap between joined ends.

    Args:
        qpos: float64 (n, nq).
        order, parent, at, rest: the kinematic trees, see the module.
        length: length of a bead, metres.
        points: float64 (n, beads, 3), metres; output.
        gaps: float64 (n,), metres; output.
    """
    beads = len(order)
    world = np.empty((beads, 4))
    axis = np.empty((beads, 3))
    turned, own = np.empty(4), np.empty(4)
    for row in range(len(qpos)):
        q = qpos[row]
        for k in range(beads):
            bead = order[k]
            up, a = parent[bead], at[bead]
            if up < 0:
                # a free joint: position in q[a : a + 3], orientation in q[a + 3 : a + 7]
                _unit(q[a + 3 : a + 7], world[bead])
            else:
                # world = parent's world * rest * ball joint; MuJoCo normalizes the joint's
                # quaternion before use, and so must we
                _multiply(world[up], rest[bead], turned)
                _unit(q[a : a + 4], own)
                _multiply(turned, own, world[bead])
            # a bead lies along its body's x axis: the first column of the rotation matrix
            w, x, y, z = world[bead, 0], world[bead, 1], world[bead, 2], world[bead, 3]
            axis[bead, 0] = length * (1 - 2 * (y * y + z * z))
            axis[bead, 1] = length * 2 * (x * y + w * z)
            axis[bead, 2] = length * 2 * (x * z - w * y)
            for c in range(3):
                if up < 0:
                    points[row, bead, c] = q[a + c]
                elif up == bead - 1:
                    # after the root: the bead starts where its parent ends
                    points[row, bead, c] = points[row, up, c] + axis[up, c]
                else:
                    # before the root: the bead ends where its parent starts
                    points[row, bead, c] = points[row, up, c] - axis[bead, c]
        # Inside a sub-chain the next vertex is the bead's end by construction, so that only the
        # soft closures between sub-chains contribute here.
        gaps[row] = 0.0
        for bead in range(beads):
            square = 0.0
            for c in range(3):
                apart = points[row, (bead + 1) % beads, c] - points[row, bead, c] - axis[bead, c]
                square += apart * apart
            gaps[row] = max(gaps[row], np.sqrt(square))


@numba.njit(cache=True, nogil=True)
def transported(along: Array, order: Array, parent: Array) -> Array:
    """Return the orientations of beads with the smallest twist, float64 (n, beads, 4).

    Vertices alone don't determine the rotation of a bead about its own axis; each bead gets its
    parent's orientation turned by the shortest arc (parallel transport).

    Args:
        along: float64 (n, beads, 3), unit vectors of the beads.
        order, parent: the kinematic trees, see the module.
    """
    world = np.empty((len(along), len(order), 4))
    x_axis, arc = np.zeros(3), np.empty(4)
    x_axis[0] = 1.0
    for row in range(len(along)):
        for k in range(len(order)):
            bead = order[k]
            up = parent[bead]
            if up < 0:
                _shortest_arc(x_axis, along[row, bead], world[row, bead])
            else:
                _shortest_arc(along[row, up], along[row, bead], arc)
                # the arc is applied in the world's frame, so it stands on the left
                _multiply(arc, world[row, up], world[row, bead])
    return world


@numba.njit(cache=True, nogil=True)
def backward(
    points: Array, world: Array, order: Array, parent: Array, at: Array, rest: Array, qpos: Array
) -> None:
    """Compute the generalized positions of beads that lie and are turned as given.

    Args:
        points: float64 (n, beads, 3), metres.
        world: float64 (n, beads, 4), the beads' orientations.
        order, parent, at, rest: the kinematic trees, see the module.
        qpos: float64 (n, nq); output.
    """
    back = np.empty(4)
    for row in range(len(points)):
        for bead in order:
            up, a = parent[bead], at[bead]
            if up < 0:
                for c in range(3):
                    qpos[row, a + c] = points[row, bead, c]
                for c in range(4):
                    qpos[row, a + 3 + c] = world[row, bead, c]
            else:
                # joint = (parent's world * rest)^-1 * world; the inverse of a unit quaternion is
                # its conjugate
                _multiply(world[row, up], rest[bead], back)
                for c in range(1, 4):
                    back[c] *= -1.0
                _multiply(back, world[row, bead], qpos[row, a : a + 4])


@numba.njit(cache=True, nogil=True, error_model="numpy")  # 0 / 0 is NaN instead of an exception
def _unit(q: Array, unit: Array) -> None:
    size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for c in range(4):
        unit[c] = q[c] / size


@inner
def _multiply(a: Array, b: Array, product: Array) -> None:
    """Write the Hamilton product a b; `product` must share no memory with a or b."""
    product[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    product[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    product[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    product[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


@inner
def _shortest_arc(a: Array, b: Array, arc: Array) -> None:
    """Write the quaternion of the smallest rotation that takes unit vector a to unit vector b."""
    # (1 + a . b, a x b) = 2 cos(t / 2) (cos(t / 2), sin(t / 2) n) for angle t and axis n
    x, y, z = b[0], b[1], b[2]
    arc[0] = 1 + a[0] * x + a[1] * y + a[2] * z
    if arc[0] < 1e-12:  # opposite: half a turn about any perpendicular axis
        # cross with the z axis, or with x where a is nearly along z
        arc[0] = 0.0
        x, y, z = (0.0, 0.0, 1.0) if abs(a[2]) < 0.9 else (1.0, 0.0, 0.0)
    arc[1] = a[1] * z - a[2] * y
    arc[2] = a[2] * x - a[0] * z
    arc[3] = a[0] * y - a[1] * x
    _unit(arc, arc)
