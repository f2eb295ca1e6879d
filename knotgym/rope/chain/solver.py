"""Ropes moved through an action: the loop over substeps.

An action lasts 0.192 s and its force is constant. `SCHEDULE` cuts it into substeps, short ones
first, as velocities jump when the force does and settle within 20 ms. Each solves the linear system
of `dynamics`, adds the contact forces of `contact`, moves the vertices by h v, sets the lengths of
the edges and turns the beads' sides. If `passage.judge` can't prove that no strands passed each
other, nothing of that is kept and the substep is tried again with half its length. A rope whose
shortest substep is rejected stays where it was and comes to rest: the rest of its action is taken
back, and counted.

LANES ropes are moved at once. Each has its own time and substep, and none can tell what the others
do: a rope moves as it does alone, to the bit. A lane whose action is over takes the next rope, and
threads take theirs from one count, so all of them work until no rope is left.

After a change run `pytest -m 'thorough or not thorough' tests/rope/chain` and `python
benchmarks/chain.py distance`: beads are on average at most 1.2 mm from MuJoCo's after one action
and 5 mm after four. Recordings that ship must still be rebuilt: `knotgym suite --recorded`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, inlined, inner, kernel
from knotgym.rope.chain import layout
from knotgym.rope.chain.banded import backward, factor, forward
from knotgym.rope.chain.contact import (
    DRIFT,
    LISTED,
    ROWS,
    Pairs,
    find_rows,
    list_pairs,
    middles,
    push_apart,
)
from knotgym.rope.chain.dynamics import assemble, set_lengths, tangents, turn_sides
from knotgym.rope.chain.layout import Physics
from knotgym.rope.chain.passage import judge
from knotgym.rope.chain.simd import LANES, any_below, count_up, load, put
from knotgym.rope.chain.vectors import along, dot, minus, put_vector, vector

Group = tuple[Array, Array, Array, Array]  # x, v, side, spin of LANES ropes

# Chosen by `benchmarks/chain.py frontier` at f6d1acb: of its four schedules the knee. 24 equal
# substeps take three times as long and end a tenth nearer to MuJoCo after an action; six are a
# tenth faster and a twentieth farther.
SCHEDULE = (1, 2, 3, 4, 4, 5, 5)  # lengths of the substeps, in shares of an action
# Time is counted in whole ticks, so that halved substeps add up to the action exactly. A tick is a
# 64th of a share, and the shortest substep.
TICKS = 64


@kernel
def advance(
    states: Array,
    points: Array,
    ids: Ids,
    beads: Ids,
    forces: Array,
    physics: Physics,
    duration: float,
    schedule: Ids,
    counts: Ids,
    taken: Ids,
) -> None:
    """Move ropes through one action, in place.

    Args:
        states: float64 (all, n, layout.STATE).
        points: float64 (all, n, 3), metres; the vertices of the ropes moved are written.
        ids: int64 (ropes,), the rows of the ropes to move.
        beads: int64 (ropes,), pulled at their centres.
        forces: float64 (ropes, 3), newtons.
        physics: of the rope.
        duration: of the action, seconds.
        schedule: as SCHEDULE.
        counts: int64 (ropes, 5), zeros: substeps taken, substeps rejected, contacts summed over
            substeps, ticks of the action that were taken back, and whether the state now holds a
            number that isn't finite; added to.
        taken: int64 (1,), how many ropes have been taken; 0 at first. Threads that call this with
            the same arrays share the ropes.
    """
    n = states.shape[1]
    group, after, spare = _empty_group(n), _empty_group(n), _empty_scratch(n)
    pull, step = np.empty((n, 3, LANES)), np.empty((1, LANES))
    listed, pairs = np.empty((n, 3, LANES)), _empty_pairs(n)
    accepted, met = np.empty(LANES, np.bool_), np.empty(LANES, np.int64)
    clock = np.empty((4, LANES), np.int64)
    clock[:] = -1
    shares = 0
    for share in schedule:
        shares += share
    # Time is counted in ticks, whole numbers, so that halved substeps add up exactly to the
    # action.
    unit = duration / (shares * TICKS)
    # `stale`: the list of near pairs must be made again
    stale = True
    while True:
        for lane in range(LANES):
            rope = _next_rope(clock, lane, taken, len(ids))
            if rope >= 0:
                _take(states[ids[rope]], beads[rope], forces[rope], lane, group, pull)
                clock[layout.ROPE, lane], clock[layout.STAGE, lane] = rope, 0
                clock[layout.LEFT, lane] = clock[layout.TICK, lane] = schedule[0] * TICKS
                stale = True
        if not _keep_busy(clock, group, pull):
            break
        for lane in range(LANES):
            step[0, lane] = clock[layout.TICK, lane] * unit
        if stale or _drifted(group[0], listed):
            _list(group[0], spare, listed, pairs)
            stale = False
        _substep(group, after, pull, step, physics, pairs, spare, met, accepted)
        # Nearly always every lane's substep is accepted: both groups change places, without a copy.
        # Otherwise lanes are copied one by one, and those rejected keep what `group` holds.
        whole = True
        for lane in range(LANES):
            whole = whole and (accepted[lane] or clock[layout.ROPE, lane] < 0)
        if whole:
            group, after = after, group
        for lane in range(LANES):
            if clock[layout.ROPE, lane] < 0:
                continue
            if accepted[lane] and not whole:
                _copy(after, lane, group, lane)
            told = counts[clock[layout.ROPE, lane]]
            told[layout.CONTACTS] += met[lane]
            if _next(clock, lane, accepted[lane], schedule, told):
                if told[layout.LOST]:
                    _stop(group, lane)
                row = ids[clock[layout.ROPE, lane]]
                told[layout.BLOWN_UP] = not _give(states[row], points[row], lane, group)
                clock[layout.ROPE, lane] = -1


@inlined
def _next_rope(clock: Ids, lane: int, taken: Ids, ropes: int) -> int:
    """Return the next of so many ropes; -1 if the lane has one, or none is left."""
    if clock[layout.ROPE, lane] >= 0 or taken[0] >= ropes:
        return -1
    rope = count_up(taken)
    return rope if rope < ropes else -1


# Taken once an action, not once a substep: all of it is overwritten before it is read.
@inner
def _empty_group(n: int) -> Group:
    vectors = (n, 3, LANES)
    return np.empty(vectors), np.empty(vectors), np.empty(vectors), np.empty((n, LANES))


@inlined
def _empty_scratch(n: int) -> tuple[Any, ...]:
    """What a substep overwrites: the system, two right sides, directions and contacts."""
    # blocks as `layout` draws them: diag, near, far, arrow
    system = (
        np.empty((n + 1, 10, LANES)),
        np.empty((n, 16, LANES)),
        np.empty((n, 12, LANES)),
        np.empty((n, 12, LANES)),
    )
    rights = np.empty((n + 1, 4, LANES)), np.empty((n + 1, 4, LANES))
    directions = np.empty((n, 3, LANES)), np.empty((n, 3, LANES))
    middle, motion, rows = np.empty((n, 3, LANES)), np.empty((n, LANES)), np.empty((ROWS, 8, LANES))
    return system, rights, directions, middle, motion, rows, _empty_pairs(n)


@inner
def _empty_pairs(n: int) -> Pairs:
    return np.empty(n + 1, np.int64), np.empty(n * n // 2, np.int64)


@inlined
def _substep(
    group: Group,
    after: Group,
    pull: Array,
    step: Array,
    physics: Physics,
    pairs: Pairs,
    spare: tuple[Any, ...],
    found: Ids,
    accepted: NDArray[np.bool_],
) -> None:
    """Move LANES ropes from `group` to `after`; write how many contacts each has, and whether what
    it did may be kept.
    """
    x, v, side, spin = group
    x1, v1, side1, spin1 = after
    system, (right, loaded), (tangent, tangent1), middle, motion, rows, wider = spare
    n, length = len(x), physics.length
    # Directions of the edges now, for contact and for turning the sides, and at x + h v / 2, the
    # middle of the substep, for the system: so edges keep their length to second order in h.
    ahead = np.empty((1, LANES))
    put(ahead, (0,), 0.0)
    tangents(x, v, ahead, tangent)
    put(ahead, (0,), 0.5 * load(step, (0,)))
    tangents(x, v, ahead, tangent1)
    # Velocities without contact, A v* = b. The forward half of the solution is kept in `loaded`:
    # contact forces are added to it there, so that A is factored once.
    assemble(tangent1, side, v, spin, pull, step, physics, system, right)
    factor(system)
    forward(system, right, np.int64(0))  # a literal would be a type of its own, and compiled twice
    for i in range(n + 1):
        for c in range(4):
            put(loaded, (i, c), load(right, (i, c)))
    backward(system, right)
    _read(right, v1, spin1)
    # Velocities with contact: L^-1 (b + J^T f), then the backward half once more. Pairs are those
    # that velocities without contact bring together; what contact forces themselves drive into each
    # other is missed, and left to `judge`.
    middles(x, middle)
    find_rows(x, v1, tangent, middle, pairs, step, physics, motion, rows, found)
    most = found[0]
    for lane in range(1, LANES):
        most = max(most, found[lane])
    if most > 0:
        push_apart(rows, found, most, v1, step, physics, system, loaded)
        backward(system, loaded)
        _read(loaded, v1, spin1)
    # Implicit Euler: vertices move at the velocities of the substep's end. The directions t in
    # t . a = 0 came from the old velocities, so edges still grow by h^2 a . (a - a_old) / 2L, which
    # `set_lengths` undoes.
    h = load(step, (0,))
    for i in range(n):
        put_vector(x1, i, along(vector(x, i), h, vector(v1, i)))
        put_vector(side1, i, vector(side, i))
    set_lengths(x1, length, np.int64(2))
    put(ahead, (0,), 0.0)
    tangents(x1, v1, ahead, tangent1)
    turn_sides(side1, tangent, tangent1, spin1, step)
    judge(x, x1, tangent, middle, motion, pairs, wider, length, accepted)


@inlined
def _next(clock: Ids, lane: int, accepted: bool, schedule: Ids, counts: Ids) -> bool:
    """Set a lane's next substep, after one accepted or not; return whether its action is over."""
    if accepted:
        # What is left of this entry of the schedule is taken in whole ticks, so halved substeps end
        # exactly where the entry ends.
        counts[layout.SUBSTEPS] += 1
        clock[layout.LEFT, lane] -= clock[layout.TICK, lane]
        if clock[layout.LEFT, lane] == 0:
            clock[layout.STAGE, lane] += 1
            if clock[layout.STAGE, lane] == len(schedule):
                return True
            clock[layout.LEFT, lane] = clock[layout.TICK, lane] = (
                schedule[clock[layout.STAGE, lane]] * TICKS
            )
        clock[layout.TICK, lane] = min(clock[layout.TICK, lane], clock[layout.LEFT, lane])
        return False
    # half of one tick is 0: nothing shorter is tried, and the rest of the action is lost
    counts[layout.REJECTED] += 1
    clock[layout.TICK, lane] //= 2
    if clock[layout.TICK, lane] > 0:
        return False
    counts[layout.LOST] = clock[layout.LEFT, lane]
    for later in range(clock[layout.STAGE, lane] + 1, len(schedule)):
        counts[layout.LOST] += TICKS * schedule[later]
    return True


@inlined
def _keep_busy(clock: Ids, group: Group, pull: Array) -> bool:
    """Let lanes without a rope do what another does, and nobody looks; return if there is one."""
    busy: Any = np.int64(-1)  # a literal would be a type of its own, and `_copy` compiled twice
    for lane in range(LANES):
        if clock[layout.ROPE, lane] >= 0:
            busy = lane
    if busy < 0:
        return False
    for lane in range(LANES):
        if clock[layout.ROPE, lane] < 0:
            # What stands in an idle lane is computed and listed with the others: points in a heap
            # would be near each other, and their pairs in everybody's list.
            _copy(group, busy, group, lane)
            for i in range(len(pull)):
                for c in range(3):
                    pull[i, c, lane] = pull[i, c, busy]
            clock[layout.TICK, lane] = clock[layout.TICK, busy]
    return True


@inlined
def _list(x: Array, spare: tuple[Any, ...], listed: Array, pairs: Pairs) -> None:
    """List near pairs of edges, and keep where the vertices were."""
    middles(x, spare[3])
    list_pairs(spare[3], LISTED, pairs)
    for i in range(len(x)):
        put_vector(listed, i, vector(x, i))


@inlined
def _take(state: Array, bead: int, force: Array, lane: int, group: Group, pull: Array) -> None:
    """Put a rope into a lane. The force on its bead's centre is shared by the bead's vertices."""
    x, v, side, spin = group
    n = len(state)
    for i in range(n):
        for c in range(3):
            x[i, c, lane], v[i, c, lane] = state[i, layout.X + c], state[i, layout.V + c]
            side[i, c, lane], pull[i, c, lane] = state[i, layout.SIDE + c], 0.0
        spin[i, lane] = state[i, layout.SPUN]
    # f on the bead's centre does the work f . (v_i + v_j) / 2: half of it pulls each end
    for c in range(3):
        pull[bead, c, lane] = pull[(bead + 1) % n, c, lane] = 0.5 * force[c]


@inlined
def _give(state: Array, points: Array, lane: int, group: Group) -> bool:
    """Write what a lane holds to a rope's state and points; return whether all of it is finite."""
    x, v, side, spin = group
    finite = True
    for i in range(len(state)):
        for c in range(3):
            state[i, layout.X + c], state[i, layout.V + c] = x[i, c, lane], v[i, c, lane]
            state[i, layout.SIDE + c], points[i, c] = side[i, c, lane], x[i, c, lane]
        state[i, layout.SPUN] = spin[i, lane]
        for c in range(layout.STATE):
            finite &= np.isfinite(state[i, c])
    return finite


@inner
def _copy(source: Group, lane: int, target: Group, to: int) -> None:
    """Copy one lane's rope to a lane."""
    for i in range(len(source[0])):
        for c in range(3):
            target[0][i, c, to] = source[0][i, c, lane]
            target[1][i, c, to] = source[1][i, c, lane]
            target[2][i, c, to] = source[2][i, c, lane]
        target[3][i, to] = source[3][i, lane]


@inlined
def _stop(group: Group, lane: int) -> None:
    """Bring a lane's rope to rest."""
    for i in range(len(group[0])):
        for c in range(3):
            group[1][i, c, lane] = 0.0
        group[3][i, lane] = 0.0


@inner
def _read(right: Array, v: Array, spin: Array) -> None:
    """Take velocities and spins out of a solution; the corner holds vertex 0's velocity."""
    n = len(v)
    for i in range(n):
        for c in range(3):
            put(v, (i, c), load(right, (n if i == 0 else i, c)))
        put(spin, (i,), load(right, (i, 3)))


@inlined
def _drifted(x: Array, listed: Array) -> bool:
    """Whether some vertex has moved by DRIFT since pairs were listed."""
    for i in range(len(x)):
        way = minus(vector(x, i), vector(listed, i))
        if any_below(-dot(way, way), -DRIFT * DRIFT):
            return True
    return False
