"""Random actions, and what players of actions share."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Ids, InvalidInput, InvalidPolicy
from knotgym.control.sampler import Pulls
from knotgym.envs import EpisodeBatch
from knotgym.rope import ActionView


class ActionPlayer(ABC):
    """Chooses actions of a view, which pulls carry out; subclasses define `choose`.

    Attributes:
        batch: the episodes.
        name: of the policy, for error messages.
        view: of the actions; that of the task, unless a subclass gives another.
        is_canonical: whether they are in the ropes' own frames; as in the task.
        planned: int64 (lanes,), 0: nothing is simulated.
        rngs: the generator of the episode in each lane.
    """

    def __init__(self, batch: EpisodeBatch, name: str, view: ActionView | None = None) -> None:
        self.batch, self.name, self.view = batch, name, view or batch.view
        self.is_canonical = batch.task.is_canonical
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self.rngs: list[np.random.Generator] = [np.random.default_rng(0)] * batch.count
        self._pulled = np.zeros(batch.count, dtype=bool)  # since the view last looked

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        """Keep the generators of the episodes."""
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            self.rngs[index] = rng
        self._pulled[ids] = False
        self.view.reset(ids)

    @abstractmethod
    def choose(self, ids: Ids) -> Any:
        """Return one action of the view for each of the lanes; the caller checks them."""

    def act(self, ids: Ids) -> Pulls:
        """Choose actions, and return the pulls that carry them out."""
        view = self.view
        # The view learns of a pull when its lane acts again: then it can see where the bead is.
        before = ids[self._pulled[ids]]
        view.pulled(before, np.zeros(len(before), dtype=bool))
        deciding = ids[~view.busy[ids]]
        if len(deciding):
            actions = _checked(self.choose(deciding), view, self.name)
            if self.is_canonical:
                actions = self.batch.world_actions(view, actions, deciding).astype(np.float32)
            view.begin(actions, deciding)
        self._pulled[ids] = True
        beads, strong = view.pulls_of(ids)
        forces = strong.astype(np.float32)
        if not view.kind.is_macro:
            return Pulls(ids, beads, forces)
        # whether this pull is the first of its macro-action, then bead, target and side
        macros = np.column_stack([view.pulls[ids] == 0, view.macros[ids]])
        return Pulls(ids, beads, forces, macros)


class RandomPlayer(ActionPlayer):
    """Chooses uniform actions of the task's view."""

    def __init__(self, batch: EpisodeBatch) -> None:
        super().__init__(batch, "random")
        # all pulls of an episode, drawn when it begins
        size = self.view.size
        self._drawn = np.zeros((batch.count, batch.task.horizon, size), dtype=np.float32)

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        super().begin(ids, rngs)
        if self.view.counts is None:
            self._drawn[ids] = [rng.uniform(-1, 1, self._drawn.shape[1:]) for rng in rngs]

    def choose(self, ids: Ids) -> Any:
        if self.view.counts is None:
            return self._drawn[ids, self.batch.steps[ids]]
        return np.stack([self.rngs[index].integers(self.view.counts) for index in ids.tolist()])


def _checked(actions: Any, view: ActionView, name: str) -> NDArray[Any]:
    """Check the actions of user code or of a model, by the rules of the environment's `step`.

    Args:
        actions: one per episode that acts.
        view: of the actions.
        name: of the policy, for error messages.

    Returns:
        float32 (n, size of an action); pulls are clipped to [-1, 1].

    Raises:
        InvalidPolicy: an action isn't one of the view, such as six finite numbers in [-1, 1].
    """
    size = view.size
    numbers = "finite numbers in [-1, 1]" if view.counts is None else "whole numbers"
    wanted = f"policy {name} must give {size} {numbers} for an episode"
    checked = isinstance(actions, np.ndarray) and actions.dtype == np.float32
    if not (checked and actions.shape[1:] == (size,)):
        with InvalidPolicy.instead(wanted, TypeError, ValueError):
            # one by one, so that a message can show the action that is wrong
            every = [np.asarray(action).reshape(-1) for action in actions]
            # not of text, nor of complex numbers, which would lose a part
            rows = [action.astype(np.float32, casting="same_kind") for action in every]
        for row in rows:
            if len(row) != size:
                raise InvalidPolicy(f"{wanted}, got {row.tolist()[:8]}")
        actions = np.stack(rows)
    with InvalidPolicy.instead(wanted, InvalidInput):
        view.check(actions, np.arange(len(actions)))
    return np.clip(actions, -1, 1) if view.counts is None else np.asarray(actions)
