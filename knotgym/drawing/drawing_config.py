"""Settings of drawings; nothing here computes, because the command line reads them."""

from knotgym.common.configuration import Count, NonNegative, Positive, configuration


@configuration
class LayoutRelaxationConfig:
    """Strengths of the forces, relative to the pressure of a face with share 1.

    Attributes:
        first: iterations with the segments as given.
        later: iterations after each time all segments have been split in two.
        segments: splitting stops at this many segments or more.
        tension: strength of the tension; 1 balances the pressures.
        power: exponent that makes small faces push harder; with 0, a pressure is share / area, and
            the larger it is the more equal the areas become.
        bending: bending stiffness, per face.
        reach: distance within which strands push each other away; 0.025 is 6 pixels.
        push: strength of the repulsion between strands, per face.
        crossing: stiffness of the right angles at crossings.
        most: largest displacement of a node per iteration.
        step: fraction of the Newton step that is taken.
    """

    first: Count = 300
    later: Count = 200
    segments: Count = 90
    tension: NonNegative = 1.0
    power: NonNegative = 1.0
    bending: NonNegative = 0.0007
    reach: Positive = 0.025
    push: NonNegative = 80000.0
    crossing: NonNegative = 2.0
    most: Positive = 0.01
    step: Positive = 0.4


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
        easing: settings of the layout relaxation.
    """

    uneven: NonNegative = 0.25
    outer: NonNegative = 3.0
    height: Positive = 0.014
    base: NonNegative = 0.03
    easing: LayoutRelaxationConfig = LayoutRelaxationConfig()  # state files store this name
