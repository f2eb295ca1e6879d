"""The command line: a command is a function, the fields of configurations that are options, and
what it prints. What a command does stands in other rooms. Read `program.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
