"""Tasks and the Gymnasium environments: starts and goals, observations, the one reward. It plays no
policy and writes no file. Read `tasks.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
