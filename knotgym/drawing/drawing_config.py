"""Settings of drawings; nothing here computes, because the command line reads them."""

from pydantic import NonNegativeFloat, PositiveFloat

from knotgym.common import configuration


@configuration
class DrawingConfig:
    """Settings of a drawing.

    Attributes:
        uneven: standard deviation of the logarithm of a face's share of the area.
        outer: exponent; a face is the outer one with probability proportional to this power of its
            number of edges.
        height: vertical distance of the strands at a crossing, metres.
        base: smallest distance along the rope from the base bead to a crossing, metres; less where
            the edge is too short.
    """

    # A height of 14 mm leaves 4 between beads that would touch at 10; the limit on clearance is 8.
    # The others were set by eye, without a record.
    uneven: NonNegativeFloat = 0.25
    outer: NonNegativeFloat = 3.0
    height: PositiveFloat = 0.014
    base: NonNegativeFloat = 0.03
