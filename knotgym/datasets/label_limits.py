"""What a picture's configuration keeps to, lest its label be in doubt or its picture untrue."""

from __future__ import annotations

import numpy as np

from knotgym.topology.crossings import Crossings, visit_spacing

VISITS = 0.25  # beads along the rope between two visits, 3 mm; rounding moves them by 1e-12 of that
BASE = 0.25  # beads from either end of the white base bead to the nearest visit outside it: 3 mm
# millimetres between the axes at a crossing, from which the order of painting is true (see
# `rendering.rasterizer`)
CLEARANCE = 7.0


def visits_too_close(crossings: Crossings, beads: int) -> bool:
    """Whether two visits lie within VISITS, so that either could be the first."""
    return visit_spacing(crossings, beads).visits < VISITS


def at_base(crossings: Crossings, beads: int) -> bool:
    """Whether a crossing lies within BASE of the white bead: is it counted first or last?"""
    places = np.concatenate([crossings.over_place, crossings.under_place])
    return bool(((places < 1 + BASE) | (places > beads - BASE)).any())


def pressed_together(clearance: float) -> bool:
    """Whether strands that cross are so near, millimetres, that either could be painted on top."""
    return clearance < CLEARANCE
