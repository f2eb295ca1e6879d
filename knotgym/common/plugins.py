"""Plugins: modules of others that register kinds, such as tasks and policies, when imported.

`--plugin MODULE` names one, and packages that are installed name theirs by entry points of the
group `knotgym.plugins`. Those are also imported where a name is looked up that nothing registered.
No file of data names one. Workers import what the process that started them did.
"""

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from knotgym.common.errors import InvalidInput, KnotgymError, one_line

GROUP = "knotgym.plugins"
_imported: dict[str, ModuleType] = {}
_installed = list[str]()


@contextmanager
def near(module: str) -> Iterator[None]:
    """In the block, import a module from the current folder if it isn't installed.

    That is on the path only there, so the module must import its neighbours at the top.
    """
    package, searched = module.partition(".")[0], list(sys.path)
    if package not in sys.modules and importlib.util.find_spec(package) is None:
        sys.path.append(os.getcwd())  # searched, too, as by `python -m`
    try:
        yield
    finally:
        sys.path[:] = searched


def use_plugins(names: Iterable[str] = ()) -> None:
    """Import plugins, and those that are installed, once.

    Raises:
        InvalidInput: one isn't a module, or importing it fails.
    """
    if not _installed:
        _installed.extend(["", *sorted(one.value for one in entry_points(group=GROUP))])
    for name in dict.fromkeys([*_installed[1:], *names]):
        if name in _imported:
            continue
        if not all(map(str.isidentifier, name.split("."))):
            raise InvalidInput(f"a plugin is a module, such as mine, got {name!r}")
        try:
            with near(name):
                _imported[name] = importlib.import_module(name)
        except (Exception, SystemExit) as error:
            what = one_line(error) if isinstance(error, KnotgymError) else repr(error)
            raise InvalidInput(f"plugin {name} can't be imported: {one_line(what)}") from error


def plugins() -> dict[str, Path | str]:
    """Return the plugins that were imported, and the source of each, or "" where it has none."""
    sources = ((name, getattr(one, "__file__", None)) for name, one in _imported.items())
    return {name: Path(source) if source else "" for name, source in sources}
