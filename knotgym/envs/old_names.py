"""Names of `EpisodeBatch` that policies of the old protocol use; goes with the last of them."""

from typing import Any

import numpy as np

from knotgym.rope.actions import decode_actions


class _Codes:
    """`codes[index]`, a GaussCode with chirality; or `codes(ids)`, a list of them."""

    def __init__(self, batch: Any) -> None:
        self._batch = batch

    def __getitem__(self, index: int) -> Any:
        return self._batch.codes_of(np.array([index]))[0]

    def __call__(self, ids: Any) -> Any:
        return self._batch.codes_of(ids)


class _Goals:
    """The goal states; `goals[index]` is the code of a rope's goal."""

    def __init__(self, batch: Any, states: Any) -> None:
        self._batch, self._states = batch, states

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._states, name)

    def __getitem__(self, index: int) -> Any:
        return self._batch.goals_of(np.array([index]))[0]

    def __setitem__(self, index: int, code: Any) -> None:
        self._batch.seek(np.array([index]), [code])


class OldNames:
    """See this module."""

    def old_goals(self: Any, states: Any) -> Any:
        return _Goals(self, states)

    @property
    def codes(self) -> Any:
        return _Codes(self)

    @property
    def config(self: Any) -> Any:
        return self.task

    @property
    def origins(self: Any) -> Any:
        return self.centre

    def begin_many(self: Any, ids: Any, rngs: Any, options: Any = None) -> None:
        self.begin(ids, rngs, options)

    def step(self: Any, actions: Any, ids: Any) -> Any:
        self.simulation.read_actions(actions, ids)
        a = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)
        beads, _ = decode_actions(a, self.simulation.points[ids], self.simulation.rope.config)
        outcome = self.pull(ids, beads, a[:, 3:])
        self.view.pulled(ids, outcome.terminated | outcome.truncated)
        return outcome

    def symbols(self: Any, index: int) -> Any:
        from knotgym.envs.observations import symbols

        return symbols([self.codes[index]], [self.goals[index]])[0]

    def picture(self: Any, index: int) -> Any:
        return self._pictures(np.array([index]))[0]

    def state(self: Any, index: int) -> Any:
        return (
            np.concatenate([self.simulation.points[index], self.goals.points[self.goal_row[index]]])
            .astype(np.float32)
            .ravel()
        )
