"""Pictures of the rope: camera, appearances, diagrams, film. It draws points that it is given and
never simulates. Read `picture.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
