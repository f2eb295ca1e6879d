"""Evaluate vision-language models: prompts, a client with limits, answers, transcripts."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
