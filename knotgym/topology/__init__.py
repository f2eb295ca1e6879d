"""Knot theory of the rope's projection: crossings, Gauss codes, diagrams, knots, symmetries.

Nothing here needs the simulator.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
