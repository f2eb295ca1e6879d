"""Ropes moved through an action: the loop over substeps.

An action lasts 0.192 s and its force is constant. `SCHEDULE` cuts it into substeps, short ones
first, as velocities jump when the force does and settle within 20 ms. Each solves the linear system
of `dynamics`, adds the contact forces of `contact`, moves the vertices by h v, sets the lengths of
the edges and turns the beads' sides. If `contact.judge` can't prove that no strands passed each
other, nothing of that is kept and the substep is tried again with half its length. A rope whose
shortest substep is rejected stays where it was and comes to rest: the rest of its action is taken
back, and counted.

LANES ropes are moved at once. Each has its own time and substep, and none can tell what the others
do: a rope moves as it does alone, to the bit. A lane whose action is over takes the next rope.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.chain.banded import backward, factor, forward
from knotgym.chain.contact import (
    DRIFT,
    LISTED,
    ROWS,
    find_rows,
    judge,
    list_pairs,
    middles,
    push_apart,
)
from knotgym.chain.dynamics import LENGTH, assemble, set_lengths, tangents, turn_sides
from knotgym.chain.simd import LANES, any_below, fma, load, put

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SCHEDULE = (1, 2, 3, 4, 4, 5, 5)  # lengths of the substeps, in shares of an action
TICKS = 64  # a substep is halved at most until it is a 64th of one share
STATE = 10  # numbers of a vertex: position, velocity; of the bead that begins there: side, spin
SUBSTEPS, REJECTED, CONTACTS, LOST = range(4)  # counted for each rope; LOST in ticks


@njit(cache=True, nogil=True)
def advance(
    states: Array,
    beads: Ints,
    forces: Array,
    numbers: Array,
    damping: Array,
    contact: Array,
    duration: float,
    schedule: Ints,
    counts: Ints,
) -> None:
    """Move ropes through one action, in place.

    Args:
        states: float64 (ropes, n, STATE).
        beads: int64 (ropes,), pulled at their centres.
        forces: float64 (ropes, 3), newtons.
        numbers, damping: of the rope, see `dynamics`.
        contact: see `contact`.
        duration: of the action, seconds.
        schedule: as SCHEDULE.
        counts: int64 (ropes, 4): substeps taken, substeps rejected, contacts summed over substeps,
            ticks of the action that were taken back; written.
    """
    ropes, n = states.shape[0], states.shape[1]
    vectors = (n, 3, LANES)
    x, v, side, spin = np.empty(vectors), np.empty(vectors), np.empty(vectors), np.empty((n, LANES))
    # the same after a substep
    x1, v1, side1, spin1 = np.empty_like(x), np.empty_like(v), np.empty_like(side), np.empty_like(spin)
    pull, tangent, tangent1 = np.zeros(vectors), np.empty(vectors), np.empty(vectors)
    joint, bead = np.empty((n, 13, LANES)), np.empty((n, 12, LANES))
    diag, near, far = np.empty((n, 10, LANES)), np.empty((n, 16, LANES)), np.empty((n, 12, LANES))
    arrow, corner = np.empty((n, 12, LANES)), np.empty((6, LANES))
    right, loaded = np.empty((n + 1, 4, LANES)), np.empty((n + 1, 4, LANES))
    step, half, zero = np.empty((1, LANES)), np.empty((1, LANES)), np.zeros((1, LANES))
    middle, motion, listed = np.empty(vectors), np.empty((n, LANES)), np.empty(vectors)
    start, other = np.empty(n + 1, dtype=np.int64), np.empty(n * n // 2, dtype=np.int64)
    start_far, other_far = np.empty_like(start), np.empty_like(other)
    rows, found = np.zeros((ROWS, 8, LANES)), np.zeros(LANES, dtype=np.int64)
    accepted = np.zeros(LANES, dtype=np.bool_)
    rope = np.full(LANES, -1)  # whose lane it is; -1 once no rope waits
    stage = np.zeros(LANES, dtype=np.int64)  # of the schedule
    left = np.zeros(LANES, dtype=np.int64)  # ticks of the stage
    tick = np.ones(LANES, dtype=np.int64)  # of the next substep
    unit = duration / (schedule.sum() * TICKS)
    waiting, stale = 0, True
    counts[:] = 0
    while True:
        busy = -1
        for lane in range(LANES):
            if rope[lane] < 0 and waiting < ropes:
                _take(
                    states[waiting], beads[waiting], forces[waiting], lane, x, v, side, spin, pull
                )
                rope[lane], stage[lane] = waiting, 0
                left[lane] = tick[lane] = schedule[0] * TICKS
                waiting, stale = waiting + 1, True
            if rope[lane] >= 0:
                busy = lane
        if busy < 0:
            break
        for lane in range(LANES):
            if rope[lane] < 0:  # does what another lane does, and nobody looks
                _copy(busy, lane, x, v, side, spin)
                pull[:, :, lane], tick[lane] = pull[:, :, busy], tick[busy]
            step[0, lane] = tick[lane] * unit
            half[0, lane] = 0.5 * step[0, lane]
        middles(x, middle)
        if stale or _drifted(x, listed):
            list_pairs(middle, LISTED, start, other)
            listed[:], stale = x, False
        # velocities without contact
        tangents(x, v, zero, tangent)
        tangents(x, v, half, tangent1)
        assemble(
            tangent1,
            side,
            v,
            spin,
            v,
            spin,
            pull,
            step,
            numbers,
            damping,
            joint,
            bead,
            diag,
            near,
            far,
            arrow,
            corner,
            right,
        )
        factor(diag, near, far, arrow, corner)
        forward(diag, near, far, arrow, corner, right, 0)
        loaded[:] = right
        backward(diag, near, far, arrow, corner, right)
        _read(right, v1, spin1)
        # contact
        find_rows(
            x,
            v1,
            tangent,
            middle,
            start,
            other,
            step,
            contact,
            numbers[LENGTH],
            motion,
            rows,
            found,
        )
        most = found.max()
        if most > 0:
            push_apart(
                rows, found, most, v1, step, contact, diag, near, far, arrow, corner, loaded
            )
            backward(diag, near, far, arrow, corner, loaded)
            _read(loaded, v1, spin1)
        # positions
        h = load(step, (0,))
        for i in range(n):
            for c in range(3):
                put(x1, (i, c), fma(h, load(v1, (i, c)), load(x, (i, c))))
                put(side1, (i, c), load(side, (i, c)))
        set_lengths(x1, numbers[LENGTH], 2)
        tangents(x1, v1, zero, tangent1)
        turn_sides(side1, tangent, tangent1, spin1, step)
        judge(
            x,
            x1,
            tangent,
            middle,
            motion,
            start,
            other,
            start_far,
            other_far,
            numbers[LENGTH],
            accepted,
        )
        whole = True
        for lane in range(LANES):
            whole = whole and (accepted[lane] or rope[lane] < 0)
        if whole:
            x, v, side, spin, x1, v1, side1, spin1 = x1, v1, side1, spin1, x, v, side, spin
        for lane in range(LANES):
            own = rope[lane]
            if own < 0:
                continue
            if accepted[lane]:
                if not whole:
                    x[:, :, lane], v[:, :, lane] = x1[:, :, lane], v1[:, :, lane]
                    side[:, :, lane], spin[:, lane] = side1[:, :, lane], spin1[:, lane]
                counts[own, SUBSTEPS] += 1
                counts[own, CONTACTS] += found[lane]
                left[lane] -= tick[lane]
                if left[lane] == 0:
                    stage[lane] += 1
                    if stage[lane] < len(schedule):
                        left[lane] = tick[lane] = schedule[stage[lane]] * TICKS
                else:
                    tick[lane] = min(tick[lane], left[lane])
            else:
                counts[own, REJECTED] += 1
                tick[lane] //= 2
                if tick[lane] == 0:
                    v[:, :, lane], spin[:, lane] = 0.0, 0.0
                    counts[own, LOST] = left[lane] + TICKS * schedule[stage[lane] + 1 :].sum()
                    stage[lane] = len(schedule)
            if stage[lane] == len(schedule):
                _give(states[own], lane, x, v, side, spin)
                rope[lane] = -1


@njit(nogil=True)
def _take(
    state: Array,
    bead: int,
    force: Array,
    lane: int,
    x: Array,
    v: Array,
    side: Array,
    spin: Array,
    pull: Array,
) -> None:
    """Put a rope into a lane. The force on its bead's centre is shared by the bead's vertices."""
    n = len(state)
    for i in range(n):
        for c in range(3):
            x[i, c, lane], v[i, c, lane] = state[i, c], state[i, 3 + c]
            side[i, c, lane], pull[i, c, lane] = state[i, 6 + c], 0.0
        spin[i, lane] = state[i, 9]
    for c in range(3):
        pull[bead, c, lane] = pull[(bead + 1) % n, c, lane] = 0.5 * force[c]


@njit(nogil=True)
def _give(state: Array, lane: int, x: Array, v: Array, side: Array, spin: Array) -> None:
    """Write what a lane holds to a rope's state."""
    for i in range(len(state)):
        for c in range(3):
            state[i, c], state[i, 3 + c] = x[i, c, lane], v[i, c, lane]
            state[i, 6 + c] = side[i, c, lane]
        state[i, 9] = spin[i, lane]


@njit(nogil=True)
def _copy(source: int, lane: int, x: Array, v: Array, side: Array, spin: Array) -> None:
    """Copy one lane to another."""
    for i in range(len(x)):
        for c in range(3):
            x[i, c, lane], v[i, c, lane] = x[i, c, source], v[i, c, source]
            side[i, c, lane] = side[i, c, source]
        spin[i, lane] = spin[i, source]


@njit(nogil=True)
def _read(right: Array, v: Array, spin: Array) -> None:
    """Take velocities and spins out of a solution; the corner holds vertex 0's velocity."""
    n = len(v)
    for i in range(n):
        for c in range(3):
            put(v, (i, c), load(right, (n if i == 0 else i, c)))
        put(spin, (i,), load(right, (i, 3)))


@njit(nogil=True)
def _drifted(x: Array, listed: Array) -> bool:
    """Whether some vertex has moved by DRIFT since pairs were listed."""
    for i in range(len(x)):
        a = load(x, (i, 0)) - load(listed, (i, 0))
        b = load(x, (i, 1)) - load(listed, (i, 1))
        c = load(x, (i, 2)) - load(listed, (i, 2))
        if any_below(-fma(a, a, fma(b, b, c * c)), -DRIFT * DRIFT):
            return True
    return False
