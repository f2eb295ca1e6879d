"""Curation: which accepted states make a set.

A set holds no two near-duplicates (`datasets.near_duplicates`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from knotgym.datasets.near_duplicates import NEAR, distances
from knotgym.rope import Array


def is_near_duplicate(points: Array, accepted: Sequence[Array]) -> bool:
    """Whether a configuration comes within NEAR of one of those accepted."""
    return bool(accepted) and bool((distances(points, np.stack(accepted)) < NEAR).any())
