"""What a policy is: one interface for a batch of ropes, every draw from a generator handed in."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from knotgym.episode_batch import EpisodeBatch
from knotgym.errors import KnotgymError, one_line
from knotgym.simulation import InvalidAction
from knotgym.tasks import TaskConfig


class InvalidPolicy(KnotgymError, ValueError):
    """There is no such policy, or it doesn't do what a policy does."""


class Choice(NamedTuple):
    """What a policy does in n episodes.

    Attributes:
        actions: float32 (n, 6), in [-1, 1].
        moves: why, a word or two each, "" where the policy gives no reasons.
    """

    actions: NDArray[np.float32]
    moves: list[str]


def checked(
    actions: list[Any], episodes: EpisodeBatch, ids: NDArray[np.int64], name: str
) -> Choice:
    """Actions of somebody else's policy, refused as the environment's `step` refuses them.

    Raises:
        InvalidPolicy: not six finite numbers in [-1, 1] for each of the episodes `ids`.
    """
    wanted = f"policy {name} must give 6 finite numbers in [-1, 1] for an episode"
    try:
        rows = [np.asarray(action, dtype=np.float32).reshape(-1) for action in actions]
    except (TypeError, ValueError) as error:
        raise InvalidPolicy(f"{wanted}: {one_line(error)}") from error
    for row in rows:
        if len(row) != 6:
            raise InvalidPolicy(f"{wanted}, got {row.tolist()[:8]}")
    array = np.stack(rows)
    try:
        episodes.simulation.read_actions(array, ids)
    except InvalidAction as error:
        raise InvalidPolicy(f"{wanted}: {one_line(error)}") from error
    return Choice(np.clip(array, -1, 1), [""] * len(actions))


class Effort(NamedTuple):
    """What planning an episode took: simulated actions, and seconds of wall time."""

    actions: int = 0
    seconds: float = 0.0

    def plus(self, other: Effort) -> Effort:
        """Both."""
        return Effort(self.actions + other.actions, self.seconds + other.seconds)


class Policy(Protocol):
    """Acts in any of the episodes of one batch, each from its own generator."""

    def suited(self, task: TaskConfig) -> TaskConfig:
        """Return the task with the observation that this policy takes.

        Called before any episode begins. A policy that takes any task returns it as it is.

        Raises:
            InvalidPolicy: the task lacks something that the policy needs, such as a view.
        """
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        """Episode `index` has begun; every draw for it comes from `rng`."""

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        """Decide for the episodes `ids`, in rising order."""

    def name(self, index: int) -> str:
        """Who acts in episode `index`."""

    def effort(self, index: int) -> Effort:
        """What planning took in episode `index` so far."""


class PlanningPolicy(Policy, Protocol):
    """A policy that can be told that its plan no longer holds."""

    def replan(self, index: int) -> None:
        """Plan anew before the next action."""


class UnplannedPolicy(Policy):
    """What policies without plans share: a name, and a generator for each episode."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._rngs: dict[int, np.random.Generator] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._rngs[index] = rng

    def name(self, index: int) -> str:
        return self._name

    def effort(self, index: int) -> Effort:
        return Effort()
