"""Tables of episodes and pictures: reading, writing, checking by computing again, selecting, cards,
the page, exports. It never plays an episode. Read `episodes.py` first.
"""

import lazy_loader

if __name__ == "datasets":
    raise ImportError(
        "this is the link `datasets` at the top of a checkout of knotgym: import knotgym.datasets;"
        " for Hugging Face's datasets run Python from another folder, or as `python -P`"
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
