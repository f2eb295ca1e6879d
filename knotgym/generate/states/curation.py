"""Curation: which accepted states make a set.

A set holds no two states that lie within NEAR of each other after a turn about z; those that
another symmetry brings so near may both be in it, in one split (`datasets.splits.kept_together`).
Of more states than it takes it holds those that are most unlike each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from knotgym.rope.model import Array
from knotgym.states.near_duplicates import NEAR, distances
from knotgym.states.spread import shape_distances
from knotgym.topology.gauss import GaussCode


def is_near_duplicate(points: Array, accepted: Sequence[Array]) -> bool:
    """Whether a configuration comes within NEAR of one of those accepted."""
    return bool(accepted) and bool((distances(points, np.stack(accepted)) < NEAR).any())


def most_unlike(
    points: Sequence[Array], codes: Sequence[GaussCode], shares: Mapping[GaussCode, int], count: int
) -> list[int]:
    """Choose a set: one state after the other, each as far as can be from those chosen before.

    Codes with chirality take turns: only what has been chosen least often can be chosen next. Far
    is meant of the shape (`spread.shape_distances`), so that the same curve with another base bead
    is no other state.

    Args:
        points: configurations (beads, 3), metres.
        codes: of each, with chirality.
        shares: code without chirality -> states at most.
        count: states at most.

    Returns:
        Which, in order.
    """
    every = np.stack(points) if points else np.empty((0, 1, 3))
    nearest = np.full(len(points), np.inf)
    turns: Counter[GaussCode] = Counter()
    taken: Counter[GaussCode] = Counter()
    left, chosen = list(range(len(points))), list[int]()
    while len(chosen) < count:
        left = [row for row in left if taken[codes[row].plain] < shares[codes[row].plain]]
        if not left:
            break
        least = min(turns[codes[row]] for row in left)
        able = [row for row in left if turns[codes[row]] == least]
        pick = able[int(np.argmax(nearest[able]))]
        left.remove(pick)
        chosen.append(pick)
        turns[codes[pick]] += 1
        taken[codes[pick].plain] += 1
        nearest[left] = np.minimum(nearest[left], shape_distances(every[pick], every[left]))
    return sorted(chosen)
