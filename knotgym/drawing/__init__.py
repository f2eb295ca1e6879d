"""From a Gauss code to a curve: planar map, circle packing, relaxation. Whether the rope can lie so
is for others to check. Read `curves.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
