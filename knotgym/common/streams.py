"""Random streams: every draw of a run comes from a generator that is keyed by what it is for.

A key is (stream, seed, three counters), always of the same width, because NumPy pads shorter
entropy with zeros: `SeedSequence([7, 2])` and `SeedSequence([7, 2, 0])` are the same stream, and
so are two purposes whose hand-made keys happen to spell the same numbers.

>>> np.random.default_rng([7, 2]).random() == np.random.default_rng([7, 2, 0]).random()
True
>>> generator(Stream.SPLIT, 7, 2).random() == generator(Stream.SPLIT, 7, 2, 0, 1).random()
False
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import KnotgymError

COUNTERS = 3  # in a key; those not named are 0
_WORD, _MOST = 2**32, 2**63 - 1  # what an int64 column holds


class InvalidSeed(KnotgymError, ValueError):
    """A seed or counter that no stream can be keyed by."""


@unique
class Stream(IntEnum):
    """What draws are for, and what the counters are. Numbers are never used again for another."""

    SHARD = 1  # number of the shard: the seed of its search
    SPLIT = 2  # nx: train or test
    CODE_ORDER = 4  # nx: in which order codes are wanted
    CANDIDATE = 6  # nx, code, copy: its demonstration, and the state that it may end in
    TARGETED_SEARCH = 7  # nx, code, number of the planner's search
    SEARCH_ROPE = 8  # round, rope of the batch
    SEARCH_PARENTS = 9  # round
    SEARCH_REPLAYS = 10  # round, wave of the planner after it
    EPISODE = 13  # number of the episode: the seed of its environment, in datasets
    POLICY = 14  # number of the episode, attempt: draws of the policy, in datasets
    IMAGE_WALK = 15  # number of the walk
    IMAGE_WAVE = 16  # wave: where its walks set out from
    IMAGE_CHOICE = 17  # number of the frame
    IMAGE_CODES = 18  # nx: codes that only split test-code shows
    IMAGE_FAMILIES = 19  # nx: splits of the states that walks set out from
    IMAGE_ORDER = 20  # split: order of the rows
    IMAGE_NOISE = 21  # row: its noise survival
    IMAGE_APPEARANCE = 22  # row
    IMAGE_GRAIN = 23  # the noise of one picture, whose seed is stored
    EXPERT_LABEL = 24  # number of the episode, step: the plan that labels it
    EVALUATION_EPISODE = 25  # number of the episode: the seed of its environment, scored
    EVALUATION_POLICY = 26  # number of the episode: draws of the policy, scored
    INTERVAL = 27  # bootstraps of confidence intervals
    RANDOM_WALK = 30  # rope: all its actions, see `actions.drawn_actions`
    RANDOM_WALK_NOISE = 31  # rope, step: noise survival of the state saved there
    DRAWING = 40  # nx, code, number of the drawing
    DRAWING_CODES = 41  # nx: which codes are drawn, where there are too many to list
    START = 42  # the drawing of a knot that action sequences begin at
    LEARN_PICTURES = 50  # step of training the reader
    LEARN_ROPE = 51  # fitting the model of the rope
    LEARN_PLACES = 52  # which places ropes begin at are kept


def key(stream: Stream, seed: int, *counters: int) -> tuple[int, ...]:
    """The key of a stream: (stream, seed, counter, counter, counter), each below 2**63.

    Raises:
        InvalidSeed: a number is negative or too large, or there are too many counters.
    """
    if len(counters) > COUNTERS:
        raise InvalidSeed(f"a stream has at most {COUNTERS} counters, got {counters}")
    numbers = (int(seed), *map(int, counters))
    if not all(0 <= number <= _MOST for number in numbers):
        raise InvalidSeed(f"a seed and its counters must be from 0 to 2**63 - 1, got {numbers}")
    return (int(stream), *numbers, *([0] * (COUNTERS - len(counters))))


def words(key: tuple[int, ...]) -> NDArray[np.uint32]:
    """A key as NumPy's entropy: two words a number, so that no two keys are the same words."""
    return np.array([(n % _WORD, n // _WORD) for n in key], dtype=np.uint32).ravel()


def generator(stream: Stream, seed: int, *counters: int) -> np.random.Generator:
    """The generator of a stream, at its beginning."""
    return generator_of(key(stream, seed, *counters))


def generator_of(key: tuple[int, ...]) -> np.random.Generator:
    """The generator of a key, at its beginning."""
    return np.random.default_rng(_sequence(key))


def derived_seed(stream: Stream, seed: int, *counters: int) -> int:
    """A seed, below 2**52, for what takes one number; JSON and float64 hold it exactly."""
    return int(_sequence(key(stream, seed, *counters)).generate_state(1, np.uint64)[0] >> 12)


def _sequence(key: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence(words(key).tolist())
