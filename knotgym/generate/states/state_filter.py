"""The filter that every state passes, wherever it comes from: which frames of a rope are kept.

A state keeps the limits of its source (legible, not over-twisted), survives reset noise, has the
same Gauss code for two independent labellers, and its knot is certified.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from knotgym.common.configuration import Positive, Share, configuration
from knotgym.quality.limits import RESET_NOISE, Quality
from knotgym.quality.measures import measure, noise_survival
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import shows
from knotgym.topology.reference_labeller import pyknotid_code


@configuration
class TwistLimits:
    """Limits that leave out over-twisted states; legibility is another matter.

    Attributes:
        excess_crossing_number: maximum, see `quality.limits.Quality`; it counts turns of the rope
            about itself that the picture doesn't show.
        total_curvature: maximum, in turns.
        noise_survival: minimum; a reset draws noise up to twenty times at full scale, so at 0.25
            all draws lose the code in only 3 of 1,000 resets.
    """

    excess_crossing_number: Positive = 4.0
    total_curvature: Positive = 5.0
    noise_survival: Share = 0.25

    def faults(self, quality: Quality, nx: int) -> list[str]:
        """Return the measures that miss their limit; one that isn't measured (NaN) passes."""
        missed = {
            "excess_crossing_number": quality.excess_crossing_number > self.excess_crossing_number,
            "total_curvature": quality.total_curvature > self.total_curvature,
            "noise_survival": quality.noise_survival < self.noise_survival,
        }
        return [name for name, short in missed.items() if short]


class StateLimits(Protocol):
    """Limits on the quality of a state: `quality.limits.Limits` or `TwistLimits`."""

    def faults(self, quality: Quality, nx: int) -> list[str]:
        """Return the measures that miss their limit."""


class Judgement(NamedTuple):
    """What a configuration shows, its quality, and why it can't be a state; [] if it can."""

    code: GaussCode
    quality: Quality
    faults: list[str]


def judge(
    points: ArrayLike,
    limits: Sequence[StateLimits],
    rng: np.random.Generator,
    *,
    code: GaussCode | None = None,
    knot: str = UNKNOT,
) -> Judgement:
    """Judge a configuration at rest, from cheap to costly checks; the first to fail ends it.

    Args:
        points: float64 (beads, 3), metres.
        limits: all must be kept.
        rng: of the reset noise.
        code: that it must show, with chirality; None for any code of the knot.
        knot: name in the knot table of the rope's knot.
    """
    crossings = find_crossings(np.asarray(points, dtype=np.float64))
    shown = crossings.code

    def faults(quality: Quality) -> Judgement:
        missed = [fault for one in limits for fault in one.faults(quality, crossings.nx)]
        return Judgement(shown, quality, list(dict.fromkeys(missed)))

    found = faults(measure(points, crossings, quick=True))
    if code is not None and shown != code:
        found.faults.append("code lost at rest")
    if not found.faults:
        found = faults(measure(points, crossings))
    if not found.faults:
        survival = noise_survival(points, RESET_NOISE, rng)
        found = faults(replace(found.quality, noise_survival=survival))
    if not found.faults and pyknotid_code(points) != shown:
        found.faults.append("labellers disagree")
    if not found.faults and code is None and not shows(shown, knot):
        found.faults.append(f"not certified as {knot}")
    return found
