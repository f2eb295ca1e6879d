"""Policies, and the one loop that plays them: random, scripted, planning, recorded, a user's. It
keeps nothing on disk. Read `sampler.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
