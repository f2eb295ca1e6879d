"""The table of rope states: schema, file, splits, near duplicates, and the sets that ship. It never
makes a state. Read `schema.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
