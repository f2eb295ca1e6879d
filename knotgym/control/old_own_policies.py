"""Policies from user code: module:name is a function, an object, or a class.

    def act(observation): ...
    def act(observation, info, generator): ...

    class Recurrent:
        def reset(self): ...                    # or reset(generator); called as an episode begins
        def act(self, observation): ...         # or act(observation, info, generator)

Actions are those of the task's action view, by default six numbers in [-1, 1]. Episodes are played
side by side, so each gets its own deep copy of the object; a class is called once, without
arguments, to make the object to copy. Random draws should come from the episode's generator, or the
run can't be repeated.
"""

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

from knotgym.common.errors import InvalidPolicy, one_line
from knotgym.control.policy import Choice, UnplannedPolicy, checked
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig

_PROTOCOL = (
    "must be a function of (observation) or of (observation, info, generator), or an object with"
    " reset and act"
)


class OwnPolicy(UnplannedPolicy):
    """A user's function, or a user's object copied for each episode."""

    def __init__(self, given: Any, name: str) -> None:
        """Wrap a function, an object, or a class.

        Raises:
            InvalidPolicy: it doesn't have the signature of a policy.
        """
        super().__init__(name)
        reset_takes: int | None = None
        if inspect.isclass(given):
            with _user_code(name):
                given = given()
        if callable(getattr(given, "act", None)) and callable(getattr(given, "reset", None)):
            takes, reset_takes = _takes(given.act, (3, 1)), _takes(given.reset, (1, 0))
            if reset_takes is None:
                raise InvalidPolicy(
                    f"policy {name}: reset must take no argument, or the episode's generator"
                )
        else:
            takes = _takes(given, (3, 1)) if callable(given) else None
        if takes is None:
            raise InvalidPolicy(f"policy {name} {_PROTOCOL}")
        self._given, self._takes, self._reset_takes = given, takes, reset_takes
        self._own: dict[int, Any] = {}  # by episode

    def suited(self, task: TaskConfig) -> TaskConfig:
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        self._own[index] = self._given
        if self._reset_takes is not None:
            with _user_code(self._name):
                own = copy.deepcopy(self._given)
                own.reset(*[rng][: self._reset_takes])
            self._own[index] = own

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions = []
        for index in ids.tolist():
            own = self._own[index]
            function = own if self._reset_takes is None else own.act
            seen = (episodes.observation(index), episodes.info(index), self._rngs[index])
            with _user_code(self._name):
                actions.append(function(*seen[: self._takes]))
        return checked(actions, episodes, ids, self._name)


def load_own(module: str, name: str) -> Any:
    """Import a module and return its attribute `name`.

    A module that isn't installed is looked for in the current folder. That folder is on the path
    only during this import, so the module must import its neighbours at the top, not in functions.

    Raises:
        InvalidPolicy: the module or attribute doesn't exist, or importing the module fails.
    """
    try:
        with _current_folder(module.partition(".")[0]):
            return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, SyntaxError) as error:
        raise InvalidPolicy(f"no policy {module}:{name}: {error}") from error
    except Exception as error:
        raise _invalid(f"{module}:{name}", error) from error


def module_files(module: str) -> dict[str, Path]:
    """Find a module's file and the files that it imports, directly or indirectly, from its folder.

    For an installed module, only files of its own package are returned. Imports are read from the
    source, including those inside functions. Data files, and modules whose names are computed at
    run time, aren't found.

    Returns:
        Paths relative to the folder -> paths.
    """
    top, *parts = module.split(".")
    with _user_code(module), _current_folder(top):
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
    """Yield the modules that a source file imports, and the packages that contain them."""
    names: list[str] = []
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):  # importing it reports the error
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom):
            # one dot is the package itself, each further dot a package higher
            above = package.split(".")[: len(package.split(".")) + 1 - node.level]
            base = ".".join([*(above if node.level else []), *filter(None, [node.module])])
            # `from a import b` may import a module a.b, or a name in a
            names += [base, *(f"{base}.{one.name}".lstrip(".") for one in node.names)]
    for name in names:
        parts = name.split(".")
        yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))


@contextmanager
def _current_folder(package: str) -> Iterator[None]:
    """Append the current folder to sys.path unless Python finds the package elsewhere."""
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
def _user_code(name: str) -> Iterator[None]:
    """Run user code; re-raise what it raises as InvalidPolicy."""
    try:
        yield
    except Exception as error:
        raise _invalid(name, error) from error


def _invalid(name: str, error: Exception) -> InvalidPolicy:
    """One line that names the policy, the error, and where it was raised."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(frame.filename).name}, line {frame.lineno}"
    return InvalidPolicy(
        f"policy {name} raised {type(error).__name__}: {one_line(error)} ({place})"
    )


def _takes(function: Callable[..., Any], counts: tuple[int, ...]) -> int | None:
    """The first of these numbers of positional arguments that a function accepts, or None."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some builtins have no signature
        return counts[-1]
    for count in counts:
        try:
            signature.bind(*range(count))
        except TypeError:
            continue
        return count
    return None
