"""The numbers of the rope's model, found by the errors it makes on episodes.

A stretch of an episode begins at rest, as episodes do. First the numbers that the whole rope shares
are searched, then which joints don't resist bending, each tried by itself, then the first again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.learn.rope_model import BEADS, FIRST_GUESS, NAMES, stepped

Array = NDArray[np.float64]

STAGES = ("shared", "joints", "joints again", "shared again")
SUBSTEPS = 3  # of an action, when fitting
_SHARED = len(NAMES)
_STRIDE = 0.3  # of the first random changes, in logarithms


class Stretches(NamedTuple):
    """The first k actions of n episodes.

    Attributes:
        points: float64 (k + 1, n, BEADS, 3), metres.
        beads: int64 (k, n), pulled.
        forces: float64 (k, n, 3), newtons.
    """

    points: Array
    beads: NDArray[np.int64]
    forces: Array


def error(numbers: Array, stretches: Stretches) -> float:
    """How far vertices end from where they did, metres, mean over all states."""
    points, total = stretches.points[0].copy(), 0.0
    velocities = np.zeros_like(points)
    for beads, forces, after in zip(
        stretches.beads, stretches.forces, stretches.points[1:], strict=True
    ):
        stepped(points, velocities, beads, forces, numbers, SUBSTEPS)
        total += float(np.linalg.norm(points - after, axis=2).mean())
    return total / len(stretches.beads)


def fitted(
    stretches: Stretches,
    rng: np.random.Generator,
    tries: int,
    told: Callable[[str, float], None] = lambda stage, error: None,
) -> Array:
    """The numbers, as `rope_model.FIRST_GUESS`.

    Args:
        stretches: to fit.
        rng: decides what is tried.
        tries: of the shared numbers, before and after the joints.
        told: called with what was searched, and the error.
    """
    numbers, least = _searched(FIRST_GUESS.copy(), stretches, rng, tries)
    told(STAGES[0], least)
    for stage in STAGES[1:3]:
        gains = np.array([least - error(_free(numbers, i), stretches) for i in range(BEADS)])
        for joint in np.argsort(-gains)[: np.count_nonzero(gains > 0)]:
            freed = _free(numbers, int(joint))
            found = error(freed, stretches)
            if found < 0.995 * least:
                numbers, least = freed, found
        told(stage, least)
    numbers, least = _searched(numbers, stretches, rng, tries)
    told(STAGES[3], least)
    return numbers


def _free(numbers: Array, joint: int) -> Array:
    """The same with one joint that doesn't resist bending."""
    freed = numbers.copy()
    freed[_SHARED + joint] = 0.0
    return freed


def _searched(
    numbers: Array, stretches: Stretches, rng: np.random.Generator, tries: int
) -> tuple[Array, float]:
    """Change the shared numbers at random, and keep what helps."""
    least, stride = error(numbers, stretches), _STRIDE
    for _ in range(tries):
        factors = np.exp(stride * rng.normal(size=_SHARED + 1) * (rng.random(_SHARED + 1) < 0.5))
        changed = numbers.copy()
        changed[:_SHARED] *= factors[:_SHARED]
        changed[_SHARED:] *= factors[_SHARED]
        changed[4] = min(changed[4], 0.011)  # wider than a rope is, strands would never rest
        found = error(changed, stretches)
        if found < least:
            numbers, least, stride = changed, found, min(_STRIDE, 1.3 * stride)
        else:
            stride = max(0.02, 0.93 * stride)
    return numbers, least
