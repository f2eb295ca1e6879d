"""The interface of policies: they act in a batch of episodes, with a generator per episode."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput, InvalidPolicy, one_line
from knotgym.envs.environment import action_space
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig

NO_MACRO = (0, -1, -1, 0)  # see `Choice.macros`


class Choice(NamedTuple):
    """Actions for n episodes.

    Attributes:
        actions: actions of the task's view, see `knotgym.rope.action_views`; pulls are float32
            (n, 6), in [-1, 1].
        moves: n reasons of a word or two; "" where the policy gives none.
        macros: int64 (n, 4), the macro-action that each pull is part of: whether it is the first
            pull, then the bead, target and side; NO_MACRO where it is part of none. None if the
            policy doesn't say.
    """

    actions: NDArray[Any]
    moves: list[str]
    macros: NDArray[np.int64] | None = None


def checked(
    actions: list[Any], episodes: EpisodeBatch, ids: NDArray[np.int64], name: str
) -> Choice:
    """Validate the actions of user code or a model, by the rules of the environment's `step`.

    Args:
        actions: one per episode in `ids`.
        episodes: the batch.
        ids: episodes to act in.
        name: of the policy, for error messages.

    Raises:
        InvalidPolicy: an action isn't one of the task's view, such as six finite numbers in
            [-1, 1].
    """
    space = action_space(episodes.config)
    (size,) = space.shape or ()
    numbers = "finite numbers in [-1, 1]" if size == 6 else "whole numbers"
    wanted = f"policy {name} must give {size} {numbers} for an episode"
    try:
        rows = [np.asarray(action, dtype=np.float32).reshape(-1) for action in actions]
    except (TypeError, ValueError) as error:
        raise InvalidPolicy(f"{wanted}: {one_line(error)}") from error
    for row in rows:
        if len(row) != size:
            raise InvalidPolicy(f"{wanted}, got {row.tolist()[:8]}")
    array = np.stack(rows)
    try:
        episodes.view.check(array, ids)
    except InvalidInput as error:
        raise InvalidPolicy(f"{wanted}: {one_line(error)}") from error
    if size == 6:
        array = np.clip(array, -1, 1)
    return Choice(array, [""] * len(actions))


class Effort(NamedTuple):
    """Cost of planning in one episode.

    Attributes:
        actions: actions simulated.
        seconds: wall time.
    """

    actions: int = 0
    seconds: float = 0.0

    def plus(self, other: Effort) -> Effort:
        """The sum of two costs."""
        return Effort(self.actions + other.actions, self.seconds + other.seconds)


class Policy(Protocol):
    """Acts in the episodes of one batch."""

    def suited(self, task: TaskConfig) -> TaskConfig:
        """Return the task with the observation that this policy needs.

        Called before any episode begins. A policy that can act in any task returns it unchanged;
        most choose pulls.

        Raises:
            InvalidPolicy: the task lacks something that the policy needs, such as a view.
        """
        if task.action != "pull":
            raise InvalidPolicy(
                f"this policy chooses pulls, so its action must be 'pull', got {task.action!r}"
            )
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        """Start episode `index`; all random draws for it must come from `rng`."""

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        """Choose actions for the episodes `ids`, which are in increasing order."""

    def name(self, index: int) -> str:
        """The name of the policy that acts in episode `index`."""

    def effort(self, index: int) -> Effort:
        """The cost of planning in episode `index` so far."""


class UnplannedPolicy(Policy):
    """Base of policies that don't plan: a name, and a generator for each episode."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._rngs: dict[int, np.random.Generator] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._rngs[index] = rng

    def name(self, index: int) -> str:
        return self._name

    def effort(self, index: int) -> Effort:
        return Effort()
