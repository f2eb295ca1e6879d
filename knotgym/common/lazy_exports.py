"""Public names that are imported when they are first asked for (PEP 562), so that a package costs
nothing until it is used.

A package lists its names twice by hand, once for type checkers and once for this; a test compares
the two lists with `__all__`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    package: str, exports: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make a package's `__getattr__` and `__dir__`.

    Args:
        package: its `__name__`.
        exports: public name -> "module" that has it, or "module:name" if it has another name there.
    """

    def __getattr__(name: str) -> Any:
        if name not in exports:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, other = exports[name].partition(":")
        found = getattr(importlib.import_module(module), other or name)
        setattr(sys.modules[package], name, found)
        return found

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *exports})

    return __getattr__, __dir__
