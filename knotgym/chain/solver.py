from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.chain.contact import (
    DRIFT,
    LEAP,
    LOOKAHEAD,
    closest,
    list_pairs,
    middles,
    relative_motion,
)
from knotgym.chain.dynamics import (
    LENGTH,
    MASS,
    assemble,
    set_lengths,
    tangents,
    turn_sides,
)
from knotgym.chain.linear import backward, factor, forward
from knotgym.chain.simd import LANES, any_below, fma, load, put, where_below

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Substeps of an action in 24ths, short ones first: the force jumps when an action begins
SCHEDULE = np.array([1, 1, 2, 2, 4, 4, 5, 5])
TICKS = 64  # of a 24th: the shortest substep is one tick
ROWS = 40  # contacts of a rope in a substep at most
ROUNDS = 60
SAFE = 1e-5  # m, that two edges stay apart at least

# what happened to a rope in an action
SUBSTEPS, REJECTED, CONTACTS, CUT = range(4)


@njit(cache=True, nogil=True)
def advance(
    states: Array,
    beads: Ints,
    forces: Array,
    numbers: Array,
    damping: Array,
    contact: Array,
    duration: float,
    counts: Ints,
) -> None:
    """Move ropes through one action, in place.

    Args:
        states: float64 (ropes, n, 10): of each vertex position, velocity; of each bead its side and
            spin.
        beads: int64 (ropes,), pulled.
        forces: float64 (ropes, 3), newtons.
        numbers, damping: as of `dynamics`.
        contact: radius, stiffness, damping, floor.
        duration: of the action, seconds.
        counts: int64 (ropes, 4); written.
    """
    ropes, n = states.shape[0], states.shape[1]
    vectors = (n, 3, LANES)
    x, v, side, spin = np.empty(vectors), np.empty(vectors), np.empty(vectors), np.empty((n, LANES))
    new, fresh, turned = np.empty(vectors), np.empty(vectors), np.empty(vectors)
    spun = np.empty((n, LANES))
    pull, listed = np.zeros(vectors), np.empty(vectors)
    tangent, before = np.empty(vectors), np.empty(vectors)
    joint, bead = np.empty((n, 13, LANES)), np.empty((n, 12, LANES))
    diag, near, far = np.empty((n, 10, LANES)), np.empty((n, 16, LANES)), np.empty((n, 12, LANES))
    arrow, corner = np.empty((n, 12, LANES)), np.empty((6, LANES))
    right, half_right = np.empty((n + 1, 4, LANES)), np.empty((n + 1, 4, LANES))
    step, half, zero = np.empty((1, LANES)), np.empty((1, LANES)), np.zeros((1, LANES))
    middle, moved = np.empty(vectors), np.empty((n, LANES))
    pairs = np.empty((n * n // 2, 2), dtype=np.int64)
    rows = np.zeros((ROWS, 8, LANES))  # place on either edge, normal, distance, two edges
    found = np.zeros(LANES, dtype=np.int64)
    rope = np.full(LANES, -1)
    stage, left, tick = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64), np.ones(LANES, np.int64)
    accepted = np.zeros(LANES, dtype=np.bool_)
    unit = duration / (24 * TICKS)
    waiting, listing, listed_count = 0, True, 0
    counts[:] = 0
    while True:
        running = False
        for lane in range(LANES):
            if rope[lane] < 0 and waiting < ropes:
                rope[lane] = waiting
                _take(states[waiting], beads[waiting], forces[waiting], lane, x, v, side, spin, pull)
                stage[lane], left[lane] = 0, SCHEDULE[0] * TICKS
                tick[lane] = left[lane]
                waiting, listing = waiting + 1, True
            if rope[lane] >= 0:
                running = True
            elif waiting >= ropes and not running and lane == 0:
                pass
        if not running:
            break
        for lane in range(LANES):
            if rope[lane] < 0 and counts.shape[0] > 0 and left[lane] == 0:
                # a lane without a rope does what another does, and nobody looks
                source = 0
                for other in range(LANES):
                    if rope[other] >= 0:
                        source = other
                _copy_lane(lane, source, x, v, side, spin, pull)
                tick[lane], left[lane] = tick[source], -1
            step[0, lane] = tick[lane] * unit
            half[0, lane] = 0.5 * step[0, lane]
        if not listing:
            listing = _drifted(x, listed)
        if listing:
            middles(x, middle)
            listed_count = list_pairs(middle, pairs)
            listed[:] = x
            listing = False
        # velocities without contact
        tangents(x, v, zero, before)
        tangents(x, v, half, tangent)
        assemble(
            tangent, side, v, spin, v, spin, pull, step, numbers, damping, joint, bead,
            diag, near, far, arrow, corner, right,
        )
        factor(diag, near, far, arrow, corner)
        forward(diag, near, far, arrow, corner, right, 0)
        half_right[:] = right
        backward(diag, near, far, arrow, corner, right)
        _read(right, fresh, spun)
        # contact
        middles(x, middle)
        _find_rows(
            x, fresh, before, middle, pairs, listed_count, step, contact, moved, rows, found
        )
        most = 0
        for lane in range(LANES):
            most = max(most, found[lane])
        if most > 0:
            _resolve(
                rows, found, most, fresh, step, contact, diag, near, far, arrow, corner, half_right
            )
            backward(diag, near, far, arrow, corner, half_right)
            _read(half_right, fresh, spun)
        # positions
        h = load(step, (0,))
        for i in range(n):
            for c in range(3):
                put(new, (i, c), fma(h, load(fresh, (i, c)), load(x, (i, c))))
        set_lengths(new, numbers[LENGTH], 2)
        _judge(x, new, before, middle, moved, pairs, listed_count, numbers[LENGTH], accepted)
        tangents(new, fresh, zero, tangent)
        turned[:] = side
        turn_sides(turned, before, tangent, spun, step)
        for lane in range(LANES):
            if rope[lane] < 0:
                continue
            own = rope[lane]
            if accepted[lane]:
                for i in range(n):
                    for c in range(3):
                        x[i, c, lane], v[i, c, lane] = new[i, c, lane], fresh[i, c, lane]
                        side[i, c, lane] = turned[i, c, lane]
                    spin[i, lane] = spun[i, lane]
                counts[own, SUBSTEPS] += 1
                counts[own, CONTACTS] += found[lane]
                left[lane] -= tick[lane]
                if left[lane] == 0:
                    stage[lane] += 1
                    if stage[lane] < len(SCHEDULE):
                        left[lane] = SCHEDULE[stage[lane]] * TICKS
                        tick[lane] = min(left[lane], 2 * tick[lane])
                        if tick[lane] * 2 > left[lane]:
                            tick[lane] = left[lane]
                else:
                    tick[lane] = min(tick[lane], left[lane])
            else:
                counts[own, REJECTED] += 1
                tick[lane] = tick[lane] // 2
                if tick[lane] == 0:
                    counts[own, CUT] = left[lane]
                    for later in range(stage[lane] + 1, len(SCHEDULE)):
                        counts[own, CUT] += SCHEDULE[later] * TICKS
                    for i in range(n):
                        spin[i, lane] = 0.0
                        for c in range(3):
                            v[i, c, lane] = 0.0
                    stage[lane] = len(SCHEDULE)
            if stage[lane] >= len(SCHEDULE):
                for i in range(n):
                    for c in range(3):
                        states[own, i, c] = x[i, c, lane]
                        states[own, i, 3 + c] = v[i, c, lane]
                        states[own, i, 6 + c] = side[i, c, lane]
                    states[own, i, 9] = spin[i, lane]
                rope[lane], left[lane], tick[lane] = -1, 0, 1


@njit(nogil=True)
def _take(
    state: Array, bead: int, force: Array, lane: int, x: Array, v: Array, side: Array, spin: Array,
    pull: Array,
) -> None:
    n = len(state)
    for i in range(n):
        for c in range(3):
            x[i, c, lane], v[i, c, lane] = state[i, c], state[i, 3 + c]
            side[i, c, lane] = state[i, 6 + c]
            pull[i, c, lane] = 0.0
        spin[i, lane] = state[i, 9]
    for c in range(3):
        pull[bead, c, lane] = 0.5 * force[c]
        pull[(bead + 1) % n, c, lane] = 0.5 * force[c]


@njit(nogil=True)
def _copy_lane(
    lane: int, source: int, x: Array, v: Array, side: Array, spin: Array, pull: Array
) -> None:
    for i in range(len(x)):
        for c in range(3):
            x[i, c, lane], v[i, c, lane] = x[i, c, source], v[i, c, source]
            side[i, c, lane], pull[i, c, lane] = side[i, c, source], pull[i, c, source]
        spin[i, lane] = spin[i, source]


@njit(nogil=True)
def _read(right: Array, v: Array, spin: Array) -> None:
    n = len(v)
    for i in range(n):
        for c in range(3):
            put(v, (i, c), load(right, (n if i == 0 else i, c)))
        put(spin, (i,), load(right, (i, 3)))


@njit(nogil=True)
def _drifted(x: Array, listed: Array) -> bool:
    bound = -DRIFT * DRIFT
    for i in range(len(x)):
        a = load(x, (i, 0)) - load(listed, (i, 0))
        b = load(x, (i, 1)) - load(listed, (i, 1))
        c = load(x, (i, 2)) - load(listed, (i, 2))
        if any_below(-fma(a, a, fma(b, b, c * c)), bound):
            return True
    return False


@njit(nogil=True)
def _find_rows(
    x: Array,
    v: Array,
    tangent: Array,
    middle: Array,
    pairs: Ints,
    count: int,
    step: Array,
    contact: Array,
    motion: Array,
    rows: Array,
    found: Ints,
) -> None:
    n = len(x)
    h = load(step, (0,))
    touch = 2.0 * contact[0]
    _motion(v, motion)
    found[:] = 0
    spot = np.empty((7, LANES))
    reach0 = 1.01 * contact[4] + touch
    for p in range(count):
        i, j = pairs[p, 0], pairs[p, 1]
        dx = load(middle, (j, 0)) - load(middle, (i, 0))
        dy = load(middle, (j, 1)) - load(middle, (i, 1))
        dz = load(middle, (j, 2)) - load(middle, (i, 2))
        nearer = min(h * (load(motion, (i,)) + load(motion, (j,))), LOOKAHEAD)
        reach = nearer + reach0
        if any_below(fma(dx, dx, fma(dy, dy, dz * dz)), reach * reach):
            _try_row(x, v, i, j, h, touch, spot, rows, found)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        k = j + 1 if j + 1 < n else 0
        if any_below(_bend(tangent, i, j, k), 0.05):
            _try_row(x, v, i, k, h, touch, spot, rows, found)


@njit(nogil=True)
def _motion(v: Array, motion: Array) -> None:
    """The larger speed (or way) of each edge's two vertices."""
    n = len(v)
    x, y, z = load(v, (0, 0)), load(v, (0, 1)), load(v, (0, 2))
    last = math.sqrt(fma(x, x, fma(y, y, z * z)))
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        x, y, z = load(v, (j, 0)), load(v, (j, 1)), load(v, (j, 2))
        own = math.sqrt(fma(x, x, fma(y, y, z * z)))
        put(motion, (i,), max(last, own))
        last = own


@njit(nogil=True)
def _try_row(
    x: Array, v: Array, i: int, j: int, h: Any, touch: float, spot: Array, rows: Array, found: Ints
) -> None:
    n = len(x)
    k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
    far, s, t, nx, ny, nz = closest(x, i, j)
    shrink = 1.0 / far
    nx, ny, nz = shrink * nx, shrink * ny, shrink * nz
    dx = fma(t, load(v, (m, 0)), fma(1.0 - t, load(v, (j, 0)), -fma(s, load(v, (k, 0)), (1.0 - s) * load(v, (i, 0)))))
    dy = fma(t, load(v, (m, 1)), fma(1.0 - t, load(v, (j, 1)), -fma(s, load(v, (k, 1)), (1.0 - s) * load(v, (i, 1)))))
    dz = fma(t, load(v, (m, 2)), fma(1.0 - t, load(v, (j, 2)), -fma(s, load(v, (k, 2)), (1.0 - s) * load(v, (i, 2)))))
    apart = fma(nx, dx, fma(ny, dy, nz * dz))
    then = fma(h, apart, far)
    if not any_below(then, touch):
        return
    put(spot, (0,), s)
    put(spot, (1,), t)
    put(spot, (2,), nx)
    put(spot, (3,), ny)
    put(spot, (4,), nz)
    put(spot, (5,), far)
    put(spot, (6,), then)
    for lane in range(LANES):
        row = found[lane]
        if spot[6, lane] < touch and spot[5, lane] < touch + LOOKAHEAD and row < ROWS:
            # a vertex belongs to the edge that begins there
            if spot[0, lane] == 1.0 or spot[1, lane] == 1.0:
                continue
            for c in range(6):
                rows[row, c, lane] = spot[c, lane]
            rows[row, 6, lane], rows[row, 7, lane] = i, j
            found[lane] = row + 1


@njit(nogil=True)
def _resolve(
    rows: Array, found: Ints, most: int, v: Array, step: Array, contact: Array, diag: Array,
    near: Array, far: Array, arrow: Array, corner: Array, right: Array,
) -> None:
    n = len(v)
    column = np.zeros((most, n + 1, 4, LANES))
    scaled = np.empty((n + 1, 4, LANES))
    weight = np.empty((most, most, LANES))
    start = np.zeros((most, LANES))
    force = np.zeros((most, LANES))
    for r in range(most):
        first = n
        for lane in range(LANES):
            if r < found[lane]:
                i, j = int(rows[r, 6, lane]), int(rows[r, 7, lane])
                s, t = rows[r, 0, lane], rows[r, 1, lane]
                k, m = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
                for c in range(3):
                    normal = rows[r, 2 + c, lane]
                    column[r, i if i > 0 else n, c, lane] -= (1.0 - s) * normal
                    column[r, k if k > 0 else n, c, lane] -= s * normal
                    column[r, j if j > 0 else n, c, lane] += (1.0 - t) * normal
                    column[r, m if m > 0 else n, c, lane] += t * normal
                    own = (1.0 - s) * v[i, c, lane] + s * v[k, c, lane]
                    other = (1.0 - t) * v[j, c, lane] + t * v[m, c, lane]
                    start[r, lane] += normal * (other - own)
                for place in (i, k, j, m):
                    if place > 0:
                        first = min(first, place)
        forward(diag, near, far, arrow, corner, column[r], first)
        for i in range(n + 1):
            if i < n:
                for c, e in enumerate((0, 2, 5, 9)):
                    put(scaled, (i, c), load(column, (r, i, c)) * load(diag, (i, e)))
            else:
                for c, e in enumerate((0, 2, 5)):
                    put(scaled, (i, c), load(column, (r, i, c)) * load(corner, (e,)))
                put(scaled, (i, 3), 0.0)
        for q in range(r + 1):
            a, b = 0.0 * load(step, (0,)), 0.0 * load(step, (0,))
            for i in range(first, n + 1):
                a = fma(load(scaled, (i, 0)), load(column, (q, i, 0)), a)
                b = fma(load(scaled, (i, 1)), load(column, (q, i, 1)), b)
                a = fma(load(scaled, (i, 2)), load(column, (q, i, 2)), a)
                b = fma(load(scaled, (i, 3)), load(column, (q, i, 3)), b)
            put(weight, (r, q), a + b)
            put(weight, (q, r), a + b)
    for lane in range(LANES):
        _push(rows, found[lane], lane, step[0, lane], contact, weight, start, force)
    for r in range(most):
        f = load(force, (r,))
        for i in range(n + 1):
            for c in range(4):
                put(right, (i, c), fma(f, load(column, (r, i, c)), load(right, (i, c))))


@njit(nogil=True)
def _push(
    rows: Array, count: int, lane: int, h: float, contact: Array, weight: Array, start: Array,
    force: Array,
) -> None:
    """Find the forces of a lane's contacts, by projected Gauss-Seidel."""
    for _ in range(ROUNDS):
        change = 0.0
        for r in range(count):
            speed = start[r, lane]
            for q in range(count):
                if q != r:
                    speed += weight[r, q, lane] * force[q, lane]
            own = weight[r, r, lane]
            gap = rows[r, 5, lane] - 2.0 * contact[0]
            slope = contact[1] * h + contact[2]
            if gap > 0.0:
                soft = slope * -(gap / h + speed) / (1.0 + slope * own)
            else:
                soft = (-contact[1] * gap - slope * speed) / (1.0 + slope * own)
            hard = (-(rows[r, 5, lane] - contact[3]) / h - speed) / own
            found = max(0.0, max(soft, hard))
            change = max(change, abs(found - force[r, lane]))
            force[r, lane] = found
        if change < 1e-9:
            break


@njit(nogil=True)
def _judge(
    x: Array, new: Array, tangent: Array, middle: Array, motion: Array, pairs: Ints, count: int,
    length: float,
    accepted: NDArray[np.bool_],
) -> None:
    """Accept a substep if it can't have taken strands through each other."""
    n = len(x)
    accepted[:] = True
    for lane in range(LANES):
        for i in range(n):
            square = 0.0
            for c in range(3):
                own = new[i, c, lane] - x[i, c, lane]
                square += own * own
            if not square < LEAP * LEAP:
                accepted[lane] = False
    turn = np.empty((n, LANES))
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        a0, b0 = load(new, (i, 0)) - load(x, (i, 0)), load(new, (j, 0)) - load(x, (j, 0))
        a1, b1 = load(new, (i, 1)) - load(x, (i, 1)), load(new, (j, 1)) - load(x, (j, 1))
        a2, b2 = load(new, (i, 2)) - load(x, (i, 2)), load(new, (j, 2)) - load(x, (j, 2))
        one, two = fma(a0, a0, fma(a1, a1, a2 * a2)), fma(b0, b0, fma(b1, b1, b2 * b2))
        put(motion, (i,), math.sqrt(max(one, two)))
        d0, d1, d2 = b0 - a0, b1 - a1, b2 - a2
        put(turn, (i,), math.sqrt(fma(d0, d0, fma(d1, d1, d2 * d2))))
    middles(new, middle)
    spot = np.empty((1, LANES))
    for p in range(count):
        i, j = pairs[p, 0], pairs[p, 1]
        dx = load(middle, (j, 0)) - load(middle, (i, 0))
        dy = load(middle, (j, 1)) - load(middle, (i, 1))
        dz = load(middle, (j, 2)) - load(middle, (i, 2))
        reach = load(motion, (i,)) + load(motion, (j,)) + (1.01 * length + SAFE)
        if any_below(fma(dx, dx, fma(dy, dy, dz * dz)), reach * reach):
            _check(x, new, i, j, spot, accepted)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        k = j + 1 if j + 1 < n else 0
        sharp = load(turn, (i,)) + load(turn, (j,)) + load(turn, (k,))
        if any_below(-sharp, -0.5 * length) or any_below(_bend(tangent, i, j, k), 0.05):
            _check(x, new, i, k, spot, accepted)
    # lengths
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        for lane in range(LANES):
            square = 0.0
            for c in range(3):
                own = new[j, c, lane] - new[i, c, lane]
                square += own * own
            if not abs(square - length * length) < 2e-3 * length * length:
                accepted[lane] = False


@njit(nogil=True)
def _bend(tangent: Array, i: int, j: int, k: int) -> Any:
    """The smaller cosine of the angles between edge j and its neighbours i and k."""
    x, y, z = load(tangent, (j, 0)), load(tangent, (j, 1)), load(tangent, (j, 2))
    one = fma(load(tangent, (i, 0)), x, fma(load(tangent, (i, 1)), y, load(tangent, (i, 2)) * z))
    two = fma(load(tangent, (k, 0)), x, fma(load(tangent, (k, 1)), y, load(tangent, (k, 2)) * z))
    return min(one, two)


@njit(nogil=True)
def _check(
    x: Array, new: Array, i: int, j: int, spot: Array, accepted: NDArray[np.bool_]
) -> None:
    """Refuse lanes where edges i and j may have met.

    Their distance is at least dist(0) - t m and dist(1) - (1 - t) m at time t in [0, 1], if m is
    their relative motion; one of them is above 0 at all times if dist(0) + dist(1) > m.
    """
    both = closest(x, i, j)[0] + closest(new, i, j)[0]
    put(spot, (0,), both - relative_motion(x, new, i, j))
    for lane in range(LANES):
        if not spot[0, lane] > SAFE:
            accepted[lane] = False
