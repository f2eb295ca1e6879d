"""Let the clone play in the chain engine, and keep the decisions that are on a way to a goal.

A way is an episode without its loops: what happened between two visits to the same code is left
out. The way of an episode that reached its goal is kept for that goal. Every code on a way is kept
as a goal too, for the decisions shortly before it, as if it had been asked for (hindsight). Most of
what is left out, and of what an episode did that missed its goal, is kept as tried in vain.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.streams import Stream, derived_seed, generator
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.clone_config import CloneConfig
from knotgym.learn.clone_data import DecidedStep, Decisions, gathered, join, without_loops
from knotgym.learn.clone_network import CloneNetwork
from knotgym.learn.clone_policy import ClonePolicy
from knotgym.topology.gauss import GaussCode

_LANES = 256  # episodes side by side
_VAIN = 6  # macro-actions of an episode that are kept as tried in vain, at most


class PlayedMacros(NamedTuple):
    """What a round of play gave.

    Attributes:
        decisions: kept ones; the numbers of their episodes are negative, and differ between
            rounds and tasks.
        success_rate: share of the episodes that reached their goal.
    """

    decisions: Decisions
    success_rate: float


def play(
    network: CloneNetwork,
    task: TaskConfig,
    clone: CloneConfig,
    number: int,
    known: Sequence[GaussCode] = (),
) -> PlayedMacros:
    """Play episodes and return the decisions worth learning.

    Args:
        network: in evaluation mode; its macro-actions are drawn at a temperature.
        task: whose starts and goals; the engine and the views are replaced.
        clone: how to play, and what is learned from it.
        number: of the round and task, so that each plays other episodes.
        known: codes that half of the episodes get as their goal instead of the task's.
    """
    config, seed = clone.play, clone.seed
    task = replace(task, engine="chain", action="macro", observation="state")
    episodes = EpisodeBatch(task, min(_LANES, config.episodes))
    policy = ClonePolicy(network, "macro", clone.guided, config.temperature)
    steps: dict[int, list[DecidedStep]] = {}
    opened: dict[int, tuple[NDArray[np.float32], GaussCode, tuple[int, int, int]]] = {}
    numbers: dict[int, int] = {}
    waiting = iter(range(config.episodes))
    kept, reached = list[Decisions](), 0

    def begin(index: int) -> bool:
        episode = next(waiting, None)
        if episode is None:
            return False
        key = (seed, number, episode)
        rng = generator(Stream.LEARN_PLAY, *key)
        episodes.begin(index, np.random.default_rng(derived_seed(Stream.LEARN_PLAY_START, *key)))
        goals = [code for code in known if not code.matches(episodes.codes[index])]
        if goals and rng.random() < 0.5:
            episodes.goals[index] = goals[int(rng.integers(len(goals)))]
        policy.begin(episodes, index, rng)
        steps[index], numbers[index] = [], episode
        return True

    def close(index: int) -> None:
        if index in opened:
            points, before, macro = opened.pop(index)
            landed = episodes.simulation.points[index].astype(np.float32)
            steps[index].append(DecidedStep(points, landed, before, episodes.codes[index], macro))

    under_way = np.array([index for index in range(episodes.count) if begin(index)])
    while len(under_way):
        deciding = under_way[~episodes.view.busy[under_way]]
        if len(deciding):
            actions = policy.act(episodes, deciding).actions
            episodes.view.begin(actions, deciding)
            for index in deciding.tolist():
                close(index)
                bead, target, side = episodes.view.macros[index].tolist()
                points = episodes.simulation.points[index].astype(np.float32)
                opened[index] = points, episodes.codes[index], (bead, target, side)
        pulls = episodes.view.next_pulls(under_way)
        _, terminated, truncated = episodes.step(pulls, under_way)
        left = np.ones(len(under_way), dtype=bool)
        for row in np.flatnonzero(terminated | truncated).tolist():
            index = int(under_way[row])
            close(index)
            reached += bool(terminated[row])
            way = without_loops(steps[index])
            imitated = way if terminated[row] else []
            good, goal = {id(step) for step in imitated}, episodes.goals[index]
            vain = [step for step in steps[index] if id(step) not in good]
            vain = [one._replace(missed=(one.macro,)) for one in vain[:: len(vain) // _VAIN + 1]]
            key = -1 - config.episodes * number - numbers[index]
            kept.append(gathered(way, imitated, goal, key, clone, vain))
            left[row] = begin(index)
        under_way = under_way[left]
    return PlayedMacros(join(kept), reached / config.episodes)
