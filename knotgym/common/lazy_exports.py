"""Lazy imports of a package's public names (PEP 562), which keep `import knotgym` fast.

A package lists its names once, as imports for type checkers; they become imports on first use.
"""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_exports(
    package: str, file: str, *eager: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make `__getattr__`, `__dir__` and `__all__` of a package from its `__name__` and `__file__`.

    The exported names are those that `file` imports in its block `if TYPE_CHECKING:`, and `eager`.
    """
    exports = {
        alias.asname or alias.name: (node.module, alias.name)
        for block in ast.parse(Path(file).read_text("utf-8")).body
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }

    def __getattr__(name: str) -> Any:
        if name not in exports:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, original = exports[name]
        found = getattr(importlib.import_module(module), original)
        setattr(sys.modules[package], name, found)
        return found

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *exports})

    return __getattr__, __dir__, sorted([*exports, *eager])
