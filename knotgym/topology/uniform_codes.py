"""Gauss codes drawn uniformly at random, where there are too many to list.

A closed curve crosses a loop an even number of times, so the two visits to a crossing lie an odd
number of places apart: one is at an even place, one at an odd. A uniform permutation matches them;
of n! matchings those that can be drawn are kept (1,804 of 10,000 at 10 crossings), all equally
likely, and so are the 2 ** n ways to choose the upper strands, and what is left of them when only
the codes of one knot are kept.
"""

from __future__ import annotations

import numpy as np

from knotgym.topology.diagrams import is_planar
from knotgym.topology.gauss import GaussCode


def uniform_code(nx: int, rng: np.random.Generator) -> GaussCode:
    """A planar code with nx crossings, each of `diagrams.planar_codes(nx)` equally likely."""
    while True:
        word = np.empty(2 * nx, dtype=np.int64)
        word[0::2] = np.arange(1, nx + 1)
        word[1::2] = rng.permutation(nx) + 1
        over = rng.integers(2, size=nx)
        seen: set[int] = set()
        visits = []
        for label in word.tolist():
            first = label not in seen
            seen.add(label)
            visits.append(label if first == bool(over[label - 1]) else -label)
        code = GaussCode.relabelled(visits, None)
        if is_planar(code):
            return code
