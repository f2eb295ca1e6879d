"""Vision-language models put to the tasks: prompts, a client with limits, answers, transcripts. It
never scores an episode by other rules than the environment's. Read `prompts.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
