"""Lazy imports of a package's public names (PEP 562), which keep `import knotgym` fast."""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    package: str, modules: Mapping[str, str], *eager: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make `__getattr__`, `__dir__` and `__all__` of a package.

    Args:
        package: the package's `__name__`.
        modules: module -> the public names that it defines, separated by spaces; name=original for
            one that is called otherwise there.
        eager: public names that the package defines itself.
    """

    places: dict[str, tuple[str, str]] = {}  # public name -> module, and the name there
    for module, names in modules.items():
        for word in names.split():
            name, _, original = word.partition("=")
            places[name] = module, original or name

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, original = places[name]
        found = getattr(importlib.import_module(module), original)
        setattr(sys.modules[package], name, found)
        return found

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *places})

    return __getattr__, __dir__, sorted([*places, *eager])
