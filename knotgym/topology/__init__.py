"""Knot theory of a rope's projection: crossings, Gauss codes and other notations, symmetries, knot
types. It takes points and codes, and never needs the simulator. Read `crossings.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
