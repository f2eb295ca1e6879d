"""Difficulty of reading a picture, in four grades.

A single crossing that can't be made out spoils the whole code, so the worst of five measures of the
picture decides the grade. Each measure is divided by its limit: "easy" from 1.5 up, "medium" from 1
up, "hard" from 0.5 up, "extreme" below. The other limits (margin, clearance, twist, survival of
noise) concern the rope rather than the reading and affect `accepted` only.
"""

from knotgym.quality.limits import Limits, Quality

READING = (
    "crossing_angle",
    "crossing_spacing",
    "base_spacing",
    "strand_spacing",
    "smallest_region",
)
EASE = {"easy": 1.5, "medium": 1.0, "hard": 0.5, "extreme": 0.0}  # grade -> smallest ease


def ease(quality: Quality, limits: Limits) -> float:
    """Return the smallest of the READING measures, each divided by its limit; 1 is acceptable."""
    return min(getattr(quality, measure) / getattr(limits, measure) for measure in READING)


def grade(quality: Quality, limits: Limits) -> str:
    """Return the grade of a picture, one of `datasets.image_table.GRADES`."""
    return grade_of(ease(quality, limits))


def grade_of(ease: float) -> str:
    """Return the grade of an ease."""
    return next((grade for grade, least in EASE.items() if ease >= least), "extreme")
