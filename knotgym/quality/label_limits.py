"""Margins that make the Gauss code of a configuration unambiguous and its picture true."""

import numpy as np

from knotgym.common.configuration import NonNegative, configuration
from knotgym.topology.crossings import Crossings, visit_spacing


@configuration
class LabelLimits:
    """Smallest distances from a configuration with another Gauss code.

    Attributes:
        visits: distance along the rope between two visits, beads; 0.25 is 3 mm, and rounding
            errors are 1e-12 of that.
        base: distance from either end of the white base bead to the nearest visit outside it,
            beads.
        clearance: distance between the axes at a crossing, millimetres, above which the strands are
            painted in the right order (see `rendering.rasterizer`).
    """

    visits: NonNegative = 0.25
    base: NonNegative = 0.25
    clearance: NonNegative = 7.0


LABEL_LIMITS = LabelLimits()


def visits_too_close(crossings: Crossings, beads: int, limits: LabelLimits = LABEL_LIMITS) -> bool:
    """Return whether two visits are so close that their order is ambiguous."""
    return visit_spacing(crossings, beads) < limits.visits


def at_base(crossings: Crossings, beads: int, limits: LabelLimits = LABEL_LIMITS) -> bool:
    """Return whether a crossing is so close to the base bead that it could be first or last."""
    visits = np.concatenate([crossings.over_place, crossings.under_place])
    return bool(((visits < 1 + limits.base) | (visits > beads - limits.base)).any())


def pressed_together(clearance: float, limits: LabelLimits = LABEL_LIMITS) -> bool:
    """Return whether a clearance, millimetres, is so small that either strand may be on top."""
    return clearance < limits.clearance
