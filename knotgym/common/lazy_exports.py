"""Lazy imports of a package's public names (PEP 562), which keep `import knotgym` fast.

A package lists its names twice by hand: once for type checkers and once for `lazy_exports`. A test
compares both lists with `__all__`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    package: str, exports: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make the `__getattr__` and `__dir__` of a package.

    Args:
        package: the `__name__` of the package.
        exports: maps a public name to its module, or to "module:name" if it is called `name` there.
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
