"""The rope in a browser: pull it by hand, watch episodes, record them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
