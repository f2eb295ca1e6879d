"""The filter that every state passes, wherever it comes from: which frames of a rope are kept.

A state keeps the limits of its source (legible, not over-twisted), survives reset noise, has the
same Gauss code for two independent labellers, and its knot is certified.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from knotgym.quality import Limits, Quality, measure, noise_survival
from knotgym.topology import UNKNOT, GaussCode, find_crossings, pyknotid_code, shows


class Judgement(NamedTuple):
    """What a configuration shows, its quality, and why it can't be a state; [] if it can."""

    code: GaussCode
    quality: Quality
    faults: list[str]


def judge(
    points: ArrayLike,
    limits: Sequence[Limits],
    *,
    code: GaussCode | None = None,
    knot: str = UNKNOT,
) -> Judgement:
    """Judge a configuration at rest, from cheap to costly checks; the first to fail ends it.

    Args:
        points: float64 (beads, 3), metres.
        limits: all must be kept.
        code: that it must show, with chirality; None for any code of the knot.
        knot: name in the knot table of the rope's knot.
    """
    p = np.asarray(points, dtype=np.float64)
    crossings = find_crossings(p)
    shown = crossings.code

    def judged(quality: Quality) -> Judgement:
        missed = [fault for one in limits for fault in one.faults(quality, crossings.nx)]
        return Judgement(shown, quality, list(dict.fromkeys(missed)))

    found = judged(measure(p, crossings, quick=True))
    if code is not None and shown != code:
        found.faults.append("code lost at rest")
    if not found.faults:
        found = judged(measure(p, crossings))
    if not found.faults:
        found = judged(replace(found.quality, noise_survival=noise_survival(p)))
    if not found.faults and pyknotid_code(p) != shown:
        found.faults.append("labellers disagree")
    if not found.faults and code is None and not shows(shown, knot):
        found.faults.append(f"not certified as {knot}")
    return found
