"""Policies from user code: module:name is a function, an object, a class, or a `Policy`.

    def act(observation): ...
    def act(observation, info, generator): ...

    class Recurrent:
        def reset(self): ...                    # or reset(generator); called as an episode begins
        def act(self, observation): ...         # or act(observation, info, generator)

Actions are those of the task's action view, by default six numbers in [-1, 1]. Episodes are played
side by side, so each gets its own deep copy of the object; a class is called once, without
arguments, to make the object to copy. Random draws should come from the episode's generator, or the
run can't be repeated. A model of a library acts by `loaders.as_policy`, and a
`control.sampler.Policy` acts in many episodes at once. Results hold digests of the module, of what
it imports from its folder, and of the files that it opens there; a module may list others that it
reads, such as weights, in `FILES`. Entries hold its `CARD`, a dictionary of JSON values that says
how it was trained.
"""

import ast
import copy
import importlib
import importlib.util
import inspect
import json
import os
import site
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, partial
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import knotgym
from knotgym.common import Ids, InvalidPolicy, by_name, near
from knotgym.control.basic_policies import ActionPlayer
from knotgym.control.policies import user_code
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.sampler import Player, Policy, Pulls, SimplePolicy
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import VIEWS, ActionView

_opened: dict[str, set[str]] = defaultdict(set)  # by module, and by policy
_noted: list[set[str]] = []  # of `_opened`, what gets the files that are opened now


def own_policy(given: Any, name: str) -> SimplePolicy:
    """Make a policy of a user's `Policy`, model, function, object or class.

    Raises:
        InvalidPolicy: it doesn't have the signature of a policy.
    """
    from knotgym.loaders import RowPolicy  # here, as few policies are models

    if isinstance(given, RowPolicy):
        action = VIEWS[given.action].acts_as or given.action
        seen = {"observation": given.observation, "frame": given.frame, "action": action}
        return SimplePolicy(name, partial(_RowPlayer, name, given), partial(replace, **seen))
    if callable(getattr(given, "player", None)) and not inspect.isclass(given):

        def _compatible_task(task: TaskConfig) -> TaskConfig:
            with user_code(name):
                return given.compatible_task(task)

        return SimplePolicy(name, partial(_GuardedPlayer, name, given), _compatible_task)
    if inspect.isclass(given):
        with user_code(name):
            given = given()
    resets = callable(getattr(given, "act", None)) and callable(getattr(given, "reset", None))
    reset_takes = _takes(given.reset, (1, 0)) if resets else None
    if resets and reset_takes is None:
        raise InvalidPolicy(
            f"policy {name}: reset must take no argument, or the episode's generator"
        )
    takes = _takes(given.act if resets else given, (3, 1))
    if takes is None:
        raise InvalidPolicy(
            f"policy {name} must be a function of (observation) or of (observation, info,"
            " generator), or an object with reset and act"
        )
    return SimplePolicy(name, partial(_OwnPlayer, name, given, takes, reset_takes))


class _OwnPlayer(ActionPlayer):
    def __init__(
        self, name: str, given: Any, takes: int, reset_takes: int | None, batch: EpisodeBatch
    ) -> None:
        super().__init__(batch, name)
        self._given, self._takes, self._reset_takes = given, takes, reset_takes
        self._own = [given] * batch.count

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        super().begin(ids, rngs)
        if self._reset_takes is not None:
            for index in ids.tolist():
                with user_code(self.name):
                    self._own[index] = copy.deepcopy(self._given)
                    self._own[index].reset(*[self.rngs[index]][: self._reset_takes])

    def choose(self, ids: Ids) -> Any:
        batch, actions = self.batch, []
        for index in ids.tolist():
            policy = self._own[index]
            function = policy if self._reset_takes is None else policy.act
            seen = [batch.observation(index)]
            if self._takes > 1:
                seen += [*batch.info_rows(np.array([index])), self.rngs[index]]
            with user_code(self.name):
                # copied at once, as the next call may return the same array
                actions.append(copy.deepcopy(function(*seen)))
        return actions


class _RowPlayer(ActionPlayer):
    """Acts by a model of a library, see `loaders.as_policy`."""

    def __init__(self, name: str, given: Any, batch: EpisodeBatch) -> None:
        super().__init__(batch, name, ActionView(given.action, batch.simulation))
        self._given = given

    def choose(self, ids: Ids) -> Any:
        with user_code(self.name):
            return self._given.actions(self.batch.observations(ids))


class _GuardedPlayer(Player):
    """Acts by a user's `Policy`; its errors are one line."""

    def __init__(self, name: str, given: Policy, batch: EpisodeBatch) -> None:
        self._name = name
        with user_code(name):
            self._player = given.player(batch)
            self.planned = self._player.planned

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        with user_code(self._name):
            self._player.begin(ids, rngs)

    def act(self, ids: Ids) -> Pulls:
        with user_code(self._name):
            return self._player.act(ids)


def load(config: PolicyConfig) -> Policy:
    """Import a module and make a policy of its attribute.

    A module that isn't installed is looked for in the current folder. That folder is on the path
    only during this import, so the module must import its neighbours at the top, not in functions.

    Raises:
        InvalidPolicy: the module or attribute doesn't exist, isn't a policy, or importing the
            module fails.
    """
    name = config.policy
    missing = InvalidPolicy.instead(f"no policy {name}", ImportError, AttributeError, SyntaxError)
    with user_code(name), missing, _module_of(name) as module:
        given = getattr(module, name.partition(":")[2])
    with _noting(name):
        return own_policy(given, name)


def files(name: str) -> dict[str, Path]:
    """Return the files that a policy module:name is made of and reads, by names.

    They are the module's FILES, its source and, of its folder, each module or package that it or
    another of them imports, and each file that was opened while it was imported or made. A package
    counts whole: which of its modules the policy uses isn't known without running it. What
    libraries in other languages open isn't noticed, and belongs in FILES.
    """
    load(PolicyConfig(policy=name))
    with user_code(name), _module_of(name) as module:
        listed = [(path.name, path) for path in map(Path, getattr(module, "FILES", ()))]
        root, sources = _sources(module)
    if root is None:
        return by_name(listed)
    used = [Path(path) for key in (module.__name__, name) for path in sorted(_opened[key])]
    # compiled modules and what lies elsewhere, such as in a library, has a version
    used = [path for path in used if path.is_relative_to(root) and "__pycache__" not in path.parts]
    for ours in (Path(knotgym.__file__).parent, Path(sys.prefix)):
        used = [path for path in used if not path.is_relative_to(ours)]
    known = {path.resolve() for _, path in listed}
    used = [path for path in (*sources, *used) if path.is_file() and path.resolve() not in known]
    return by_name([*((path.relative_to(root).as_posix(), path) for path in used), *listed])


def _sources(module: ModuleType) -> tuple[Path | None, list[Path]]:
    """Return the folder that a module is imported from, and the sources in it that it leads to.

    Of a module that is installed these are those of its own package; None if it has no source.
    """
    origin = getattr(module, "__file__", None) or ""
    if not origin.endswith(".py"):
        return None, []
    depth = module.__name__.count(".") + hasattr(module, "__path__")
    root = Path(origin).absolute().parents[depth]
    names, sources = [module.__name__.partition(".")[0]], dict[Path, None]()
    is_installed = str(root) in site.getsitepackages()
    for name in names:  # which grows
        place, spec = root / name, PathFinder.find_spec(name, [*sys.path, str(root)])
        there = [spec.origin, *(spec.submodule_search_locations or ())] if spec else []
        if not any(path and Path(path).is_relative_to(root) for path in there):
            continue  # another of this name is imported
        files = [*place.rglob("*.py")] if place.is_dir() else [place.with_suffix(".py")]
        sources |= dict.fromkeys(sorted(files))
        for file in () if is_installed else files:
            names += sorted(_imported(file) - {*names, "knotgym"})
    return root, [*sources]


def _imported(source: Path) -> Set[str]:
    """Return the top modules that a source imports anywhere; none if it isn't Python."""
    names = set[str]()
    with suppress(OSError, SyntaxError, ValueError):
        for node in ast.walk(ast.parse(source.read_bytes())):
            if isinstance(node, ast.Import):
                names |= {each.name.partition(".")[0] for each in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.partition(".")[0])
    return names


def card_of(name: str) -> dict[str, Any] | None:
    """Return a copy of the CARD of the module of a policy module:name; None if it has none.

    Raises:
        InvalidPolicy: it isn't a dictionary of JSON's values, or importing the module fails.
    """
    with user_code(name), _module_of(name) as module:
        card = getattr(module, "CARD", None)
    said = f"policy {name}: its CARD isn't JSON"
    with InvalidPolicy.instead(said, RecursionError, TypeError, ValueError):
        copied: Any = json.loads(json.dumps(card, allow_nan=False))
    if not isinstance(copied, dict | None):
        raise InvalidPolicy(f"policy {name}: its CARD must be a dictionary")
    return copied


@contextmanager
def _module_of(name: str) -> Iterator[ModuleType]:
    """Import the module of a policy module:name, from the current folder if it isn't installed.

    That folder is on the path only while the module is in use here.
    """
    module = name.partition(":")[0]
    with near(module):
        with _noting(module):
            imported = importlib.import_module(module)
        yield imported


@contextmanager
def _noting(key: str) -> Iterator[None]:
    """Note the files that Python opens to read in the block, under a key of `_opened`."""
    _hook()
    _noted.append(_opened[key])
    try:
        yield
    finally:
        _noted.pop()


@cache
def _hook() -> None:
    """Begin to hear of opened files, once; a hook can't be taken away."""

    def _hear(event: str, given: tuple[Any, ...]) -> None:
        if event == "open" and _noted and isinstance(given[0], str | bytes | os.PathLike):
            mode, flags = given[1] or "r", given[2] or 0
            if not {*"wax+"} & {*mode} and not flags & (os.O_WRONLY | os.O_RDWR):
                _noted[-1].add(os.path.abspath(os.fsdecode(given[0])))

    sys.addaudithook(_hear)


def _takes(function: Callable[..., Any], counts: tuple[int, ...]) -> int | None:
    """The first of these numbers of positional arguments that a function accepts, or None."""
    if not callable(function):
        return None
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
