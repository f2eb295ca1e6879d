"""Redraw photos of an episode in the published colours, for a policy that reads these.

A photo gives the rope's centre line, which strand is over, at the marked base where the code
begins, and roughly how much longer the rope is than its picture. From that follows where beads are.
"""

import numpy as np
from numpy.typing import NDArray

from knotgym.learn.colour_reading import BEADS, enforce_votes
from knotgym.learn.rope_reader import VIEWS, RopeReader
from knotgym.rendering import DEFAULT, draw
from knotgym.rope import RopeConfig
from knotgym.topology import find_crossings

Array = NDArray[np.float64]

_VIEWS = 2  # of photos that follow another, of which an episode has many; others are read from all
_APART = 0.012  # height difference of strands that cross, metres
_JUMP = 0.03  # metres; a base that moves the beads by more than any other numbering is misread
# Of the lengths between points of the line. The network spreads what is steep, so its values are
# squared; the least of them, by how much the middle may be missed, and a length.
_LEAST, _RIDGE, _SCALE, _ROUNDS = 0.003, 1e-4, 0.2, 20
_LENGTH = RopeConfig().length  # metres
_LIFTED = 5  # beads on either side of a crossing that are raised or lowered with it


class PhotoTranslation:
    """Redraws the pictures of one episode."""

    def __init__(self, reader: RopeReader) -> None:
        self._reader = reader
        self._goal: NDArray[np.uint8] | None = None
        self._rope: Array | None = None

    def redraw(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Redraw a photo of rope and goal, uint8 (size, 2 size, 3): uint8 (SIZE, 2 SIZE, 3)."""
        rope, goal = np.split(picture, 2, axis=1)
        if self._goal is None:  # it stays the same
            self._goal = draw(rope_points(self._reader, goal))
        self._rope = rope_points(self._reader, rope, self._rope)
        return np.concatenate([draw(self._rope), self._goal], axis=1)


def rope_points(reader: RopeReader, photo: NDArray[np.uint8], before: Array | None = None) -> Array:
    """Read the beads of a photo of the environment.

    Args:
        reader: of the photo.
        photo: uint8 (size, size, 3).
        before: float64 (BEADS, 3), the beads a pull before, metres, whose numbers count where the
            base is hidden; returned where no rope is found. None if they aren't known.

    Returns:
        float64 (BEADS, 3), metres, relative to the picture's middle.
    """
    reading = reader.read(np.ascontiguousarray(photo), VIEWS if before is None else _VIEWS)
    if reading is None:
        return _loop() if before is None else before
    line = reading.line * (1.0, -1.0, 1.0)
    line[:, :2] = (line[:, :2] - (0.5 * len(photo), -0.5 * len(photo))) * DEFAULT.view / len(photo)
    walked = np.append(0.0, np.cumsum(_lengths(line, reading.stretch)))
    at = np.arange(BEADS) * walked[-1] / BEADS
    closed = np.concatenate([line, line[:1]])
    points = np.zeros((BEADS, 3))
    points[:, :2] = np.stack([np.interp(at, walked, closed[:, k]) for k in (0, 1)], axis=1)
    crossings = find_crossings(line)
    visits = [
        np.interp(place, np.arange(len(walked)), walked) * BEADS / walked[-1]
        for place in (crossings.over_place, crossings.under_place)
    ]
    votes = np.column_stack([*visits, np.ones(crossings.nx)])
    enforce_votes(points, votes, _APART, _LIFTED)
    if before is None:
        return points
    nearest = _numbered_as(points, before)
    # a pull moves the rope little, so a base far from where it was is a misread one
    seen = reading.based and _apart(points, before) < _apart(nearest, before) + _JUMP**2
    return points if seen else nearest


def _lengths(line: Array, stretch: Array) -> Array:
    """Return the length of the rope from each point of its line to the next, metres.

    What they are longer than their pictures is that nearest to the reading's, by relative entropy,
    for which all add up to the rope and its middle is that of the picture, as the camera has it.

    Args:
        line: float64 (n, 3), metres from the middle of the picture.
        stretch: float64 (n,), of a reading.
    """
    after = np.roll(line, -1, axis=0)
    step = np.hypot(*(after - line)[:, :2].T)
    # the nearest one is the reading's times the exponential of a linear function of the place
    place = np.column_stack([np.ones(len(line)), 0.5 * (after + line)[:, :2] / _SCALE])
    read = step * (stretch**2 + _LEAST)
    wanted = np.array([_LENGTH, 0, 0]) - step @ place
    wanted[0] = max(wanted[0], _LEAST * _LENGTH)
    tilt, ridge = np.zeros(3), _RIDGE * _LENGTH * np.diag([0, 1, 1])
    for _ in range(_ROUNDS):  # Newton's
        more = read * np.exp(np.clip(place @ tilt, -6, 6))
        off = more @ place - wanted + ridge @ tilt
        tilt -= np.clip(np.linalg.solve((place.T * more) @ place + ridge, off), -1, 1)
    return step + more


def _loop() -> Array:
    """Return a plain loop, which is assumed of a rope that can't be read."""
    angle = np.arange(BEADS) * 2 * np.pi / BEADS
    return 0.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def _numbered_as(points: Array, before: Array) -> Array:
    """Renumber beads so that they are as near as possible to those before."""
    ways = [np.roll(walk, k, axis=0) for walk in (points, points[::-1]) for k in range(BEADS)]
    return min(ways, key=lambda way: _apart(way, before))


def _apart(one: Array, other: Array) -> float:
    """Return the mean squared distance of beads in the pictures, square metres."""
    off = one[:, :2] - other[:, :2]
    return float(((off - off.mean(axis=0)) ** 2).sum(axis=1).mean())
