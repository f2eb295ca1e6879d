"""Curation: which accepted states make a set, and which of them are for training.

A set holds no two near-duplicates (`datasets.near_duplicates`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.near_duplicates import NEAR, distances
from knotgym.rope import Array
from knotgym.topology.gauss import GaussCode


def is_near_duplicate(points: Array, accepted: Sequence[Array]) -> bool:
    """Whether a configuration comes within NEAR of one of those accepted."""
    return bool(accepted) and bool((distances(points, np.stack(accepted)) < NEAR).any())


def split(
    codes: Sequence[GaussCode], by: str, train_share: float, rng: np.random.Generator
) -> NDArray[np.str_]:
    """Assign states to "train" and "test", the states of each code as evenly as can be.

    Args:
        codes: of the states, compared without chirality.
        by: "state", or "code" for splits that share no code.
        train_share: of the states, or of the codes.
        rng: decides.

    Returns:
        str (n,).
    """
    plain = [code.plain for code in codes]
    kinds = sorted(set(plain), key=lambda code: code.visits)
    order = rng.permutation(len(kinds))
    out = np.full(len(codes), "test", dtype="<U5")
    if by == "code":
        train = {kinds[k] for k in order[: round(train_share * len(kinds))]}
        out[[code in train for code in plain]] = "train"
        return out
    # one walk over all states, code by code in random order: every stretch of the walk is split in
    # the same proportion
    walk = [
        index
        for k in order
        for index in rng.permutation([i for i, code in enumerate(plain) if code == kinds[k]])
    ]
    filled = np.floor((np.arange(len(walk)) + 1) * train_share + 0.5) - np.floor(
        np.arange(len(walk)) * train_share + 0.5
    )
    out[np.array(walk, dtype=np.int64)[filled > 0]] = "train"
    return out
