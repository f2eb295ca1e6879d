"""Photos of rope of one colour: drawn with all answers, and read by a small network. Only reading
needs torch. Read `photo.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
