"""Long runs: recipes whose results are kept in a journal, so that they resume and run in shards. It
doesn't know what a recipe computes. Read `runner.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
