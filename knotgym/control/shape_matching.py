"""The policy `matching`: follow the goal's shape, and know nothing of knots.

Of every pull, the goal is turned about z onto the rope, bead for bead, and the bead that
lies farthest from its place is pulled towards it. From pictures, each bead is placed where its
colour is, so heights are unknown. What it scores is what a policy that sees a state of the goal
gets for nothing. The constants are the best of a few on train states (docs/board.md).
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, InvalidPolicy
from knotgym.control.sampler import Player, Pulls
from knotgym.envs import OBSERVATIONS, EpisodeBatch, TaskConfig
from knotgym.rendering import PictureConfig, bead_colours
from knotgym.rope import quantized

_HEIGHT = 2.0  # weight of a distance in height, where strands pass each other by a few mm
_NOISE = 0.01  # metres, without which a rope that resists is pulled in vain for ever
_SEEN, _PURE = 40, 0.99  # least brightness of a pixel of rope; likeness of one strand's colour


class MatchingPlayer(Player):
    """Pulls the bead that lies farthest from where the goal has it, towards that place."""

    def __init__(self, batch: EpisodeBatch) -> None:
        self._batch, self.planned = batch, np.zeros(batch.count, np.int64)
        self._rngs: dict[int, np.random.Generator] = {}

    @staticmethod
    def compatible_task(task: TaskConfig) -> TaskConfig:
        """Return the task; it must show the goal's shape."""
        kind = OBSERVATIONS[task.observation]
        if kind.half is None or "code" in kind.goal or task.is_canonical:
            raise InvalidPolicy(
                "policy matching needs to see the goal's shape, as state or pixels in the frame of"
                f" the world show it, got {task.observation}"
            )
        return task

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        self._rngs |= dict(zip(ids.tolist(), rngs, strict=True))

    def act(self, ids: Ids) -> Pulls:
        ropes, goals = self._shapes(ids)
        places = _turned_onto(ropes, goals)
        away = places - (ropes - ropes.mean(axis=1, keepdims=True))
        away += [self._rngs[k].normal(0, _NOISE, away.shape[1:]) for k in ids.tolist()]
        beads = np.linalg.norm(away * [1, 1, _HEIGHT], axis=2).argmax(axis=1)
        wanted = away[np.arange(len(ids)), beads]
        forces = wanted / np.abs(wanted).max(axis=1, keepdims=True)
        return Pulls(ids, beads, quantized(forces).astype(np.float32))

    def _shapes(self, ids: Ids) -> tuple[Array, Array]:
        """Return the vertices of ropes and goals, float64 (n, beads, 3), as they are observed."""
        seen, task = self._batch.observations(ids), self._batch.task
        if not OBSERVATIONS[task.observation].is_drawn:
            ropes, goals = seen.reshape(len(ids), 2, -1, 3).astype(np.float64).swapaxes(0, 1)
            return ropes, goals
        halves = np.split(seen, 2, axis=2 if seen.shape[2] > task.image_size else 3)
        scale = PictureConfig.of(task.beads, size=task.image_size).pixels_per_metre
        # a goal's picture stays the same in an episode
        goals = [_remembered(half.tobytes(), half.shape, task.beads, scale) for half in halves[1]]
        ropes = [_places_by_hue(half, task.beads, scale) for half in halves[0]]
        return np.stack(ropes), np.stack(goals)


def _turned_onto(ropes: Array, goals: Array) -> Array:
    """Return goals (n, beads, 3) about their centres, turned about z to lie on ropes best."""
    rope, other = (shape - shape.mean(axis=1, keepdims=True) for shape in (ropes, goals))
    # as complex numbers, the best turn is the direction of the sum of rope x conjugate of goal
    flat, wanted = (shape[..., 0] + 1j * shape[..., 1] for shape in (rope, other))
    turn = (flat * wanted.conj()).sum(axis=1, keepdims=True)
    turned = wanted * turn / np.maximum(np.abs(turn), 1e-12)
    return np.stack([turned.real, turned.imag, other[..., 2]], axis=2)


@lru_cache(maxsize=1024)
def _remembered(data: bytes, shape: tuple[int, ...], beads: int, scale: float) -> Array:
    return _places_by_hue(np.frombuffer(data, np.uint8).reshape(shape), beads, scale)


def _places_by_hue(picture: NDArray[np.uint8], beads: int, scale: float) -> Array:
    """Place each bead at the middle of the pixels of its colour: float64 (beads, 3), metres.

    Beads that are hidden lie between their neighbours. Heights are 0.
    """
    rows, columns = np.nonzero(picture[..., :3].max(axis=2) > _SEEN)
    seen = picture[rows, columns, :3].astype(np.float64)
    colours = bead_colours(beads).astype(np.float64)
    unit = colours / np.linalg.norm(colours, axis=1, keepdims=True)
    likeness = (seen / np.linalg.norm(seen, axis=1, keepdims=True)) @ unit.T
    best, pure = likeness.argmax(axis=1), likeness.max(axis=1) > _PURE
    count = np.bincount(best[pure], minlength=beads)
    known = np.flatnonzero(count)
    places = np.zeros((beads, 3))
    if not len(known):
        return places
    middle = picture.shape[0] / 2
    for axis, at in enumerate((columns + 0.5 - middle, middle - rows - 0.5)):
        sums = np.bincount(best[pure], weights=at[pure], minlength=beads)
        middles = sums[known] / count[known] / scale
        places[:, axis] = np.interp(np.arange(beads), known, middles, period=beads)
    return places
