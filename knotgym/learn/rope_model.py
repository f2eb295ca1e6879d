"""A model of the rope whose numbers are fitted to data: how it moves when a bead is pulled.

A closed chain that can't be stretched, with mass, joints that resist bending and twisting at a
rate, and a medium that resists motion by the square of its speed, across the rope more than along
it. What each of these counts is not told but learned, see `fitting`. Strands push each other apart.

Each substep solves, implicitly, for the velocities of the vertices and the spins of the beads.
Their order runs round the loop from both sides at once, so that the matrix is banded.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

BEADS = 100
CHORD = 1.33 / BEADS  # metres
DURATION = 0.192  # seconds of an action
MAX_FORCE = 0.2  # newtons
NAMES = ("mass", "across", "along", "spin", "apart")
# kg a vertex, N s^2/m^2 a bead twice, N m s a joint, N m s a bead, metres between strands
FIRST_GUESS = np.concatenate([[1.5e-3, 0.85, 0.35, 1e-6, 0.009], np.full(BEADS, 0.01)])
_BLOCK = 4  # unknowns of a vertex: its velocity, and the spin of the bead that begins there
_WIDTH = 4 * _BLOCK + 3  # of the band, below the diagonal
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


@njit(cache=True, nogil=True, fastmath=True)
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
    band = np.empty((_BLOCK * BEADS, _WIDTH + 1))
    right = np.empty(_BLOCK * BEADS)
    for rope in range(points.shape[0]):
        for _ in range(substeps):
            _substep(
                points[rope],
                velocities[rope],
                beads[rope],
                forces[rope],
                numbers,
                DURATION / substeps,
                band,
                right,
            )


@njit(cache=True, nogil=True, fastmath=True)
def _substep(
    own: Array,
    speed: Array,
    bead: int,
    force: Array,
    numbers: Array,
    h: float,
    band: Array,
    right: Array,
) -> None:
    mass, across, along, spin, apart = numbers[:5]
    new = speed.copy()
    tangent = np.empty((BEADS, 3))
    for i in range(BEADS):
        length = 0.0
        for c in range(3):
            tangent[i, c] = own[(i + 1) % BEADS, c] - own[i, c]
            length += tangent[i, c] ** 2
        length = np.sqrt(length)
        for c in range(3):
            tangent[i, c] /= length
    for _ in range(2):  # resistance is made linear about the speed found before
        band[:] = 0.0
        right[:] = 0.0
        for i in range(BEADS):
            at = _BLOCK * _PLACE[i]
            for c in range(3):
                band[at + c, _WIDTH] += mass / h
                right[at + c] += mass / h * speed[i, c]
            band[at + 3, _WIDTH] += spin
            _add_bead(i, tangent, new, across, along, _STIFF, band, right)
            _add_joint(i, tangent, numbers[5 + i], band)
        for end in range(2):
            at = _BLOCK * _PLACE[(bead + end) % BEADS]
            for c in range(3):
                right[at + c] += 0.5 * force[c]
        _solve(band, right)
        for i in range(BEADS):
            at = _BLOCK * _PLACE[i]
            for c in range(3):
                new[i, c] = right[at + c]
    own += h * new
    _push_apart(own, apart)
    _set_chords(own)
    for i in range(BEADS):
        for c in range(3):
            speed[i, c] = new[i, c]


@njit(cache=True, nogil=True, fastmath=True)
def _add(band: Array, one: int, other: int, value: float) -> None:
    if one >= other:
        band[one, other - one + _WIDTH] += value


@njit(cache=True, nogil=True, fastmath=True)
def _add_bead(
    i: int,
    tangent: Array,
    speed: Array,
    across: float,
    along: float,
    stiff: float,
    band: Array,
    right: Array,
) -> None:
    """The medium's resistance, made linear about a speed, and the chord's."""
    j = (i + 1) % BEADS
    ahead = 0.0
    for c in range(3):
        ahead += 0.5 * (speed[i, c] + speed[j, c]) * tangent[i, c]
    sideways = 0.0
    for c in range(3):
        sideways += (0.5 * (speed[i, c] + speed[j, c]) - ahead * tangent[i, c]) ** 2
    sideways = max(np.sqrt(sideways), _SLOW)
    forward = max(abs(ahead), _SLOW)
    # k |u| u is about k (2 |u0| u - |u0| u0)
    first, second = _BLOCK * _PLACE[i], _BLOCK * _PLACE[j]
    for a in range(3):
        aside = 0.5 * (speed[i, a] + speed[j, a]) - ahead * tangent[i, a]
        back = across * sideways * aside + along * forward * ahead * tangent[i, a]
        right[first + a] += 0.5 * back
        right[second + a] += 0.5 * back
        for b in range(3):
            line = tangent[i, a] * tangent[i, b]
            unit = 1.0 if a == b else 0.0
            drag = 0.25 * 2 * (across * sideways * (unit - line) + along * forward * line)
            hold = stiff * line
            _add(band, first + a, first + b, drag + hold)
            _add(band, second + a, second + b, drag + hold)
            _add(band, first + a, second + b, drag - hold)
            _add(band, second + a, first + b, drag - hold)


@njit(cache=True, nogil=True, fastmath=True)
def _add_joint(i: int, tangent: Array, bending: float, band: Array) -> None:
    """Bending and twisting between bead i - 1 and bead i."""
    if bending == 0.0:
        return
    h, j = (i - 1) % BEADS, (i + 1) % BEADS
    places = np.empty(11, np.int64)
    jacobian = np.zeros((3, 11))
    for c in range(3):
        places[c] = _BLOCK * _PLACE[h] + c
        places[3 + c] = _BLOCK * _PLACE[i] + c
        places[6 + c] = _BLOCK * _PLACE[j] + c
    places[9], places[10] = _BLOCK * _PLACE[h] + 3, _BLOCK * _PLACE[i] + 3
    for edge in range(2):
        sign = 1.0 if edge else -1.0
        x, y, z = tangent[i if edge else h]
        x, y, z = sign * x / CHORD, sign * y / CHORD, sign * z / CHORD
        start, stop = 3 * edge, 3 * edge + 3
        # t x (v_stop - v_start) / CHORD
        for at, way in ((stop, 1.0), (start, -1.0)):
            jacobian[0, at + 1] -= way * z
            jacobian[0, at + 2] += way * y
            jacobian[1, at] += way * z
            jacobian[1, at + 2] -= way * x
            jacobian[2, at] -= way * y
            jacobian[2, at + 1] += way * x
        for c in range(3):
            jacobian[c, 9 + edge] += sign * tangent[i if edge else h, c]
    for a in range(11):
        for b in range(11):
            if places[a] >= places[b]:
                total = 0.0
                for c in range(3):
                    total += jacobian[c, a] * jacobian[c, b]
                band[places[a], places[b] - places[a] + _WIDTH] += bending * total


@njit(cache=True, nogil=True, fastmath=True)
def _solve(band: Array, right: Array) -> None:
    """Solve in place; band[i, _WIDTH - k] is the matrix at (i, i - k), symmetric and positive."""
    n = len(right)
    for i in range(n):
        row = band[i]
        low = max(0, i - _WIDTH)
        for j in range(low, i):
            start = max(low, j - _WIDTH)
            own, other = row[start - i + _WIDTH : j - i + _WIDTH], band[j, start - j + _WIDTH :]
            total = 0.0
            for k in range(len(own)):
                total += own[k] * other[k]
            row[j - i + _WIDTH] = (row[j - i + _WIDTH] - total) * band[j, _WIDTH]
        total = row[_WIDTH]
        for k in range(low - i + _WIDTH, _WIDTH):
            total -= row[k] * row[k]
        row[_WIDTH] = 1.0 / np.sqrt(total)  # what others divide by
        total = right[i]
        for k in range(low, i):
            total -= row[k - i + _WIDTH] * right[k]
        right[i] = total * row[_WIDTH]
    for i in range(n - 1, -1, -1):
        right[i] *= band[i, _WIDTH]
        for k in range(max(0, i - _WIDTH), i):
            right[k] -= band[i, k - i + _WIDTH] * right[i]


@njit(cache=True, nogil=True, fastmath=True)
def _push_apart(own: Array, apart: float) -> None:
    """Move strands that come nearer than `apart` away from each other."""
    for i in range(BEADS):
        for j in range(i + 3, BEADS if i > 2 else BEADS - 3 + i):
            dx, dy, dz = own[j, 0] - own[i, 0], own[j, 1] - own[i, 1], own[j, 2] - own[i, 2]
            far = dx * dx + dy * dy + dz * dz
            if far < apart * apart:
                far = max(np.sqrt(far), 1e-6)
                share = 0.5 * (apart - far) / far
                own[i, 0] -= share * dx
                own[i, 1] -= share * dy
                own[i, 2] -= share * dz
                own[j, 0] += share * dx
                own[j, 1] += share * dy
                own[j, 2] += share * dz


@njit(cache=True, nogil=True, fastmath=True)
def _set_chords(own: Array) -> None:
    """Move vertices a little until chords are CHORD long."""
    for _ in range(_SWEEPS):
        for parity in range(2):
            for i in range(parity, BEADS, 2):
                after = (i + 1) % BEADS
                dx = own[after, 0] - own[i, 0]
                dy = own[after, 1] - own[i, 1]
                dz = own[after, 2] - own[i, 2]
                share = 0.5 * (1 - CHORD / max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-9))
                own[i, 0] += share * dx
                own[i, 1] += share * dy
                own[i, 2] += share * dz
                own[after, 0] -= share * dx
                own[after, 1] -= share * dy
                own[after, 2] -= share * dz


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
