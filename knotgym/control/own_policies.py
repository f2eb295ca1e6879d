"""Policies of the user's own: module:name is a function, an object, or a class of such objects.

    def act(observation): ...
    def act(observation, info, generator): ...

    class Recurrent:
        def reset(self): ...                    # or reset(generator); an episode begins
        def act(self, observation): ...         # or act(observation, info, generator)

Each gives six numbers in [-1, 1]. Episodes are played side by side, so every episode has a copy of
an object to itself; a class is called once, without arguments, for the object that is copied. Every
draw comes from the episode's generator.
"""

from __future__ import annotations

import ast
import copy
import importlib
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.control.policy import Choice, InvalidPolicy, UnplannedPolicy, checked
from knotgym.episode_batch import EpisodeBatch
from knotgym.errors import one_line

_PROTOCOL = (
    "must be a function of (observation) or of (observation, info, generator), or an object with"
    " reset and act"
)


class OwnPolicy(UnplannedPolicy):
    """A function of the user's, or an object with a copy for each episode.

    Raises:
        InvalidPolicy: it is neither.
    """

    def __init__(self, given: Any, name: str) -> None:
        super().__init__(name)
        reset_takes: int | None = None
        if inspect.isclass(given):
            with _theirs(name):
                given = given()
        if callable(getattr(given, "act", None)) and callable(getattr(given, "reset", None)):
            takes, reset_takes = _takes(given.act, (3, 1)), _takes(given.reset, (1, 0))
            if reset_takes is None:
                raise InvalidPolicy(
                    f"policy {name}: its reset must take nothing, or the episode's generator"
                )
        else:
            takes = _takes(given, (3, 1)) if callable(given) else None
        if takes is None:
            raise InvalidPolicy(f"policy {name} {_PROTOCOL}")
        self._given, self._takes, self._reset_takes = given, takes, reset_takes
        self._own: dict[int, Any] = {}  # by episode

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        self._own[index] = self._given
        if self._reset_takes is not None:
            with _theirs(self._name):
                own = copy.deepcopy(self._given)
                own.reset(*[rng][: self._reset_takes])
            self._own[index] = own

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions = []
        for index in ids.tolist():
            own = self._own[index]
            function = own if self._reset_takes is None else own.act
            seen = (episodes.observation(index), episodes.info(index), self._rngs[index])
            with _theirs(self._name):
                actions.append(function(*seen[: self._takes]))
        return checked(actions, episodes, ids, self._name)


def load_own(module: str, name: str) -> Any:
    """Import a module and return what it calls `name`.

    A module that isn't installed is looked for in the current folder. That folder is on the path
    only during this import: the module imports its neighbours at its top, not later.

    Raises:
        InvalidPolicy: there is no such thing, or the module raises.
    """
    try:
        with _current_folder(module.partition(".")[0]):
            return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, SyntaxError) as error:
        raise InvalidPolicy(f"no policy {module}:{name}: {error}") from error
    except Exception as error:
        raise _said(f"{module}:{name}", error) from error


def module_files(module: str) -> dict[str, Path]:
    """A module's file and those that it imports, directly or not, from its own folder, by their
    paths in there; of an installed module those of its own package.

    Imports are read from the source, those inside of functions too. Files that are read as data,
    and modules that are named only while running, can't be known.
    """
    top, *parts = module.split(".")
    with _theirs(module), _current_folder(top):
        spec = importlib.util.find_spec(top)
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return {}
    own = Path(spec.origin)
    root = own.parent.parent if spec.submodule_search_locations else own.parent
    installed = "site-packages" in root.parts
    found: dict[str, Path] = {}
    left = [".".join([top, *parts[:count]]) for count in range(len(parts) + 1)]
    while left:
        name = left.pop()
        if not name or (installed and name.split(".")[0] != top):
            continue
        place = root.joinpath(*name.split("."))
        for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
            inside = path.relative_to(root).as_posix()
            if path.is_file() and inside not in found:
                found[inside] = path
                package = name if path.name == "__init__.py" else name.rpartition(".")[0]
                left += _imported(path.read_bytes(), package)
    return found


def _imported(source: bytes, package: str) -> Iterator[str]:
    """The modules that a source in a package may import, with the packages that they lie in."""
    names: list[str] = []
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):  # whoever imports it says so
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level]
            base = ".".join([*(above if node.level else []), *filter(None, [node.module])])
            names += [base, *(f"{base}.{one.name}".lstrip(".") for one in node.names)]
    for name in names:
        parts = name.split(".")
        yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))


@contextmanager
def _current_folder(package: str) -> Iterator[None]:
    """Search the current folder too, last, if Python finds no such package elsewhere."""
    if package in sys.modules or importlib.util.find_spec(package) is not None:
        yield
        return
    searched = list(sys.path)
    sys.path.append(os.getcwd())
    try:
        yield
    finally:
        sys.path[:] = searched


@contextmanager
def _theirs(name: str) -> Iterator[None]:
    """Code of the user's: what it raises is told in one line, as its own."""
    try:
        yield
    except Exception as error:
        raise _said(name, error) from error


def _said(name: str, error: Exception) -> InvalidPolicy:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(frame.filename).name}, line {frame.lineno}"
    said = f"{type(error).__name__}: {one_line(error)}"
    return InvalidPolicy(f"policy {name} raised {said} ({place})")


def _takes(function: Callable[..., Any], counts: tuple[int, ...]) -> int | None:
    """The first of these numbers of arguments that a function can be called with."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # a builtin doesn't say
        return counts[-1]
    for count in counts:
        try:
            signature.bind(*range(count))
        except TypeError:
            continue
        return count
    return None
