"""The recipes behind the commands: states, episodes, evaluations, the fixed benchmark, pictures.
What they compute stands in the rooms below. Read `collection.py` first.

The names below are imported when they are first used.
"""

import lazy_loader

if __name__ == "generate":
    raise ImportError(
        "this is the link `generate` at the top of a checkout of knotgym: import knotgym.generate"
    )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
