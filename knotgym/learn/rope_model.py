"""A model of the rope whose numbers are fitted to data: how it moves when a bead is pulled.

A closed chain that can't be stretched, with mass, joints that resist bending and twisting at a
rate, and a medium that resists motion by the square of its speed, across the rope more than along
it. What each of these counts is not told but learned, see `fitting`. Strands push each other apart.

Each substep solves, implicitly, for the velocities of the vertices and the spins of the beads.
Their order runs round the loop from both sides at once, so that the matrix is banded. Four ropes
are moved at once, one a lane (`lanes`): each moves as it would by itself, to the bit. `fastmath`
gains nothing here, and with it code just compiled and code from Numba's cache round otherwise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.rope.chain.simd import LANES, any_below, load, put

Array = NDArray[np.float64]

BEADS = 100
CHORD = 1.33 / BEADS  # metres
DURATION = 0.192  # seconds of an action
MAX_FORCE = 0.2  # newtons
NAMES = ("mass", "across", "along", "spin", "apart")
# kg a vertex, N s^2/m^2 a bead twice, N m s a joint, N m s a bead, metres between strands
FIRST_GUESS = np.concatenate([[1.5e-3, 0.85, 0.35, 1e-6, 0.009], np.full(BEADS, 0.01)])
_BLOCK = 4  # unknowns of a vertex: its velocity, and the spin of the bead that begins there
_REACH = 2  # vertices away, to which a vertex is coupled
_FAR = 2 * _REACH  # the same in places, as they run round the loop from both sides
_WIDTH = _FAR * _BLOCK + _BLOCK - 1  # of the band, below the diagonal
_SLOW = 0.02  # m/s, below which the medium resists as at this speed
_STIFF = 1e4  # N s/m, of a chord against being stretched
_SWEEPS = 8


def _order() -> NDArray[np.int64]:
    order = np.empty(BEADS, dtype=np.int64)
    half = (BEADS + 1) // 2
    order[:half] = 2 * np.arange(half)
    order[half:] = 2 * np.arange(BEADS - half)[::-1] + 1
    return order


_PLACE = _order()  # vertex -> its place in the matrix
_VERTEX = np.argsort(_PLACE)


@njit(cache=True, nogil=True)
def stepped(
    points: Array,
    velocities: Array,
    beads: NDArray[np.int64],
    forces: Array,
    numbers: Array,
    substeps: int,
) -> None:
    """Move ropes through one action, in place.

    Args:
        points, velocities: float64 (n, BEADS, 3), metres and m/s.
        beads: int64 (n,), pulled.
        forces: float64 (n, 3), newtons.
        numbers: as FIRST_GUESS.
        substeps: of the action.
    """
    vectors = (BEADS, 3, LANES)
    own, speed, pull = np.empty(vectors), np.empty(vectors), np.empty(vectors)
    coupling = np.empty((BEADS, _REACH + 1, _BLOCK, _BLOCK, LANES))
    band = np.empty((_BLOCK * BEADS, _WIDTH + 1, LANES))
    for first in range(0, len(points), LANES):
        for lane in range(LANES):
            rope = min(first + lane, len(points) - 1)  # lanes left over do what the last rope does
            one, other = beads[rope], (beads[rope] + 1) % BEADS
            for i in range(BEADS):
                for c in range(3):
                    own[i, c, lane], speed[i, c, lane] = points[rope, i, c], velocities[rope, i, c]
                    pull[i, c, lane] = 0.5 * forces[rope, c] if i == one or i == other else 0.0
        for _ in range(substeps):
            _substep(own, speed, pull, numbers, DURATION / substeps, coupling, band)
        for lane in range(min(LANES, len(points) - first)):
            for i in range(BEADS):
                for c in range(3):
                    points[first + lane, i, c] = own[i, c, lane]
                    velocities[first + lane, i, c] = speed[i, c, lane]


@njit(nogil=True)
def _substep(
    own: Array,
    speed: Array,
    pull: Array,
    numbers: Array,
    h: float,
    coupling: Array,
    band: Array,
) -> None:
    """Move LANES ropes; arrays (BEADS, 3, LANES), of which `pull` are the forces from outside.

    What `coupling` and `band` hold is overwritten.
    """
    new, tangent, push = np.empty_like(own), np.empty_like(own), np.empty_like(own)
    drag, right = np.empty((BEADS, 3, 3, LANES)), np.empty((_BLOCK * BEADS, LANES))
    _set_tangents(own, tangent)
    _couple(tangent, numbers, h, coupling)
    for linearisation in range(2):  # of the resistance, about the speed found before
        _resist(tangent, new if linearisation else speed, numbers, drag, push)
        _fill(coupling, drag, band)
        for i in range(BEADS):
            at = _BLOCK * _PLACE[i]
            for c in range(3):
                force = load(push, (i, c)) + load(pull, (i, c))
                put(right, (at + c,), force + numbers[0] / h * load(speed, (i, c)))
            put(right, (at + 3,), 0.0)
        _solve(band, right)
        for i in range(BEADS):
            for c in range(3):
                put(new, (i, c), load(right, (_BLOCK * _PLACE[i] + c,)))
    for i in range(BEADS):
        for c in range(3):
            put(speed, (i, c), load(new, (i, c)))
            _add(own, (i, c), h * load(new, (i, c)))
    _push_apart(own, numbers[4])
    _set_chords(own)


@njit(nogil=True)
def _set_tangents(own: Array, tangent: Array) -> None:
    """Unit vectors along the beads."""
    for i in range(BEADS):
        j = (i + 1) % BEADS
        x = load(own, (j, 0)) - load(own, (i, 0))
        y = load(own, (j, 1)) - load(own, (i, 1))
        z = load(own, (j, 2)) - load(own, (i, 2))
        shrink = 1 / math.sqrt(x * x + y * y + z * z)
        put(tangent, (i, 0), shrink * x)
        put(tangent, (i, 1), shrink * y)
        put(tangent, (i, 2), shrink * z)


@njit(nogil=True)
def _add(array: Array, place: tuple[int, ...], value: Any) -> None:
    put(array, place, load(array, place) + value)


@njit(nogil=True)
def _couple(tangent: Array, numbers: Array, h: float, coupling: Array) -> None:
    """What couples the unknowns at any speed: mass, spin, chords and joints.

    Block (i, d) of `coupling` couples vertex i with vertex i + d.
    """
    for i in range(BEADS):
        for ahead in range(_REACH + 1):
            for a in range(_BLOCK):
                for b in range(_BLOCK):
                    put(coupling, (i, ahead, a, b), 0.0)
    for i in range(BEADS):
        j = (i + 1) % BEADS
        for c in range(3):
            _add(coupling, (i, 0, c, c), numbers[0] / h)
        _add(coupling, (i, 0, 3, 3), numbers[3])
        for a in range(3):
            for b in range(3):
                hold = _STIFF * load(tangent, (i, a)) * load(tangent, (i, b))
                _add(coupling, (i, 0, a, b), hold)
                _add(coupling, (j, 0, a, b), hold)
                _add(coupling, (i, 1, a, b), -hold)
        if numbers[5 + i] != 0.0:
            _couple_joint((i - 1) % BEADS, i, j, tangent, numbers[5 + i], coupling)


@njit(nogil=True)
def _couple_joint(h: int, i: int, j: int, tangent: Array, bending: float, coupling: Array) -> None:
    """Bending and twisting between bead h and bead i, of vertices h, i and j.

    Bead i turns at the rate t_i x (v_j - v_i) / CHORD + s_i t_i, for its tangent t_i and its spin
    s_i. The joint resists the difference r of the two beads' rates, and the matrix has the second
    derivatives of bending r^2 / 2.
    """
    bend, cross = bending / CHORD / CHORD, bending / CHORD
    cosine = (
        load(tangent, (h, 0)) * load(tangent, (i, 0))
        + load(tangent, (h, 1)) * load(tangent, (i, 1))
        + load(tangent, (h, 2)) * load(tangent, (i, 2))
    )
    for a in range(3):
        before_a, after_a = load(tangent, (h, a)), load(tangent, (i, a))
        for b in range(3):
            before_b, after_b = load(tangent, (h, b)), load(tangent, (i, b))
            unit = 1.0 if a == b else 0.0
            # (t x u) . (t' x w) is (t . t') (u . w) - (t . w) (t' . u)
            before = bend * (unit - before_a * before_b)
            after = bend * (unit - after_a * after_b)
            mixed = bend * (unit * cosine - after_a * before_b)
            turned = bend * (unit * cosine - before_a * after_b)
            _add(coupling, (h, 0, a, b), before)
            _add(coupling, (i, 0, a, b), before + after + mixed + turned)
            _add(coupling, (j, 0, a, b), after)
            _add(coupling, (h, 1, a, b), -(before + mixed))
            _add(coupling, (i, 1, a, b), -(after + mixed))
            _add(coupling, (h, 2, a, b), mixed)
        # (t_i x t_h)_a: how velocities across the joint's plane twist it
        c, d = (a + 1) % 3, (a + 2) % 3
        twist = cross * (
            load(tangent, (i, c)) * load(tangent, (h, d))
            - load(tangent, (i, d)) * load(tangent, (h, c))
        )
        _add(coupling, (h, 1, a, 3), twist)
        _add(coupling, (h, 1, 3, a), -twist)
        _add(coupling, (i, 0, a, 3), -twist)
        _add(coupling, (i, 0, 3, a), -twist)
        _add(coupling, (h, 2, 3, a), twist)
    _add(coupling, (h, 0, 3, 3), bending)
    _add(coupling, (h, 1, 3, 3), -bending * cosine)
    _add(coupling, (i, 0, 3, 3), bending)


@njit(nogil=True)
def _resist(tangent: Array, speed: Array, numbers: Array, drag: Array, push: Array) -> None:
    """The medium's resistance, made linear about a speed.

    `drag` of a bead is what each quarter of its block gets, as both its vertices move it by half;
    `push` of a vertex is a force.
    """
    across, along = numbers[1], numbers[2]
    for i in range(BEADS):
        for c in range(3):
            put(push, (i, c), 0.0)
    for i in range(BEADS):
        j = (i + 1) % BEADS
        tx, ty, tz = load(tangent, (i, 0)), load(tangent, (i, 1)), load(tangent, (i, 2))
        x = 0.5 * (load(speed, (i, 0)) + load(speed, (j, 0)))
        y = 0.5 * (load(speed, (i, 1)) + load(speed, (j, 1)))
        z = 0.5 * (load(speed, (i, 2)) + load(speed, (j, 2)))
        ahead = x * tx + y * ty + z * tz
        x -= ahead * tx
        y -= ahead * ty
        z -= ahead * tz
        sideways = across * max(math.sqrt(x * x + y * y + z * z), _SLOW)
        forward = along * max(abs(ahead), _SLOW)
        # k |u| u is about k (2 |u0| u - |u0| u0)
        for c, aside in enumerate((x, y, z)):
            back = 0.5 * (sideways * aside + forward * ahead * load(tangent, (i, c)))
            _add(push, (i, c), back)
            _add(push, (j, c), back)
        for a in range(3):
            for b in range(3):
                line = load(tangent, (i, a)) * load(tangent, (i, b))
                unit = 1.0 if a == b else 0.0
                put(drag, (i, a, b), 0.5 * (sideways * (unit - line) + forward * line))


@njit(nogil=True)
def _fill(coupling: Array, drag: Array, band: Array) -> None:
    """Put the matrix into its band: (i, k) is at band[i, k - i + _WIDTH], for k up to i."""
    for place in range(BEADS):
        i = _VERTEX[place]
        for other in range(max(0, place - _FAR), place + 1):
            j, row, shift = _VERTEX[other], _BLOCK * place, _BLOCK * (other - place) + _WIDTH
            ahead, back = (j - i) % BEADS, (i - j) % BEADS
            for a in range(_BLOCK):
                for b in range(_BLOCK if other < place else a + 1):
                    at = (row + a, shift + b - a)
                    if ahead <= _REACH:
                        put(band, at, load(coupling, (i, ahead, a, b)))
                    elif back <= _REACH:
                        put(band, at, load(coupling, (j, back, b, a)))
                    else:
                        put(band, at, 0.0)
            if ahead <= 1:
                _add_drag(i, place, other, drag, band)
            if back <= 1:
                _add_drag((i - 1) % BEADS, place, other, drag, band)


@njit(nogil=True)
def _add_drag(bead: int, place: int, other: int, drag: Array, band: Array) -> None:
    """Add a bead's drag to one of its vertices' blocks in the band."""
    row, shift = _BLOCK * place, _BLOCK * (other - place) + _WIDTH
    for a in range(3):
        for b in range(3 if other < place else a + 1):
            _add(band, (row + a, shift + b - a), load(drag, (bead, a, b)))


@njit(nogil=True)
def _solve(band: Array, right: Array) -> None:
    """Solve in place, by Cholesky's factors; the matrix is symmetric and positive.

    Four rows, w to z, are done at once: so the rows above are read once for all of them, and no sum
    waits for another. The diagonal is left inverted, as what others are multiplied by.
    """
    for w in range(0, len(right), _BLOCK):
        x, y, z, low = w + 1, w + 2, w + 3, max(0, w - _FAR * _BLOCK)
        dw, dx, dy, dz = _WIDTH - w, _WIDTH - x, _WIDTH - y, _WIDTH - z
        for j in range(low, w, 2):  # two columns at once
            at, after = _WIDTH - j, _WIDTH - j - 1
            w0, w1 = load(band, (w, j + dw)), load(band, (w, j + dw + 1))
            x0, x1 = load(band, (x, j + dx)), load(band, (x, j + dx + 1))
            y0, y1 = load(band, (y, j + dy)), load(band, (y, j + dy + 1))
            z0, z1 = load(band, (z, j + dz)), load(band, (z, j + dz + 1))
            for k in range(low, j):
                first, second = load(band, (j, k + at)), load(band, (j + 1, k + after))
                own = load(band, (w, k + dw))
                w0 -= first * own
                w1 -= second * own
                own = load(band, (x, k + dx))
                x0 -= first * own
                x1 -= second * own
                own = load(band, (y, k + dy))
                y0 -= first * own
                y1 -= second * own
                own = load(band, (z, k + dz))
                z0 -= first * own
                z1 -= second * own
            inverse, between = load(band, (j, _WIDTH)), load(band, (j + 1, _WIDTH - 1))
            w0, x0, y0, z0 = inverse * w0, inverse * x0, inverse * y0, inverse * z0
            inverse = load(band, (j + 1, _WIDTH))
            put(band, (w, j + dw), w0)
            put(band, (x, j + dx), x0)
            put(band, (y, j + dy), y0)
            put(band, (z, j + dz), z0)
            put(band, (w, j + dw + 1), inverse * (w1 - between * w0))
            put(band, (x, j + dx + 1), inverse * (x1 - between * x0))
            put(band, (y, j + dy + 1), inverse * (y1 - between * y0))
            put(band, (z, j + dz + 1), inverse * (z1 - between * z0))
        ww = load(band, (w, _WIDTH))
        xw, xx = load(band, (x, _WIDTH - 1)), load(band, (x, _WIDTH))
        yw, yx, yy = (
            load(band, (y, _WIDTH - 2)),
            load(band, (y, _WIDTH - 1)),
            load(band, (y, _WIDTH)),
        )
        zw, zx = load(band, (z, _WIDTH - 3)), load(band, (z, _WIDTH - 2))
        zy, zz = load(band, (z, _WIDTH - 1)), load(band, (z, _WIDTH))
        rw, rx, ry, rz = load(right, (w,)), load(right, (x,)), load(right, (y,)), load(right, (z,))
        for k in range(low, w):
            wk, xk = load(band, (w, k + dw)), load(band, (x, k + dx))
            yk, zk = load(band, (y, k + dy)), load(band, (z, k + dz))
            ww -= wk * wk
            xw -= xk * wk
            xx -= xk * xk
            yw -= yk * wk
            yx -= yk * xk
            yy -= yk * yk
            zw -= zk * wk
            zx -= zk * xk
            zy -= zk * yk
            zz -= zk * zk
        for k in range(low, w):
            known = load(right, (k,))
            rw -= known * load(band, (w, k + dw))
            rx -= known * load(band, (x, k + dx))
            ry -= known * load(band, (y, k + dy))
            rz -= known * load(band, (z, k + dz))
        ww = 1 / math.sqrt(ww)
        rw, xw, yw, zw = rw * ww, xw * ww, yw * ww, zw * ww
        xx = 1 / math.sqrt(xx - xw * xw)
        rx, yx, zx = (rx - rw * xw) * xx, (yx - xw * yw) * xx, (zx - xw * zw) * xx
        yy = 1 / math.sqrt(yy - yw * yw - yx * yx)
        ry, zy = (ry - rw * yw - rx * yx) * yy, (zy - yw * zw - yx * zx) * yy
        zz = 1 / math.sqrt(zz - zw * zw - zx * zx - zy * zy)
        rz = (rz - rw * zw - rx * zx - ry * zy) * zz
        put(band, (w, _WIDTH), ww)
        put(band, (x, _WIDTH - 1), xw)
        put(band, (x, _WIDTH), xx)
        put(band, (y, _WIDTH - 2), yw)
        put(band, (y, _WIDTH - 1), yx)
        put(band, (y, _WIDTH), yy)
        put(band, (z, _WIDTH - 3), zw)
        put(band, (z, _WIDTH - 2), zx)
        put(band, (z, _WIDTH - 1), zy)
        put(band, (z, _WIDTH), zz)
        put(right, (w,), rw)
        put(right, (x,), rx)
        put(right, (y,), ry)
        put(right, (z,), rz)
    for i in range(len(right) - 1, -1, -1):
        solved = load(right, (i,)) * load(band, (i, _WIDTH))
        put(right, (i,), solved)
        for k in range(max(0, i - i % _BLOCK - _FAR * _BLOCK), i):
            _add(right, (k,), -solved * load(band, (i, k - i + _WIDTH)))


@njit(nogil=True)
def _push_apart(own: Array, apart: float) -> None:
    """Move strands that come nearer than `apart` away from each other."""
    for i in range(BEADS):
        for j in range(i + 3, BEADS if i > 2 else BEADS - 3 + i):
            x = load(own, (j, 0)) - load(own, (i, 0))
            y = load(own, (j, 1)) - load(own, (i, 1))
            z = load(own, (j, 2)) - load(own, (i, 2))
            square = x * x + y * y + z * z
            if any_below(square, apart * apart):
                far = max(math.sqrt(square), 1e-6)
                _move_both(own, i, j, x, y, z, max(0.5 * (apart - far) / far, 0.0))


@njit(nogil=True)
def _set_chords(own: Array) -> None:
    """Move vertices a little until chords are CHORD long."""
    for _ in range(_SWEEPS):
        for parity in range(2):
            for i in range(parity, BEADS, 2):
                j = (i + 1) % BEADS
                x = load(own, (j, 0)) - load(own, (i, 0))
                y = load(own, (j, 1)) - load(own, (i, 1))
                z = load(own, (j, 2)) - load(own, (i, 2))
                far = max(math.sqrt(x * x + y * y + z * z), 1e-9)
                _move_both(own, i, j, x, y, z, 0.5 * (CHORD / far - 1))


@njit(nogil=True)
def _move_both(own: Array, i: int, j: int, x: Any, y: Any, z: Any, share: Any) -> None:
    """Move two vertices away from each other by a share of what is between them, each."""
    _add(own, (i, 0), -share * x)
    _add(own, (i, 1), -share * y)
    _add(own, (i, 2), -share * z)
    _add(own, (j, 0), share * x)
    _add(own, (j, 1), share * y)
    _add(own, (j, 2), share * z)


class Dynamics:
    """The model with its numbers; no simulator is asked."""

    def __init__(self, numbers: Array, substeps: int = 2) -> None:
        """Take fitted numbers, as FIRST_GUESS; more substeps are slower, and little better."""
        self.numbers, self.substeps = numbers, substeps

    def step(
        self, points: Array, velocities: Array, beads: NDArray[np.int64], forces: Array
    ) -> tuple[Array, Array]:
        """What one action does.

        Args:
            points, velocities: float64 (n, BEADS, 3), metres and m/s; left alone.
            beads: int64 (n,), pulled.
            forces: float64 (n, 3), in units of the largest force.

        Returns:
            Points and velocities after it.
        """
        after, speeds = points.copy(), velocities.copy()
        stepped(after, speeds, beads, MAX_FORCE * forces, self.numbers, self.substeps)
        return after, speeds
