"""A whole dataset as a dict of arrays, one row per transition (the keys of D4RL and OGBench)."""

from __future__ import annotations

from typing import Any

import numpy as np

from knotgym.loaders.transitions import Transitions


def arrays(
    dataset: Any,
    *,
    observation: str | None = None,
    picture: Any = None,
    action: str | None = None,
    relabel: str | None = None,
    labels: bool = False,
    cache: Any = None,
) -> dict[str, Any]:
    """Load all N transitions of a dataset, in the order of its episodes.

    Args:
        dataset, observation, picture, action, relabel, labels, cache: see `knotgym.loaders`.

    Returns:
        observations, next_observations: uint8 (N, views * size, 2 size, 3 or 4), float32
            (N, 6 beads), dicts of both, or int16 (N, 2, symbols). Each picture is held twice,
            which takes 200 kB per transition at size 128 with one view and no depth.
        actions: float32 (N, 6); int64 (N, 4) in the view "bead" and (N, 3) in "macro".
        rewards: float64 (N,).
        pulls: int64 (N,), in the view "macro" only: pulls of each macro-action, to discount by.
        terminals, timeouts: bool (N,); exactly one of them is true in the last row of an episode.
    """
    return rows(
        Transitions(
            dataset,
            observation=observation,
            picture=picture,
            action=action,
            relabel=relabel,
            labels=labels,
            cache=cache,
        )
    )


def rows(transitions: Transitions) -> dict[str, Any]:
    """Load opened transitions; return what `arrays` does."""
    before: dict[str, Any] = {}
    after: dict[str, Any] = {}
    plain = False
    for segment in range(transitions.segments):
        seen = transitions.observations(segment)
        plain = not isinstance(seen, dict)
        for name, array in {"": seen}.items() if plain else seen.items():
            shape = (len(transitions), *array.shape[1:])
            part = slice(*transitions.starts[segment : segment + 2])
            before.setdefault(name, np.empty(shape, array.dtype))[part] = array[:-1]
            after.setdefault(name, np.empty(shape, array.dtype))[part] = array[1:]
    return {
        "observations": before[""] if plain else before,
        "actions": transitions.actions,
        "rewards": transitions.rewards,
        "next_observations": after[""] if plain else after,
        "terminals": transitions.terminals,
        "timeouts": transitions.timeouts,
        **({"pulls": transitions.pulls} if transitions.action == "macro" else {}),
    }
