"""What every room builds on: errors, random streams, configurations, tables with schemas, files
that are written whole or not at all. It knows nothing of knots or ropes. Read `tables.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
