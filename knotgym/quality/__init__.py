"""Measures of a state, the limits that a set may put on them, and how hard a picture is to read. It
judges states and never changes them. Read `limits.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
