"""Files of rope states: schema, reading, writing, splits, and the shipped sets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
