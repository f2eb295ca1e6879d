"""Fit the rope model's parameters to episodes by random search on its prediction error.

Each stretch starts at the beginning of an episode, where the rope is at rest, so no velocity has to
be estimated. The search alternates: first the parameters that the whole rope shares, then which
joints bend freely (tried one by one), then the shared ones again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.learn.rope_model import BEADS, FIRST_GUESS, NAMES, stepped

Array = NDArray[np.float64]

STAGES = ("shared", "joints", "joints again", "shared again")
SUBSTEPS = 3  # integration steps per action while fitting
_SHARED = len(NAMES)
# Initial and largest step of the random search: standard deviation of a parameter's logarithm.
_STRIDE = 0.3


class Stretches(NamedTuple):
    """The first k actions of n episodes.

    Attributes:
        points: float64 (k + 1, n, BEADS, 3), metres.
        beads: int64 (k, n), the bead pulled by each action.
        forces: float64 (k, n, 3), newtons.
    """

    points: Array
    beads: NDArray[np.int64]
    forces: Array


def error(parameters: Array, stretches: Stretches) -> float:
    """Return the mean distance of predicted and true bead positions over all states, metres.

    Predictions are open-loop: only the first state is given, so errors accumulate as in planning.
    """
    points, total = stretches.points[0].copy(), 0.0
    velocities = np.zeros_like(points)
    for beads, forces, after in zip(
        stretches.beads, stretches.forces, stretches.points[1:], strict=True
    ):
        stepped(points, velocities, beads, forces, parameters, SUBSTEPS)
        total += float(np.linalg.norm(points - after, axis=2).mean())
    return total / len(stretches.beads)


def fit(
    stretches: Stretches,
    rng: np.random.Generator,
    tries: int,
    on_stage: Callable[[str, float], None] = lambda stage, error: None,
) -> Array:
    """Fit the parameters, laid out like `rope_model.FIRST_GUESS`.

    Args:
        stretches: to fit.
        rng: draws the candidates.
        tries: candidates for the shared parameters, both before and after the joints.
        on_stage: called after each stage with its name and the error in metres.
    """
    parameters, least = _search_shared(FIRST_GUESS.copy(), stretches, rng, tries)
    on_stage(STAGES[0], least)
    # Two greedy passes over the joints: a joint that didn't help alone may help once others are
    # free. A pass first ranks the joints by the error that freeing each of them alone would save.
    for stage in STAGES[1:3]:
        gains = np.array([least - error(_free(parameters, i), stretches) for i in range(BEADS)])
        for joint in np.argsort(-gains)[: np.count_nonzero(gains > 0)]:
            freed = _free(parameters, int(joint))
            found = error(freed, stretches)
            # at least half a percent better, or noise would free joints that do resist
            if found < 0.995 * least:
                parameters, least = freed, found
        on_stage(stage, least)
    parameters, least = _search_shared(parameters, stretches, rng, tries)
    on_stage(STAGES[3], least)
    return parameters


def _free(parameters: Array, joint: int) -> Array:
    """Copy the parameters, with one joint that bends freely."""
    freed = parameters.copy()
    freed[_SHARED + joint] = 0.0
    return freed


def _search_shared(
    parameters: Array, stretches: Stretches, rng: np.random.Generator, tries: int
) -> tuple[Array, float]:
    """Improve the shared parameters by random search; return them and their error, metres.

    All parameters are positive, so a candidate multiplies them by log-normal factors. One more
    factor scales the resistance of all joints together and leaves free joints free.
    """
    least, stride = error(parameters, stretches), _STRIDE
    for _ in range(tries):
        # each factor changes with probability 1/2, so that few parameters change at a time
        factors = np.exp(stride * rng.normal(size=_SHARED + 1) * (rng.random(_SHARED + 1) < 0.5))
        changed = parameters.copy()
        changed[:_SHARED] *= factors[:_SHARED]
        changed[_SHARED:] *= factors[_SHARED]
        # parameter 4 is the distance that strands keep, metres; if it is wider than the rope
        # itself, strands never come to rest
        changed[4] = min(changed[4], 0.011)
        found = error(changed, stretches)
        # Step sizes adapt as in a (1+1) evolution strategy: these two factors balance at one
        # success in about five tries.
        if found < least:
            parameters, least, stride = changed, found, min(_STRIDE, 1.3 * stride)
        else:
            stride = max(0.02, 0.93 * stride)
    return parameters, least
