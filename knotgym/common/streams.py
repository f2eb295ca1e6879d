"""Random streams: each purpose in a run has its own generators, seeded by a key.

A key is (stream, seed, three counters). Its width is fixed because NumPy pads shorter entropy with
zeros: `SeedSequence([7, 2])` and `SeedSequence([7, 2, 0])` give the same numbers. The stream is
part of the key so that two purposes never share numbers by accident.

>>> np.random.default_rng([7, 2]).random() == np.random.default_rng([7, 2, 0]).random()
True
>>> Stream.SPLIT.generator(7, 2).random() == Stream.SPLIT.generator(7, 2, 0, 1).random()
False
"""

from enum import IntEnum, unique

import numpy as np

from knotgym.common.errors import InvalidInput

_COUNTERS = 3  # per key; missing counters are 0
_MOST = 2**63 - 1  # seeds are stored in int64 columns


@unique
class Stream(IntEnum):
    """The purposes of random draws; comments name the counters of each.

    The number of a purpose is never reused for another one, because datasets store keys; 6 is that
    of the curated states.
    """

    SPLIT = 2  # nx: train or test
    CODE_ORDER = 4  # nx: order in which codes are processed
    # episode number: the seed of its environment, in datasets; evaluations have another
    EPISODE = 13
    POLICY = 14  # episode number, rollout of the episode: the policy's draws, in datasets
    IMAGE_WALK = 15  # rope: the seed of its policy
    IMAGE_WAVE = 16  # wave: start states of its ropes
    IMAGE_CHOICE = 17  # rope, pulls: the symmetries of a frame
    IMAGE_CODES = 18  # nx: the codes held out for split test-code
    IMAGE_FAMILIES = 19  # nx: splits of the start states of ropes
    IMAGE_ORDER = 20  # split: order of the rows
    IMAGE_APPEARANCE = 22  # row
    IMAGE_GRAIN = 23  # pixel noise of one picture, whose seed is stored
    EXPERT_LABEL = 24  # episode number, step: the plan that gives the expert action
    EVALUATION_EPISODE = 25  # episode number: the seed of its environment, in evaluations
    EVALUATION_POLICY = 26  # episode number: the policy's draws, in evaluations
    INTERVAL = 27  # bootstraps of confidence intervals
    RANDOM_WALK = 30  # rope: all its actions, see `actions.drawn_actions`
    PLAYED_ROPE = 32  # rope, 0: its random actions, 1: its other pulls
    NOISE_SURVIVAL = 33  # the seed is a digest of the configuration that the noise is added to
    DRAWING = 40  # nx, code, number of the drawing
    DRAWING_CODES = 41  # nx: which codes are drawn, where there are too many to list
    EPISODE_LOOK = 42  # goal row: the appearance of its photos; the seed is always 0
    SELECTION = 43  # which rows (0) or codes (2) are sampled, or how rows are split (1)
    IMPORT = 44  # nx, number of the curve: its noise survival
    LEARN_PICTURES = 50  # step of training the reader
    LEARN_PLACES = 52  # the start positions of ropes that are kept
    LEARN_CLONE = 53  # step of training the clone
    LEARN_HELD_OUT = 54  # the episodes held out of a clone's training
    LEARN_TRIAL = 55  # number of the episode: the seed of one that a learner plays while it trains
    DEMONSTRATION = 58  # task, nx, episode: the seed of a demonstration for a clone
    PASS_STARTS = 60  # task: the starts of play that counts passes
    PASS_PLAY = 61  # round, episode of that play
    DEMONSTRATED = 66  # state, attempt: the seed of the episode that ends in its code
    SAMPLED_GOALS = 70  # 0, or a draw of torch's: the goals of a loader's transitions
    IMAGE_CAMERA = 72  # rope, pulls: the camera of a photo
    STREAM_ORDER = 76  # block: the order of its rows
    STREAM_PICTURES = 77  # block: the seed of its pictures
    CHECKED_EPISODES = 78  # the episodes of a large set that are checked

    def key(self, seed: int, *counters: int) -> tuple[int, ...]:
        """Return the key (stream, seed, counter, counter, counter), each number in [0, 2**63)."""
        if len(counters) > _COUNTERS:
            raise InvalidInput(f"a stream has at most {_COUNTERS} counters, got {counters}")
        numbers = (int(seed), *map(int, counters))
        if not all(0 <= number <= _MOST for number in numbers):
            raise InvalidInput(f"a seed and its counters must be in [0, 2**63 - 1], got {numbers}")
        return (int(self), *numbers, *([0] * (_COUNTERS - len(counters))))

    def generator(self, seed: int, *counters: int) -> np.random.Generator:
        """Return a new generator."""
        return self.generator_of(self.key(seed, *counters))

    @staticmethod
    def generator_of(key: tuple[int, ...]) -> np.random.Generator:
        """Return a new generator of a key."""
        return np.random.default_rng(_sequence(key))

    def derived_seed(self, seed: int, *counters: int) -> int:
        """Return a seed in [0, 2**52), which JSON and float64 hold exactly, for other uses."""
        return int(_sequence(self.key(seed, *counters)).generate_state(1, np.uint64)[0] >> 12)


def _sequence(key: tuple[int, ...]) -> np.random.SeedSequence:
    """Seed NumPy with two 32-bit words per number, so that keys stay distinct."""
    return np.random.SeedSequence(np.array(key, "<u8").view("<u4"))
