"""A whole dataset as a dict of arrays, one row per transition (the keys of D4RL and OGBench)."""

from typing import Any, Unpack

import numpy as np

from knotgym.common import Stream, generator
from knotgym.loaders.transitions import Opening, Transitions


def arrays(dataset: Any, **opening: Unpack[Opening]) -> dict[str, Any]:
    """Load all N transitions of a dataset, in the order of its episodes.

    Args:
        dataset, opening: see `knotgym.loaders`.

    Returns:
        observations, next_observations: uint8 (N, views * size, 2 size, 3 or 4), float32
            (N, 6 beads), dicts of both, or int16 (N, 2, symbols). Each picture is held twice,
            which takes 200 kB per transition at size 128 with one view and no depth. With
            `stack`, an axis of that length follows N.
        actions: float32 (N, 6); int64 (N, 4) in the view "bead" and (N, 3) in "macro". With
            `chunk`, an axis of that length follows N, and action_mask, bool (N, chunk), says which
            actions the episode has; the others are zeros.
        rewards: float64 (N,).
        pulls: int64 (N,), in the view "macro" and with a window only: pulls from one observation to
            the next, to discount by.
        terminals, timeouts: bool (N,); exactly one of them is true in the last row of an episode.
        discounts: float64 (N,), with a window only: what to multiply the value of the next
            observation with.
        history, next_history: actions (N, history, 6), with `history` only: those that led to the
            observation and to the next one, the latest last. history_mask and next_history_mask,
            bool (N, history), say which actions the episode has; the others are zeros.
        negatives: (N, negatives, ...), with `negatives` only: the halves of observations that show
            a goal.
    """
    return rows(Transitions(dataset, **opening))


def rows(transitions: Transitions) -> dict[str, Any]:
    """Load opened transitions; return what `arrays` does."""
    loaded = transitions.batch(np.arange(len(transitions)), rng=drawn_generator(transitions))
    if transitions.action == "macro":
        loaded.setdefault("pulls", transitions.pulls)
    return loaded


def drawn_generator(transitions: Transitions) -> np.random.Generator | None:
    """Return the generator that the goals of all transitions are drawn from; None for none."""
    goals = transitions.window.goals if transitions.window else None
    return None if goals is None else generator(Stream.SAMPLED_GOALS, goals.seed)
