"""Draw ropes from Gauss codes: planar map, circle packing, layout relaxation, lifting."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
