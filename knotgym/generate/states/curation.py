"""Curation: which codes there are to curate, and which accepted states make a set.

A set holds no two near-duplicates (`datasets.near_duplicates`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from knotgym.datasets.near_duplicates import NEAR, distances
from knotgym.rope import Array
from knotgym.topology.diagrams import planar_codes
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import is_unknot, knot_type


@lru_cache(maxsize=32)
def codes_of(knot: str, nx: int) -> tuple[GaussCode, ...]:
    """Every code, without chirality and in order, that a rope of this knot type can show with nx
    crossings; exact.
    """
    certified = is_unknot if knot == "0_1" else lambda code: knot_type(code) == knot
    return tuple(
        sorted((code for code in planar_codes(nx) if certified(code)), key=lambda code: code.visits)
    )


def is_near_duplicate(points: Array, accepted: Sequence[Array]) -> bool:
    """Whether a configuration comes within NEAR of one of those accepted."""
    return bool(accepted) and bool((distances(points, np.stack(accepted)) < NEAR).any())
