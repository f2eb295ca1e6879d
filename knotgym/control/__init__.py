"""Action sequences, macro-actions, the planner, the expert, and policies by name."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
