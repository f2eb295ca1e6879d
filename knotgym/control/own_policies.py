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
`control.sampler.Policy` acts in many episodes at once. A module may list the files that it reads,
such as weights, in `FILES`; results hold their digests. Entries hold its `CARD`, a
dictionary of JSON values that says how it was trained.
"""

import copy
import importlib
import importlib.util
import inspect
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from knotgym.common import InvalidPolicy, KnotgymError, one_line
from knotgym.control.basic_policies import ActionPlayer, Generators
from knotgym.control.sampler import Ids, Player, Policy, Pulls
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.loaders import RowPolicy
from knotgym.rope import ActionView


class OwnPolicy:
    """A user's function, or a user's object copied for each episode.

    Attributes:
        name: module:name.
    """

    def __init__(self, given: Any, name: str) -> None:
        """Wrap a function, an object, or a class.

        Raises:
            InvalidPolicy: it doesn't have the signature of a policy.
        """
        self.name = name
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
            raise InvalidPolicy(
                f"policy {name} must be a function of (observation) or of (observation, info,"
                " generator), or an object with reset and act"
            )
        self.given, self.takes, self.reset_takes = given, takes, reset_takes

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Any task."""
        return task

    def player(self, batch: EpisodeBatch) -> ActionPlayer:
        """Return a player for the lanes of a batch."""
        return _OwnPlayer(batch, self)


class _OwnPlayer(ActionPlayer):
    def __init__(self, batch: EpisodeBatch, policy: OwnPolicy) -> None:
        super().__init__(batch, policy.name)
        self._policy = policy
        self._own = [policy.given] * batch.count

    def begin(self, ids: Ids, rngs: Generators) -> None:
        super().begin(ids, rngs)
        if self._policy.reset_takes is not None:
            for index in ids.tolist():
                with _user_code(self.name):
                    self._own[index] = copy.deepcopy(self._policy.given)
                    self._own[index].reset(*[self.rngs[index]][: self._policy.reset_takes])

    def choose(self, ids: Ids) -> Any:
        batch, takes, actions = self.batch, self._policy.takes, []
        for index in ids.tolist():
            own = self._own[index]
            function = own if self._policy.reset_takes is None else own.act
            seen = [batch.observation(index)]
            if takes > 1:
                seen += [batch.info(index), self.rngs[index]]
            with _user_code(self.name):
                # copied at once, as the next call may return the same array
                actions.append(copy.deepcopy(function(*seen)))
        return actions


class _Rows:
    """A model of a library, see `loaders.as_policy`."""

    def __init__(self, given: RowPolicy, name: str) -> None:
        self.name, self._given = name, given

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """The same task as the model sees it."""
        given = self._given
        # a decision is carried out by pulls, which are what the environment gets
        action = "pull" if given.action == "decision" else given.action
        return replace(task, observation=given.observation, frame=given.frame, action=action)

    def player(self, batch: EpisodeBatch) -> ActionPlayer:
        return _RowPlayer(batch, self._given, self.name)


class _RowPlayer(ActionPlayer):
    def __init__(self, batch: EpisodeBatch, given: RowPolicy, name: str) -> None:
        super().__init__(batch, name, ActionView(given.action, batch.simulation))
        self._given = given

    def choose(self, ids: Ids) -> Any:
        with _user_code(self.name):
            return self._given.actions(self.batch.observations(ids))


class _Guarded:
    """A user's `Policy`, whose errors are one line."""

    def __init__(self, given: Any, name: str) -> None:
        self.name, self._given = name, given

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        with _user_code(self.name):
            found: TaskConfig = self._given.compatible_task(task)
        return found

    def player(self, batch: EpisodeBatch) -> Player:
        with _user_code(self.name):
            return _GuardedPlayer(self._given.player(batch), self.name)


class _GuardedPlayer:
    def __init__(self, player: Any, name: str) -> None:
        self._player, self._name, self.planned = player, name, player.planned

    def begin(self, ids: Ids, rngs: Generators) -> None:
        with _user_code(self._name):
            self._player.begin(ids, rngs)

    def act(self, ids: Ids) -> Pulls:
        with _user_code(self._name):
            found: Pulls = self._player.act(ids)
        return found


def load_own(name: str) -> Policy:
    """Import a module and make a policy of its attribute; `name` is module:name.

    A module that isn't installed is looked for in the current folder. That folder is on the path
    only during this import, so the module must import its neighbours at the top, not in functions.

    Raises:
        InvalidPolicy: the module or attribute doesn't exist, isn't a policy, or importing the
            module fails.
    """
    module, _, attribute = name.partition(":")
    try:
        # the current folder is searched, too, as by `python -m`
        with _current_folder(module.partition(".")[0]):
            given = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, SyntaxError) as error:
        raise InvalidPolicy(f"no policy {name}: {one_line(error)}") from error
    except (Exception, SystemExit) as error:
        raise _invalid(name, error) from error
    if isinstance(given, RowPolicy):
        return _Rows(given, name)
    if callable(getattr(given, "player", None)) and not inspect.isclass(given):
        return _Guarded(given, name)
    return OwnPolicy(given, name)


def module_files(name: str) -> dict[str, Path]:
    """Return the source files of a policy module:name, and the module's FILES, by their names.

    For a module in a package, the sources are those of the top package; other files that it imports
    aren't found.
    """
    module = name.partition(":")[0]
    top = module.partition(".")[0]
    with _user_code(name), _current_folder(top):
        spec = importlib.util.find_spec(top)
        read = [Path(file) for file in getattr(importlib.import_module(module), "FILES", ())]
    found = {path.name: path for path in read}
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return found
    own = Path(spec.origin)
    if not spec.submodule_search_locations:
        return found | {own.name: own}
    # the whole package: which of its modules the policy uses isn't known without running it
    files = own.parent.rglob("*.py")
    return found | {path.relative_to(own.parent.parent).as_posix(): path for path in files}


def module_card(name: str) -> dict[str, Any] | None:
    """Return a copy of the CARD of the module of a policy module:name; None if it has none.

    Raises:
        InvalidPolicy: it isn't a dictionary of JSON's values, or importing the module fails.
    """
    module = name.partition(":")[0]
    with _user_code(name), _current_folder(module.partition(".")[0]):
        card = getattr(importlib.import_module(module), "CARD", None)
    try:
        found: Any = json.loads(json.dumps(card, allow_nan=False))
    except (RecursionError, TypeError, ValueError) as error:
        raise InvalidPolicy(f"policy {name}: its CARD isn't JSON: {one_line(error)}") from error
    if not isinstance(found, dict | None):
        raise InvalidPolicy(f"policy {name}: its CARD must be a dictionary")
    return found


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
    """Run user code; re-raise what it raises, even by `sys.exit`, as InvalidPolicy."""
    try:
        yield
    except KnotgymError:
        raise
    except (Exception, SystemExit) as error:
        raise _invalid(name, error) from error


def _invalid(name: str, error: BaseException) -> InvalidPolicy:
    """One line that names the policy, the error, and where it was raised."""
    # the innermost frame is where the user's code, or a library that it called, went wrong
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
