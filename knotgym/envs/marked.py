"""The "marked" observation: a rope in a canonical frame, its crossings marked, codes as tokens.

Turning a rope about z, reflecting it and switching over and under change nothing that matters, and
walking it the other way next to nothing (`topology.symmetry`). A learner would have to see every
image of a state; instead, each state is observed in one frame, and what the learner chooses there
is mapped back to the world:

    walk and z    the goal's code, then the rope's, is the greatest of its four images (reversed,
                  switched), so the goal begins over
    x and y       the first Fourier mode of the curve, c = mean(w_k exp(-2 pi i k / n)) with
                  w = x + iy, is real and positive, and larger than that of the reversed walk: a
                  plain loop is walked counterclockwise and starts on the x axis
    origin        the centre of the rope

The observation is one float32 vector; `Marked.split` names its parts.

After a change run `pytest tests/envs/test_marked.py`: all images of a state must look the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array
from knotgym.rope import ActionView
from knotgym.topology import GaussCode, Symmetry, find_crossings, images

Floats = NDArray[np.float32]
Tokens = NDArray[np.int16]
Visits = tuple[int, ...]

TOKENS = 24  # visits of a code in the observation, two per crossing; longer codes are cut off
_FRAME = 13  # numbers that describe the frame: axes 9, centre 3, reverse 1


class CanonicalFrames(NamedTuple):
    """The canonical frames of n ropes.

    Attributes:
        axes: float64 (n, 3, 3), orthogonal; rows are the frame's axes in the world.
        centres: float64 (n, 3), the ropes' centres in the world, metres.
        reverse: bool (n,), whether the canonical walk is the reversed one: its vertex j is the
            world's vertex -j, and its bead b is the world's bead -b - 1.
    """

    axes: Array
    centres: Array
    reverse: NDArray[np.bool_]

    @classmethod
    def centred(cls, points: Array) -> CanonicalFrames:
        """Return the frames of ropes (n, beads, 3) that lie as they do, about their centres."""
        axes = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        return cls(axes, points.mean(axis=1), np.zeros(len(points), dtype=bool))

    def points(self, points: Array) -> Array:
        """Map vertices (n, beads, 3) of the world into the frame, and renumber them."""
        seen = self.vectors(points - self.centres[:, None])
        # reversed, but vertex 0 stays the first: 0, n - 1, n - 2, ..., 1
        back = np.roll(seen[:, ::-1], 1, axis=1)
        return np.where(self.reverse[:, None, None], back, seen)

    def states(self, points: Array, goal_points: ArrayLike) -> Floats:
        """Return observations of the kind "state" in the frame, float32 (n, 6 beads), metres.

        Each of rope and goal lies about its own centre.
        """
        goals = np.broadcast_to(np.asarray(goal_points, dtype=np.float64), points.shape)
        centred = self._replace(centres=goals.mean(axis=1))
        both = np.stack([self.points(points), centred.points(goals)], axis=1)
        return both.reshape(len(points), -1).astype(np.float32)

    def vectors(self, vectors: ArrayLike, *, back: bool = False) -> Array:
        """Map vectors (n, ..., 3), such as forces, from the world into the frame, or back."""
        # the axes are orthogonal, so the transpose is the inverse
        sums = "nji,n...j->n...i" if back else "nij,n...j->n...i"
        return np.einsum(sums, self.axes, np.asarray(vectors, np.float64))

    def renumber(self, beads: ArrayLike, count: int = 100) -> NDArray[np.int64]:
        """Map beads (n,), of `count` per rope, from the world into the frame, or back."""
        numbers = np.asarray(beads, dtype=np.int64)
        return np.where(self.reverse, count - 1 - numbers, numbers)

    def macros(self, actions: NDArray[Any], count: int) -> NDArray[np.int64]:
        """Map actions (n, 3) of the view "macro" from the world into the frame, or back."""
        beads = [self.renumber(actions[:, k], count) for k in (0, 1)]
        return np.stack([*beads, (self.sides(2 * actions[:, 2] - 1) + 1) // 2], axis=1)

    def places(self, beads: ArrayLike, points: Array) -> Array:
        """Return where beads (n,) of the world's ropes (n, beads, 3) lie in the frame, metres."""
        numbers = self.renumber(beads, points.shape[1])
        return self.points(points)[np.arange(len(numbers)), numbers]

    def decisions(
        self, beads: ArrayLike, forces: ArrayLike, made: ArrayLike, points: Array
    ) -> Floats:
        """Return the actions of the view "decision" in the frame.

        Args:
            beads: int (n,), beads of the world.
            forces: (n, ActionView.LONGEST, 3) in the world, in units of the largest force.
            made: (n, ActionView.LONGEST), above 0 for the pulls that are made.
            points: float64 (n, beads, 3), the ropes in the world, metres.

        Returns:
            float32 (n, 43), clipped to [-1, 1].
        """
        flat = self.vectors(forces).reshape(len(points), -1)
        parts = [self.places(beads, points) / ActionView.NEAR, flat, np.asarray(made)]
        return np.concatenate(parts, axis=1).clip(-1, 1).astype(np.float32)

    def sides(self, sides: ArrayLike) -> NDArray[np.int64]:
        """Map sides (n,), +1 over and -1 under, from the world into the frame, or back."""
        return np.asarray(sides, dtype=np.int64) * np.rint(self.axes[:, 2, 2]).astype(np.int64)


class Marked(NamedTuple):
    """The parts of n observations.

    Attributes:
        points: float (n, beads, 3), vertices in the canonical frame, metres.
        marks: (n, beads, 2), how often each bead crosses over, and under, another.
        code, goal: (n, TOKENS, 2). A token per visit: 1 over or -1 under, and the index of
            the crossing's other visit; (0, -1) after the end.
        frames: maps to the world and back.
    """

    points: NDArray[np.floating]
    marks: NDArray[Any]
    code: NDArray[Any]
    goal: NDArray[Any]
    frames: CanonicalFrames

    @staticmethod
    def size(beads: int) -> int:
        """Return the length of an observation."""
        # 3 coordinates and 2 marks a bead, 2 numbers a token of either code
        return 5 * beads + 4 * TOKENS + _FRAME

    @classmethod
    def fits(cls, rows: NDArray[Any]) -> bool:
        """Whether rows (n, k) may be observations: their tokens are whole numbers, coordinates of a
        rope aren't.
        """
        beads, rest = divmod(rows.shape[1] - cls.size(0), 5)
        if rest or beads < 1 or not len(rows):
            return False
        marked = cls.split(rows)
        whole = marked.marks, marked.code, marked.goal
        return all(bool((part == np.rint(part)).all()) for part in whole)

    @classmethod
    def of(cls, points: ArrayLike, goals: Sequence[GaussCode]) -> Marked:
        """Observe ropes in their canonical frames.

        Args:
            points: (n, beads, 3), metres.
            goals: n codes; chirality is ignored.
        """
        ropes = np.asarray(points, dtype=np.float64)
        count, beads = ropes.shape[:2]
        over, under = np.zeros((2, count, beads), dtype=np.int16)
        code, goal = np.zeros((2, count, TOKENS, 2), dtype=np.int16)
        reverse, switch = np.zeros((2, count), dtype=bool)
        for row, rope in enumerate(ropes):
            crossings = find_crossings(rope)
            # a place is a fractional bead, and the end of the last bead is place `beads`
            for marks, places in ((over, crossings.over_place), (under, crossings.under_place)):
                np.add.at(marks[row], np.minimum(places.astype(np.int64), beads - 1), 1)
            shown = goals[row].visits, crossings.code.visits
            reverse[row], switch[row], goal[row], code[row] = _canonical_image(*shown)
        marks = np.stack([over, under], axis=2)
        # switched, what was over is under; reversed, bead b is bead n - 1 - b, and vertices need a
        # roll
        marks = np.where(switch[:, None, None], marks[..., ::-1], marks)
        marks = np.where(reverse[:, None, None], marks[:, ::-1], marks)
        frames = _frames(ropes, reverse, switch)
        return cls(frames.points(ropes), marks, code, goal, frames)

    def joined(self) -> Floats:
        """Return observations as one array, float32 (n, size(beads))."""
        frames = self.frames
        columns = (*self[:4], frames.axes, frames.centres, frames.reverse)
        rows = [np.reshape(column, (len(self.points), -1)) for column in columns]
        return np.concatenate(rows, axis=1).astype(np.float32)

    @classmethod
    def split(cls, observations: ArrayLike) -> Marked:
        """Return the parts of observations (n, size(beads)); the inverse of `joined`."""
        rows = np.asarray(observations)
        count, beads = len(rows), (rows.shape[1] - cls.size(0)) // 5
        shapes = (beads, 3), (beads, 2), (TOKENS, 2), (TOKENS, 2), (3, 3), (3,), ()
        ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
        parts = zip(np.split(rows, ends, axis=1), shapes, strict=True)
        points, marks, code, goal, axes, centres, reverse = (
            part.reshape(count, *shape) for part, shape in parts
        )
        places = axes.astype(np.float64), centres.astype(np.float64)
        return cls(points, marks, code, goal, CanonicalFrames(*places, reverse > 0.5))

    def rows(self, index: Any) -> Marked:
        """Return some of the observations."""
        points, marks, code, goal = (column[index] for column in self[:4])
        frames = CanonicalFrames(*(column[index] for column in self.frames))
        return Marked(points, marks, code, goal, frames)


def _frames(ropes: Array, reverse: NDArray[np.bool_], switch: NDArray[np.bool_]) -> CanonicalFrames:
    centres = ropes.mean(axis=1)
    flat = ropes[..., 0] + 1j * ropes[..., 1] - (centres[:, :1] + 1j * centres[:, 1:2])
    wave = np.exp(-2j * np.pi * np.arange(ropes.shape[1]) / ropes.shape[1])
    ahead, back = (flat * wave).mean(axis=1), (flat * wave.conj()).mean(axis=1)
    # Modes 1 and -1 of the walk, mean(w exp(-+2 pi i k / n)), of the centred curve w = x + iy.
    # Walking the other way swaps the two modes; reflecting y conjugates and swaps them
    ahead, back = np.where(reverse, back, ahead), np.where(reverse, ahead, back)
    reflect = np.abs(back) > np.abs(ahead)
    first, mirror = np.where(reflect, back.conj(), ahead), np.where(reflect, -1.0, 1.0)
    # exp(-i phase) as cosine and sine; a rope without a first mode gets an arbitrary frame
    length = np.maximum(np.abs(first), 1e-12)
    cosine, sine = first.real / length, -first.imag / length
    axes = np.zeros((len(ropes), 3, 3))
    # the rotation that makes the mode real, after the reflection diag(1, mirror)
    axes[:, 0, 0], axes[:, 0, 1] = cosine, -sine * mirror
    axes[:, 1, 0], axes[:, 1, 1] = sine, cosine * mirror
    # switched, z points down: what was over is under
    axes[:, 2, 2] = np.where(switch, -1.0, 1.0)
    return CanonicalFrames(axes, centres, reverse)


@lru_cache(maxsize=100_000)
def _canonical_image(goal: Visits, code: Visits) -> tuple[bool, bool, Tokens, Tokens]:
    """Return whether to reverse and to switch, and the tokens of the goal and of the code then."""
    walks = Symmetry.SWITCH | Symmetry.REVERSE
    pairs = [*zip(*(images(GaussCode(visits), walks) for visits in (goal, code)), strict=True)]
    # the first of equal ones, so that a rope isn't reversed without need
    best = max(range(len(pairs)), key=lambda k: [image.visits for image in pairs[k]])
    first, second = pairs[best]
    return best > 1, best % 2 == 1, _tokens(first.visits), _tokens(second.visits)


def _tokens(visits: Visits) -> Tokens:
    """Return the tokens of a code, int16 (TOKENS, 2).

    >>> _tokens((1, -1))[:3].tolist()
    [[1, 1], [-1, 0], [0, -1]]
    """
    tokens = np.full((TOKENS, 2), (0, -1), dtype=np.int16)
    # `-visit` is the other visit of the same crossing
    at = {visit: index for index, visit in enumerate(visits)}
    for index, visit in enumerate(visits[:TOKENS]):
        tokens[index] = (visit > 0) - (visit < 0), at[-visit]
    return tokens
