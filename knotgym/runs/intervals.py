"""Confidence intervals of proportions."""

from __future__ import annotations

import math


def wilson(successes: int, trials: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Wilson's score interval of a proportion, by default with 95 % confidence.

    >>> [round(end, 3) for end in wilson(8, 10)]
    [0.49, 0.943]
    """
    rate, spread = successes / trials, z * z / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(rate * (1 - rate) / trials + spread / (4 * trials))
    # exact at the ends
    return max(0.0, middle - half) if successes else 0.0, (
        min(1.0, middle + half) if successes < trials else 1.0
    )
