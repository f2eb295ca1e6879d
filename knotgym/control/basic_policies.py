"""Policies without a plan: random and constant actions, and what players of actions share."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidInput, InvalidPolicy, one_line
from knotgym.control.rollouts import Ids, Pulls
from knotgym.envs.environment import action_space
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.actions import choices, nearest_beads
from knotgym.rope.simulation import ROUNDING

Generators = Sequence[np.random.Generator]


class ActionPlayer:
    """Chooses actions of the task's view, which pulls carry out; subclasses define `choose`.

    Attributes:
        batch: the episodes.
        name: of the policy, for error messages.
        planned: int64 (lanes,), 0: nothing is simulated.
        rngs: the generator of the episode in each lane.
    """

    def __init__(self, batch: EpisodeBatch, name: str) -> None:
        self.batch, self.name = batch, name
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self.rngs: list[np.random.Generator] = [np.random.default_rng(0)] * batch.count
        self._pulled = np.zeros(batch.count, dtype=bool)  # since the view last looked

    def begin(self, ids: Ids, rngs: Generators) -> None:
        """Keep the generators of the episodes."""
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            self.rngs[index] = rng
        self._pulled[ids] = False

    def choose(self, ids: Ids) -> Any:
        """Return one action of the task's view for each of the lanes; the caller checks them."""
        raise NotImplementedError

    def act(self, ids: Ids) -> Pulls:
        """Choose actions, and return the pulls that carry them out."""
        batch = self.batch
        if batch.task.action == "pull":
            actions = _checked(self.choose(ids), batch, self.name)
            positions = batch.simulation.rope.config.reach * actions[:, :3].astype(np.float64)
            beads = nearest_beads(batch.simulation.points[ids], positions)
            return Pulls(ids, beads, actions[:, 3:])
        view = batch.view
        before = ids[self._pulled[ids]]
        view.pulled(before, np.zeros(len(before), dtype=bool))
        deciding = ids[~view.busy[ids]]
        if len(deciding):
            view.begin(_checked(self.choose(deciding), batch, self.name), deciding)
        self._pulled[ids] = True
        beads, forces = view.pulls_of(ids)
        if batch.task.action != "macro":
            return Pulls(ids, beads, forces)
        macros = np.column_stack([view.pulls[ids] == 0, view.macros[ids]])
        return Pulls(ids, beads, forces, macros)


class RandomPolicy:
    """Uniform actions of the task's view."""

    name = "random"

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Any task."""
        return task

    def player(self, batch: EpisodeBatch) -> ActionPlayer:
        """Return a player for the lanes of a batch."""
        return _RandomPlayer(batch, self.name)


class _RandomPlayer(ActionPlayer):
    def __init__(self, batch: EpisodeBatch, name: str) -> None:
        super().__init__(batch, name)
        # all pulls of an episode, drawn when it begins
        self._drawn = np.zeros((batch.count, batch.task.horizon, 6), dtype=np.float32)
        self._pulls = batch.task.action == "pull"
        if not self._pulls:
            self._counts = choices(batch.task.action, batch.task.beads)

    def begin(self, ids: Ids, rngs: Generators) -> None:
        super().begin(ids, rngs)
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            if self._pulls:
                self._drawn[index] = rng.uniform(-1, 1, self._drawn.shape[1:])

    def choose(self, ids: Ids) -> NDArray[Any]:
        if self._pulls:
            drawn: NDArray[Any] = self._drawn[ids, self.batch.steps[ids]]
            return drawn
        return np.stack([self.rngs[index].integers(self._counts) for index in ids.tolist()])


class ConstantPolicy:
    """The same pull at every step, which tows the rope."""

    name = "constant"

    def __init__(self, action: ArrayLike = (1.0,) * 6) -> None:
        """Take `action`, (6,) in [-1, 1]."""
        self._action = np.asarray(action, dtype=np.float32)

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Tasks whose actions are pulls."""
        return pull_task(task)

    def player(self, batch: EpisodeBatch) -> ActionPlayer:
        """Return a player for the lanes of a batch."""
        return _ConstantPlayer(batch, self.name, self._action)


class _ConstantPlayer(ActionPlayer):
    def __init__(self, batch: EpisodeBatch, name: str, action: NDArray[np.float32]) -> None:
        super().__init__(batch, name)
        self._action = action

    def choose(self, ids: Ids) -> NDArray[np.float32]:
        return np.tile(self._action, (len(ids), 1))


def pull_task(task: TaskConfig) -> TaskConfig:
    """Return a task whose actions are pulls.

    Raises:
        InvalidPolicy: its actions are of another view.
    """
    if task.action != "pull":
        raise InvalidPolicy(
            f"this policy chooses pulls, so its action must be 'pull', got {task.action!r}"
        )
    return task


def _checked(actions: Any, batch: EpisodeBatch, name: str) -> NDArray[np.float32]:
    """Check the actions of user code or of a model, by the rules of the environment's `step`.

    Args:
        actions: one per episode that acts.
        batch: the episodes.
        name: of the policy, for error messages.

    Returns:
        float32 (n, size of an action); pulls are clipped to [-1, 1].

    Raises:
        InvalidPolicy: an action isn't one of the task's view, such as six finite numbers in
            [-1, 1].
    """
    (size,) = action_space(batch.task).shape or ()
    numbers = "finite numbers in [-1, 1]" if size == 6 else "whole numbers"
    wanted = f"policy {name} must give {size} {numbers} for an episode"
    if not (isinstance(actions, np.ndarray) and actions.dtype == np.float32):
        try:
            rows = [np.asarray(action, dtype=np.float32).reshape(-1) for action in actions]
        except (TypeError, ValueError) as error:
            raise InvalidPolicy(f"{wanted}: {one_line(error)}") from error
        for row in rows:
            if len(row) != size:
                raise InvalidPolicy(f"{wanted}, got {row.tolist()[:8]}")
        actions = np.stack(rows)
    if size == 6:
        bad = ~(np.abs(actions) <= 1 + ROUNDING).all(axis=1)
        if bad.any():
            raise InvalidPolicy(f"{wanted}, got {actions[bad][0].tolist()}")
        return np.clip(actions, -1, 1)
    try:
        batch.view.check(actions, np.arange(len(actions)))
    except InvalidInput as error:
        raise InvalidPolicy(f"{wanted}: {one_line(error)}") from error
    checked_actions: NDArray[np.float32] = actions
    return checked_actions
