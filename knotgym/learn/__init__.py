"""Learners: one from pictures, which plans; a clone of macro-actions; a reader. They need torch."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
