"""Confidence intervals of success rates.

Episodes are not independent: 256 episodes of one setup share about 20 tangled states and 9 plain
loops. `cluster_interval` estimates the success rate on new states from the same distribution, so
it resamples states and not episodes.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Stream

Floats = NDArray[np.float64]
DRAWS = 2000  # resamples per bootstrap
_Z = 1.959963984540054  # normal quantile of a two-sided 95 % interval


def _wilson(successes: float, trials: float, z: float = _Z) -> tuple[float, float]:
    """Return Wilson's score interval for a proportion of independent trials, by default at 95 %.

    >>> [round(end, 3) for end in _wilson(8, 10)]
    [0.49, 0.943]
    """
    # The ends solve |p - rate| = z sqrt(p (1 - p) / trials), a quadratic equation in p.
    rate, spread = successes / trials, z * z / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(rate * (1 - rate) / trials + spread / (4 * trials))
    # With no successes the lower end is exactly 0, with no failures the upper end exactly 1;
    # rounding would miss them.
    low = max(0.0, middle - half) if successes else 0.0
    return low, min(1.0, middle + half) if successes < trials else 1.0


def cluster_interval(success: Sequence[int], *clusters: ArrayLike) -> tuple[float, float]:
    """Return the 95 % interval of a success rate whose episodes share starts and goals.

    A bootstrap over starts and one over goals give the variance of the rate:

        V = V_starts + V_goals - p (1 - p) / n

    (Cameron, Gelbach and Miller 2011, multiway clustering: the variance within clusters is in both
    terms, so it is subtracted once). Each bootstrap draws G - 1 of G clusters with replacement,
    which makes its variance unbiased for few clusters (Rao and Wu 1988). Owen's pigeonhole
    bootstrap, a single resampling with the product of both weights, counts the variance within
    clusters three times; where states differ little, its intervals are 1.4 times too wide.

    The interval is Wilson's with the effective number of episodes p (1 - p) / V, at most n, and
    Student's t instead of the normal quantile (Korn and Graubard 1998). Its degrees of freedom are
    one less than the number of clusters on the side with fewer of them. A side with one cluster
    contributes no variance, and the interval then holds for that state only. If all episodes
    succeed, or none, the data doesn't show how much states differ; each state of the side with
    more states then counts as one trial.

    The bootstrap has a random stream of its own, so the same episodes give the same interval.

    Args:
        success: 0 or 1 for each episode; at least one episode.
        clusters: identifiers of each episode's start and goal; each more, such as its training's
            seed, adds a term, and subtracts the variance within once more.

    >>> [round(end, 2) for end in cluster_interval([0] * 60, [*range(20)] * 3, [0] * 60)]
    [0.0, 0.16]
    """
    outcome = np.asarray(success, dtype=np.float64)
    n, rate = len(outcome), float(outcome.mean())
    if rate in (0.0, 1.0):
        most = max(len(np.unique(np.asarray(labels))) for labels in clusters)
        return _wilson(rate * most, most)
    variance, freedom = _spread(outcome, clusters, rate * (1 - rate) / n)
    trials = rate * (1 - rate) / variance
    return _wilson(rate * trials, trials, _student(freedom) if freedom else _Z)


class Difference(NamedTuple):
    """How much larger one mean is than another.

    Attributes:
        mean, low, high: the difference and its 95 % interval.
        better: probability that it is positive on new states, by the normal distribution.
    """

    mean: float
    low: float
    high: float
    better: float

    @classmethod
    def between(cls, *sides: tuple[ArrayLike, Sequence[ArrayLike]]) -> "Difference":
        """Compare two means whose episodes share starts and goals, see `cluster_interval`.

        What a state adds to both cancels in the differences of paired episodes, so one side, which
        holds them, has a narrower interval than two.

        Args:
            sides: values in [-1, 1] of each episode, and clusters: of differences; or of the one,
                and of the one that is subtracted.
        """
        parts = [(np.asarray(values, np.float64), clusters) for values, clusters in sides]
        mean = float(parts[0][0].mean()) - sum(float(values.mean()) for values, _ in parts[1:])
        spreads = [_spread(values, by, float(values.var()) / len(values)) for values, by in parts]
        variance = sum(spread for spread, _ in spreads)
        if not variance:  # nothing varies; each state then counts as one trial
            most = max(len(np.unique(np.asarray(labels))) for _, by in parts for labels in by)
            half, better = _wilson(0, most)[1], (1 + np.sign(mean)) / 2
        else:
            half = _student(max(1, min(freedom for _, freedom in spreads))) * math.sqrt(variance)
            better = NormalDist().cdf(mean / math.sqrt(variance))
        return cls(mean, max(-1.0, mean - half), min(1.0, mean + half), float(better))


def _spread(values: Floats, clusters: Sequence[ArrayLike], within: float) -> tuple[float, int]:
    """Return the variance of the mean of values, and its degrees of freedom.

    Args:
        values: (n,).
        clusters: identifiers (n,) each.
        within: the variance if all values were independent.
    """
    sides = [np.unique(np.asarray(labels), return_inverse=True)[1] for labels in clusters]
    counts = [int(side.max()) + 1 for side in sides]
    rng = Stream.INTERVAL.generator(0)
    variances = [_variance(values, side, rng) for side in sides]
    # It is at least each of its terms, but its estimate can fall below them by chance.
    repeated = max(0, sum(count > 1 for count in counts) - 1)
    variance = max(sum(variances) - repeated * within, *variances, within)
    return variance, min((count - 1 for count in counts if count > 1), default=0)


def _variance(outcome: Floats, clusters: NDArray[np.int64], rng: np.random.Generator) -> float:
    """Return the variance of the mean outcome when clusters are resampled; 0 for one cluster."""
    sizes = np.bincount(clusters).astype(np.float64)
    count = len(sizes)
    if count == 1:
        return 0.0
    # (DRAWS, count): how often each resample of count - 1 clusters contains each cluster
    weights = rng.multinomial(count - 1, np.full(count, 1 / count), size=DRAWS)
    sums = np.bincount(clusters, weights=outcome)
    return float(np.var((weights @ sums) / (weights @ sizes)))


def _student(freedom: int) -> float:
    """Return the quantile of Student's t for a two-sided 95 % interval.

    >>> round(_student(8), 2)
    2.31
    """
    # Integrate the density from 0 by the trapezoidal rule, up to 0.475, half of 95 %.
    x = np.linspace(0, 13, 13001)  # the largest quantile is 12.7, at one degree of freedom
    log = math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)
    density = np.exp(log - (freedom + 1) / 2 * np.log1p(x * x / freedom))
    density /= math.sqrt(freedom * math.pi)
    below = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * x[1])])
    return float(np.interp(0.475, below, x))
