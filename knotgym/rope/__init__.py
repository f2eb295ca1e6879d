"""The closed rope: its model, two engines behind one interface, pulls and macro-actions. It knows
neither tasks nor pictures. Read `interface.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
