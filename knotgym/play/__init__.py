"""A page in the browser to pull the rope by hand, watch policies, and record both. It serves this
machine alone. Read `session.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
