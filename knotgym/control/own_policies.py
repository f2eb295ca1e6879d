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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from knotgym.common import Ids, InvalidPolicy
from knotgym.control.basic_policies import ActionPlayer
from knotgym.control.policies import user_code
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.sampler import Player, Policy, Pulls, SimplePolicy
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import ActionView


def own_policy(given: Any, name: str) -> SimplePolicy:
    """Make a policy of a user's function, object or class; objects are copied for each episode.

    Raises:
        InvalidPolicy: it doesn't have the signature of a policy.
    """
    reset_takes: int | None = None
    if inspect.isclass(given):
        with user_code(name):
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
            own = self._own[index]
            function = own if self._reset_takes is None else own.act
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
    from knotgym.loaders import RowPolicy  # here, as few policies are models

    if isinstance(given, RowPolicy):
        # a decision is carried out by pulls, which are what the environment gets
        action = "pull" if given.action == "decision" else given.action
        seen = {"observation": given.observation, "frame": given.frame, "action": action}
        return SimplePolicy(name, partial(_RowPlayer, name, given), partial(replace, **seen))
    if not callable(getattr(given, "player", None)) or inspect.isclass(given):
        return own_policy(given, name)

    def _compatible_task(task: TaskConfig) -> TaskConfig:
        with user_code(name):
            found: TaskConfig = given.compatible_task(task)
        return found

    return SimplePolicy(name, partial(_GuardedPlayer, name, given), _compatible_task)


def files(name: str) -> dict[str, Path]:
    """Return the source files of a policy module:name, and the module's FILES, by their names.

    For a module in a package, the sources are those of the top package; other files that it imports
    aren't found.
    """
    with user_code(name), _module_of(name) as module:
        spec = importlib.util.find_spec(module.__name__.partition(".")[0])
        read = [Path(file) for file in getattr(module, "FILES", ())]
    found = {path.name: path for path in read}
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return found
    own = Path(spec.origin)
    if not spec.submodule_search_locations:
        return found | {own.name: own}
    # the whole package: which of its modules the policy uses isn't known without running it
    sources = own.parent.rglob("*.py")
    return found | {path.relative_to(own.parent.parent).as_posix(): path for path in sources}


def card_of(name: str) -> dict[str, Any] | None:
    """Return a copy of the CARD of the module of a policy module:name; None if it has none.

    Raises:
        InvalidPolicy: it isn't a dictionary of JSON's values, or importing the module fails.
    """
    with user_code(name), _module_of(name) as module:
        card = getattr(module, "CARD", None)
    said = f"policy {name}: its CARD isn't JSON"
    with InvalidPolicy.instead(said, RecursionError, TypeError, ValueError):
        found: Any = json.loads(json.dumps(card, allow_nan=False))
    if not isinstance(found, dict | None):
        raise InvalidPolicy(f"policy {name}: its CARD must be a dictionary")
    return found


@contextmanager
def _module_of(name: str) -> Iterator[ModuleType]:
    """Import the module of a policy module:name, from the current folder if it isn't installed.

    That folder is on the path only while the module is in use here.
    """
    module = name.partition(":")[0]
    package, searched = module.partition(".")[0], list(sys.path)
    if package in sys.modules or importlib.util.find_spec(package) is not None:
        yield importlib.import_module(module)
        return
    sys.path.append(os.getcwd())  # searched, too, as by `python -m`
    try:
        yield importlib.import_module(module)
    finally:
        sys.path[:] = searched


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
