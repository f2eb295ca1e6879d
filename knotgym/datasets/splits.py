"""Splits: which rows are for training, and how states are dealt out to train and test.

No two rows anywhere are near-duplicates (`near_duplicates`), so none straddle splits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from knotgym.tasks import SPLITS
from knotgym.topology.gauss import GaussCode

STATE_SPLITS = SPLITS
# of pictures; test-code shows codes that only it and test-nx show, test-nx more crossings
IMAGE_SPLITS = (*STATE_SPLITS, "test-code", "test-nx")


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
    assigned = np.full(len(codes), "test", dtype="<U5")
    if by == "code":
        train = {kinds[k] for k in order[: round(train_share * len(kinds))]}
        assigned[[code in train for code in plain]] = "train"
        return assigned
    # one walk over all states, code by code in random order: every stretch of the walk is split in
    # the same proportion
    walk = [
        index
        for k in order
        for index in rng.permutation([i for i, code in enumerate(plain) if code == kinds[k]])
    ]
    trained_by = np.floor(np.arange(len(walk) + 1) * train_share + 0.5)
    assigned[np.array(walk, dtype=np.int64)[np.diff(trained_by) > 0]] = "train"
    return assigned
