"""Closed chains of equal chords: polylines cut into them, how near they pass each other, noise.

Reset noise keeps the rope closed; at reset it also keeps the Gauss code, chirality included.

After a change run `pytest tests/rope/test_rope.py`: no reset may lose its code.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, InvalidInput, inner, kernel
from knotgym.topology import GaussCode, label_many, same_spot

if TYPE_CHECKING:
    from knotgym.rope.model import Rope


_MOST = 20_000  # points of a curve whose pairs of chords are all looked at
_SAME = 1e-9  # distance, relative to the size of a curve, at which two places are the same
_JUMP = 10  # a chord so many times longer than the median one belongs to no curve
# Of 1,000 resets of states whose noise survival is 0.25, the least that sets allow, 3 need more
# than _FULL_DRAWS (0.75^20); _SMALLER_DRAWS end at a millionth of the scale, where no code changes.
_FULL_DRAWS = 20  # draws at full scale
_SMALLER_DRAWS = 20  # further draws, each at half the scale of the one before
_GAP = 1e-6  # metres; what is closed at all is closed within 1e-12


@kernel
def _close(along: Array) -> None:
    """Change unit vectors (beads, 3) as little as possible, in place, so that their sum is zero.

    Equal chords in these directions are closed.
    """
    # The unit vectors u_i with sum 0 that minimize sum |u_i - a_i|^2 are the normalized a_i - s,
    # where s is the Lagrange multiplier of the constraint. Newton's method on s:
    #     f(s) = sum_i (a_i - s) / |a_i - s| = 0,
    # with the Jacobian df/ds = -sum_i (I - u_i u_i^T) / |a_i - s|, u_i the normalized vectors.
    # Sums run bead by bead, so that the result is the same on every machine.
    beads = len(along)
    norm, unit = np.empty(beads), np.empty((beads, 3))
    m, shift = np.empty((3, 4)), np.empty(3)  # m: the Jacobian, and the right side beside it
    shift[:] = 0.0
    for _ in range(50):
        m[:] = 0.0
        for i in range(beads):
            x, y, z = along[i, 0] - shift[0], along[i, 1] - shift[1], along[i, 2] - shift[2]
            norm[i] = np.sqrt(x * x + y * y + z * z)
            unit[i, 0], unit[i, 1], unit[i, 2] = x / norm[i], y / norm[i], z / norm[i]
            for r in range(3):
                m[r, 3] += unit[i, r]
        if max(abs(m[0, 3]), abs(m[1, 3]), abs(m[2, 3])) < 1e-13 * beads:
            break
        for i in range(beads):
            for r in range(3):
                for c in range(r, 3):
                    identity = 1.0 if r == c else 0.0
                    m[r, c] += (identity - unit[i, r] * unit[i, c]) / norm[i]
        m[1, 0], m[2, 0], m[2, 1] = m[0, 1], m[0, 2], m[1, 2]
        _add_solution(m, shift)
    for i in range(beads):
        for c in range(3):
            along[i, c] = unit[i, c]


@kernel
def _turned(points: Array, units: Array, lengths: Array, drawn: Array) -> Array:
    """Turn the chords of n chains, close them, and move them: float64 (n, beads, 3), metres.

    Args:
        points: float64 (n, beads, 3) or (1, beads, 3), metres.
        units: likewise, directions of the chords.
        lengths: (n,) or (1,), of the new chords, metres.
        drawn: (n, beads + 2, 3), rotation vectors of the joints and of the whole rope, and its
            shift.
    """
    n, beads = len(drawn), points.shape[1]
    out, curve = np.empty((n, beads, 3)), np.empty((beads, 3))
    for chain in range(n):
        row = chain % len(units)
        given, moved = units[row], out[chain]
        for c in range(3):
            # Bead i turns by the sum of the joint rotations up to it. Rotation vectors are added as
            # if they commuted, which holds to first order in the small scale.
            total = mean = 0.0
            for i in range(beads):
                total += drawn[chain, i, c]
                curve[i, c] = total
            # A Brownian bridge: the sum goes back to zero at the last bead, where the loop closes.
            for i in range(beads):
                curve[i, c] -= (i + 1) / beads * total
                mean += curve[i, c]
            # the mean rotation is the whole rope's: take it out, and only the one drawn is left
            whole = drawn[chain, beads, c] - mean / beads
            for i in range(beads):
                curve[i, c] += whole
        for i in range(beads):  # Rodrigues' formula
            x, y, z = curve[i, 0], curve[i, 1], curve[i, 2]
            angle = np.sqrt(x * x + y * y + z * z)
            cosine, sine, size = math.cos(angle), math.sin(angle), max(angle, 1e-100)
            x, y, z = x / size, y / size, z / size
            u, v, w = given[i, 0], given[i, 1], given[i, 2]
            share = x * u + y * v + z * w
            e, f, g = x * share, y * share, z * share
            curve[i, 0] = e + (u - e) * cosine + (y * w - z * v) * sine
            curve[i, 1] = f + (v - f) * cosine + (z * u - x * w) * sine
            curve[i, 2] = g + (w - g) * cosine + (x * v - y * u) * sine
        _close(curve)
        for c in range(3):
            middle = mean = before = 0.0
            for i in range(beads):
                moved[i, c] = before * lengths[row]
                before, mean = before + curve[i, c], mean + moved[i, c]
                middle += points[row, i, c]
            for i in range(beads):
                moved[i, c] = moved[i, c] - mean / beads + middle / beads + drawn[chain, -1, c]
    return out


@inner
def _add_solution(m: Array, shift: Array) -> None:
    """Add the solution of three linear equations (3, 4) to `shift`; `m` is overwritten.

    `np.linalg.solve` rounds differently from one processor to the next, because BLAS has other
    kernels for each, and what is laid here starts episodes that are replayed bit by bit. This is
    Gaussian elimination with partial pivoting, in the order of OpenBLAS on processors with AVX2:
    columns are multiplied by the pivot's reciprocal, and the last pivot subtracts its two products
    at once.
    """
    first = 0
    for row in range(1, 3):
        if abs(m[row, 0]) > abs(m[first, 0]):
            first = row
    a, b, c = m[first], m[0 if first == 1 else 1], m[0 if first == 2 else 2]
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
    shift[0] += (a[3] - a[2] * z - a[1] * y) / a[0]
    shift[1] += y
    shift[2] += z


def directions(points: Array) -> Array:
    """Return the unit vectors along the edges of closed curves (n, beads, 3)."""
    edges = np.roll(points, -1, axis=1) - points
    return edges / np.linalg.norm(edges, axis=2, keepdims=True)


def equal_chords(curve: Array, count: int) -> Array:
    """Cut a closed polyline into a closed chain of `count` chords of length 1.

    The cuts move along the polyline until the chords are nearly equal; this fails only where the
    polyline doubles back within a chord. The chords are then scaled to length 1, and a correction
    of their directions closes the chain (`_close`).

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
    along = chord / np.maximum(lengths, np.finfo(float).tiny)
    _close(along)
    ends = np.cumsum(along, axis=0)
    return np.roll(ends, 1, axis=0) - ends.mean(axis=0)


def require_embedded(curve: Array) -> None:
    """Check that a closed polyline is embedded, as every knot is.

    Args:
        curve: float64 (n, 3), finite; the last point is joined to the first. Points may be
            repeated, the first at the end, too.

    Raises:
        InvalidInput: the curve jumps, meets itself, or has more than 20,000 points.
    """
    if len(curve) > _MOST:
        raise InvalidInput(f"a curve has at most {_MOST} points, got {len(curve)}")
    unit = (curve - curve[0]) / np.ptp(curve, axis=0).max()
    kept = np.flatnonzero(~same_spot(unit))
    points = unit[kept]
    chords = np.roll(points, -1, axis=0) - points
    lengths = np.linalg.norm(chords, axis=1)
    # How long the last may be is for `Rope.from_curve` to judge, or its author repeated a point.
    longest, usual = int(lengths[:-1].argmax()), float(np.median(lengths))
    if lengths[longest] > _JUMP * usual:
        raise InvalidInput(
            f"points {kept[longest] + 1} and {kept[longest] + 2} are {lengths[longest] / usual:.0f}"
            " times as far apart as others usually are: two curves need to be parted, and a long"
            " straight line needs points"
        )
    along = chords / lengths[:, None]
    turned_back = np.flatnonzero((along * np.roll(along, -1, axis=0)).sum(axis=1) < -1 + _SAME)
    if len(turned_back):
        one, other = int(turned_back[0]), (int(turned_back[0]) + 1) % len(points)
    else:
        low, high = (end(points, np.roll(points, -1, axis=0)) for end in (np.minimum, np.maximum))
        one, other = _meeting(
            points, low - _SAME, high + _SAME, np.argsort(low[:, 0], kind="stable")
        )
    if one != other:
        raise InvalidInput(
            f"it isn't embedded, so it has no knot: after point {kept[one] + 1} it meets itself"
            f" after point {kept[other] + 1}"
        )


@kernel
def _meeting(points: Array, low: Array, high: Array, order: NDArray[np.int64]) -> tuple[int, int]:
    """Return two chords that meet and aren't neighbours; (0, 0) if there are none.

    Args:
        points: float64 (n, 3); chord i leads from point i to the next.
        low, high: (n, 3), the bounding box of each chord.
        order: chords by `low[:, 0]`. One that begins beyond the end of another in x can't meet it,
            and neither can those after it.
    """
    n = len(points)
    for at in range(n):
        i = order[at]
        for later in range(at + 1, n):
            j = order[later]
            if low[j, 0] > high[i, 0]:
                break
            apart = (low[j, 1] > high[i, 1]) | (low[i, 1] > high[j, 1])
            apart |= (low[j, 2] > high[i, 2]) | (low[i, 2] > high[j, 2])
            if apart or (i - j) % n in (0, 1, n - 1):
                continue
            a, b, c, d = points[i], points[(i + 1) % n], points[j], points[(j + 1) % n]
            if _segment_distance(a, b, c, d) <= _SAME:
                return min(i, j), max(i, j)
    return 0, 0


def _arc_lengths(points: Array) -> Array:
    """Return the arc length of a polyline at each of its n points: float64 (n,), from 0."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


@kernel
def clearance(points: Array, within: float) -> float:
    """Return the smallest distance between the axes of two beads that aren't neighbours, metres.

    The beads overlap if it is below their diameter.

    Args:
        points: float64 (beads, 3), metres, the vertices of a closed rope.
        within: what is returned if all beads are at least this far apart; the smaller, the faster.
    """
    beads = len(points)
    best = within
    middle, half = np.empty((beads, 3)), np.empty(beads)
    for i in range(beads):
        square = 0.0
        for k in range(3):
            a, b = points[i, k], points[(i + 1) % beads, k]
            middle[i, k] = 0.5 * (a + b)
            square += (b - a) ** 2
        half[i] = 0.5 * np.sqrt(square)
    for i in range(beads):
        # bead 0 and the last bead are neighbours too
        for j in range(i + 2, beads if i > 0 else beads - 1):
            # the distance of the midpoints less both half lengths is a lower bound, which rules
            # out nearly all pairs; squared, it needs no root
            far = 0.0
            for k in range(3):
                far += (middle[i, k] - middle[j, k]) ** 2
            if far >= (best + half[i] + half[j]) ** 2:
                continue
            ends = points[i], points[(i + 1) % beads], points[j], points[(j + 1) % beads]
            best = min(best, _segment_distance(*ends))
    return best


@inner
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


def start_qpos(
    rope: Rope,
    qpos: Array,
    points: Array,
    codes: Sequence[GaussCode],
    scale: float,
    rngs: Sequence[np.random.Generator],
    least: ArrayLike | None = None,
) -> Array:
    """Perturb the generalized positions of n ropes while keeping their Gauss codes and chirality.

    Noise that changes the code, or that deepens the overlap of two beads by more than 1 mm, is
    rejected and drawn again. After _FULL_DRAWS rejections the scale halves with every draw; after
    _SMALLER_DRAWS more the positions are returned without noise.

    Args:
        rope: the rope model.
        qpos: float64 (n, nq); not modified.
        points: float64 (n, beads, 3), metres, the vertices of qpos.
        codes: the Gauss codes of points.
        scale: scale of the noise, see `noised`.
        rngs: one for each rope, the source of its draws; not used if the scale is 0.
        least: (n,), `Rope.least_clearance` of each, if it is known.

    Returns:
        float64 (n, nq), a new array.
    """
    started = np.array(qpos, dtype=np.float64)
    if scale == 0:
        return started
    # a writable array, because numba would compile kernels again for a read-only one
    writable = np.require(points, np.float64, ["C", "W"])
    if least is None:
        least = [rope.least_clearance(curve) for curve in writable]
    bound = np.asarray(least, dtype=np.float64)
    # All ropes that are left draw at once, but each from its own generator: how often one is
    # refused changes nothing for the others.
    left = list(range(len(writable)))
    for draw in range(_FULL_DRAWS + _SMALLER_DRAWS):
        if not left:
            break
        reduced = scale * 0.5 ** max(0, draw - _FULL_DRAWS + 1)
        moved = noised(writable[left], reduced, [rngs[row] for row in left])
        # much noise may leave a rope that no small correction closes
        # The chords are equal and their directions sum to 0, so the closing chord has a bead's
        # length unless Newton's method in `_close` didn't converge.
        gaps = np.linalg.norm(moved[:, 0] - moved[:, -1], axis=1) - rope.config.bead_length
        closed = np.abs(gaps) < _GAP
        moved[~closed] = writable[left][~closed]
        kept = [
            ok and code == codes[row] and clearance(one, bound[row]) >= bound[row]
            for row, one, code, ok in zip(left, moved, label_many(moved), closed, strict=True)
        ]
        taken = np.array(kept)
        started[np.array(left)[taken]] = rope.qpos(moved[taken])
        left = [row for row, fits in zip(left, kept, strict=True) if not fits]
    return started


def noised(points: ArrayLike, scale: float, rngs: Sequence[np.random.Generator]) -> Array:
    """Perturb every joint of n closed ropes, the whole ropes' orientation and their position.

    Each joint turns by a rotation vector drawn uniformly from [-scale, scale]^3 radians; their sum
    round the loop is subtracted evenly, so that the directions match where the loop closes. The
    whole rope turns by one more such vector and shifts by a vector from [-scale, scale]^3 metres.
    The smallest correction of the bead directions then closes the rope (`_close`).

    Args:
        points: float64 (n, beads, 3), metres, or (1, beads, 3) for n times the same rope.
        scale: scale of the uniform noise, radians and metres.
        rngs: one for each rope; always 3 * beads + 6 draws are taken from it.

    Returns:
        float64 (n, beads, 3), metres, with equal chords and exactly closed.
    """
    beads = np.shape(points)[1]
    # one call draws the same numbers as one for the joints, one for the turn and one for the shift
    drawn = np.array([rng.uniform(-scale, scale, (beads + 2, 3)) for rng in rngs])
    p = np.array(points, dtype=np.float64)
    chord = np.roll(p, -1, axis=1) - p
    lengths = np.sqrt(chord[..., 0] ** 2 + chord[..., 1] ** 2 + chord[..., 2] ** 2)
    ordered = np.sort(lengths, axis=1)
    medians = (ordered[:, (beads - 1) // 2] + ordered[:, beads // 2]) / 2
    return _turned(p, chord / lengths[..., None], medians, drawn)
