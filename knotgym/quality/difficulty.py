"""How hard a picture is to read, in four grades.

Reading a code is a chain that breaks at its weakest link: one crossing that can't be made out
spoils all of it. So the grade is that of the worst of the five measures of the picture, each in
units of what an accepted state must have of it: "easy" from 1.5 times the limit up, "medium" from
the limit up, "hard" from half of it, "extreme" below. The other limits (margin, clearance, twist,
survival of noise) are about the rope and not about reading it; they bear on `accepted` alone.
"""

from __future__ import annotations

from knotgym.quality.limits import Limits, Quality

READING = (
    "crossing_angle",
    "crossing_spacing",
    "base_spacing",
    "strand_spacing",
    "smallest_region",
)
EASE = {"easy": 1.5, "medium": 1.0, "hard": 0.5, "extreme": 0.0}  # grade -> from which ease up


def ease(quality: Quality, limits: Limits) -> float:
    """The worst of the READING measures, each divided by its limit; 1 is just acceptable."""
    return min(getattr(quality, measure) / getattr(limits, measure) for measure in READING)


def grade(quality: Quality, limits: Limits) -> str:
    """The grade of a picture, one of `datasets.image_table.GRADES`."""
    return grade_of(ease(quality, limits))


def grade_of(ease: float) -> str:
    """The grade that an ease means."""
    return next((grade for grade, least in EASE.items() if ease >= least), "extreme")
