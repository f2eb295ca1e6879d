"""Learners and their training, from pictures and from demonstrations; they need torch. Nothing
below knows of them. Read `train_recipe.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
