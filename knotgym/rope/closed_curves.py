"""Closed chains of equal chords: how near they pass each other, and polylines cut into them."""

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def closed_directions(along: Array) -> Array:
    """Change unit vectors (n, 3) as little as possible so that they sum to zero.

    A chain of equal chords in these directions is closed.
    """
    # The unit vectors u_i with sum 0 that minimize sum |u_i - a_i|^2 are the normalized a_i - s,
    # where s is the Lagrange multiplier of the constraint. Newton's method on s:
    #     f(s) = sum_i (a_i - s) / |a_i - s| = 0,
    # with the Jacobian df/ds = -sum_i (I - u_i u_i^T) / |a_i - s|, u_i the normalized vectors.
    shift = np.zeros(3)
    for _ in range(50):
        moved = along - shift
        norm = np.linalg.norm(moved, axis=1, keepdims=True)
        unit = moved / norm
        total = unit.sum(axis=0)
        if np.abs(total).max() < 1e-13 * len(along):
            break
        slope = ((np.eye(3) - unit[:, :, None] * unit[:, None, :]) / norm[:, :, None]).sum(axis=0)
        shift += solved(slope.tolist(), total.tolist())
    return unit


def solved(matrix: list[list[float]], vector: list[float]) -> list[float]:
    """Solve three linear equations, with the same bits on every machine.

    `np.linalg.solve` rounds differently from one processor to the next, because BLAS has other
    kernels for each, and what is laid here starts episodes that are replayed bit by bit. This is
    Gaussian elimination with partial pivoting, in the order of OpenBLAS on processors with AVX2:
    columns are multiplied by the pivot's reciprocal, and the last pivot subtracts its two products
    at once.
    """
    rows = [[*row, right] for row, right in zip(matrix, vector, strict=True)]
    first = max(range(3), key=lambda row: abs(rows[row][0]))
    rows[0], rows[first] = rows[first], rows[0]
    a, b, c = rows
    for row in (b, c):
        row[0] *= 1 / a[0]
        row[1] -= row[0] * a[1]
    if abs(c[1]) > abs(b[1]):
        b, c = c, b
    c[1] *= 1 / b[1]
    b[2] -= b[0] * a[2]
    c[2] -= c[0] * a[2] + c[1] * b[2]
    b[3] -= b[0] * a[3]
    c[3] = c[3] - c[0] * a[3] - c[1] * b[3]
    z = c[3] / c[2]
    y = (b[3] - b[2] * z) / b[1]
    x = (a[3] - a[2] * z - a[1] * y) / a[0]
    return [x, y, z]


def equal_chords(curve: Array, count: int) -> Array:
    """Cut a closed polyline into a closed chain of `count` chords of length 1.

    The cuts move along the polyline until the chords are nearly equal; this fails only where the
    polyline doubles back within a chord. The chords are then scaled to length 1, and a correction
    of their directions closes the chain (`closed_directions`).

    Returns:
        float64 (count, 3), centred.
    """
    curve = (curve - curve[0]) / max(np.ptp(curve, axis=0).max(), np.finfo(float).tiny)
    closed = np.concatenate([curve, curve[:1]])
    arc_length = _arc_lengths(closed)
    cuts = np.linspace(0.0, arc_length[-1], count + 1)  # arc lengths at which to cut
    # Fixed-point iteration: a chord is shorter than the arc that it cuts off, the more so the more
    # the curve bends there. Measure the chords, and move the cuts to equal shares of their sum.
    for _ in range(50):
        points = np.stack([np.interp(cuts, arc_length, axis) for axis in closed.T], axis=1)
        walked = _arc_lengths(points)
        if np.ptp(np.diff(walked)) <= 1e-12 * walked[-1]:
            break
        cuts = np.interp(np.linspace(0.0, walked[-1], count + 1), walked, cuts)
    chord = np.diff(points, axis=0)
    lengths = np.linalg.norm(chord, axis=1, keepdims=True)
    along = closed_directions(chord / np.maximum(lengths, np.finfo(float).tiny))
    ends = np.cumsum(along, axis=0)
    return np.roll(ends, 1, axis=0) - ends.mean(axis=0)


def _arc_lengths(points: Array) -> Array:
    """Return the arc length of a polyline at each of its n points: float64 (n,), from 0."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


@numba.njit(cache=True, nogil=True)
def clearance(points: Array) -> float:
    """Return the smallest distance between the axes of two beads that aren't neighbours, metres.

    The beads overlap if it is below their diameter.

    Args:
        points: float64 (beads, 3), metres, the vertices of a closed rope.
    """
    beads = len(points)
    best = np.inf
    for i in range(beads):
        a, b = points[i], points[(i + 1) % beads]
        # bead 0 and the last bead are neighbours too
        for j in range(i + 2, beads if i > 0 else beads - 1):
            c, d = points[j], points[(j + 1) % beads]
            far, half = 0.0, 0.0
            for k in range(3):
                far += (a[k] + b[k] - c[k] - d[k]) ** 2
                half += (b[k] - a[k]) ** 2 + (d[k] - c[k]) ** 2
            # The distance of the midpoints minus both half lengths is a lower bound; it is
            # weakened to a single square root, l1 + l2 <= sqrt(2 (l1^2 + l2^2)), and skips nearly
            # all pairs.
            if 0.5 * np.sqrt(far) - np.sqrt(0.5 * half) >= best:
                continue
            best = min(best, _segment_distance(a, b, c, d))
    return best


@numba.njit(cache=True, nogil=True)
def _segment_distance(a: Array, b: Array, c: Array, d: Array) -> float:
    """Return the distance of segments ab and cd (Ericson, Real-Time Collision Detection, 5.1.9)."""
    # u = b - a, v = d - c, w = a - c; the closest points are a + s u and c + t v, s, t in [0, 1].
    # Setting both derivatives of |w + s u - t v|^2 to zero gives
    #     s uu - t uv = -uw,    s uv - t vv = -vw.
    uu, vv, uv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        u, v, w = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        uu += u * u
        vv += v * v
        uv += u * v
        uw += u * w
        vw += v * w
    # Cramer's rule for s, clamped; parallel segments (det = 0) may start from any s. Then t that is
    # best for this s, and if t must be clamped, s that is best for the clamped t.
    det = uu * vv - uv * uv
    s = min(max((uv * vw - uw * vv) / det, 0.0), 1.0) if det > 1e-15 * uu * vv else 0.0
    t = (uv * s + vw) / vv
    if t < 0:
        t, s = 0.0, min(max(-uw / uu, 0.0), 1.0)
    elif t > 1:
        t, s = 1.0, min(max((uv - uw) / uu, 0.0), 1.0)
    square = 0.0
    for k in range(3):
        gap = (a[k] - c[k]) + s * (b[k] - a[k]) - t * (d[k] - c[k])
        square += gap * gap
    return np.sqrt(square)
