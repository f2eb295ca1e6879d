"""Segments: the stretches of a dataset's episodes that its transitions are taken from.

A segment is a whole episode or, with hindsight relabelling, the start of an episode up to a code
that it reached. All of it is index arithmetic on the columns of the dataset:

    states         N + S of them: the states of all segments, one after the other; `states` has
                   the row of steps of each
    transition t   of segment s leads from state t + s to state t + s + 1
"""

from functools import cached_property

import numpy as np

from knotgym.common import Ids
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig


class Segments:
    """S segments of a set of episodes, with N transitions.

    Attributes:
        episodes: the episodes.
        task: their environment.
        relabelled: whether segments end at codes that were reached, which are their goals.
        leads: whether a transition is a macro-action.
        episode, goal_step, starts: see `Transitions`.
        states: int64 (N + S,), the row of steps of each state.
        first: int64 (S,), the row of steps that each segment's episode begins in.
    """

    def __init__(
        self, episodes: Episodes, task: TaskConfig, relabel: str | None, *, leads: bool
    ) -> None:
        """Cut episodes into segments.

        Args:
            episodes: the episodes.
            task: their environment.
            relabel: see `Opening`.
            leads: whether a transition is a macro-action.
        """
        self.episodes, self.task = episodes, task
        self.relabelled, self.leads = relabel is not None, leads
        if relabel is None:
            self.episode, lengths = np.arange(episodes.episodes.rows), episodes.episodes["length"]
            self.goal_step = np.full(len(lengths), -1)
        else:
            self.episode, lengths = episodes.goals_reached(task, relabel)
            self.goal_step = lengths
        first = episodes.offsets[self.episode]
        counts, states = lengths, Episodes.ranges(first, lengths + 1)
        if leads:
            # transitions begin where macro-actions do; the last state of a segment ends the last
            begun = np.flatnonzero(episodes.steps["macro_start"])
            at, end = np.searchsorted(begun, first), np.searchsorted(begun, first + lengths)
            kept, counts = end > at, (end - at)[end > at]
            self.episode, self.goal_step = self.episode[kept], self.goal_step[kept]
            states = np.append(begun, 0)[Episodes.ranges(at[kept], counts + 1)]
            states[np.cumsum(counts + 1) - 1] = (first + lengths)[kept]
        self.starts: Ids = np.concatenate([[0], np.cumsum(counts)])
        self.states: Ids = states
        self.first: Ids = episodes.offsets[self.episode]

    def of(self, rows: Ids) -> Ids:
        """Return the segments of transitions."""
        return np.searchsorted(self.starts, rows, side="right") - 1

    @cached_property
    def before(self) -> Ids:
        """The row of steps that each transition begins in: (N,)."""
        return np.delete(self.states, self.starts[1:] + np.arange(len(self.first)))

    @cached_property
    def after(self) -> Ids:
        """The row of steps that each transition ends in: (N,)."""
        return np.delete(self.states, self.starts[:-1] + np.arange(len(self.first)))

    @cached_property
    def codes_held(self) -> tuple[Ids, Ids]:
        """`Episodes.codes_held` of the states of all segments."""
        codes, held = self.episodes.codes_held(self.task)
        return codes[self.states], held[self.states]
