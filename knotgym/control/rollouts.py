"""Rollouts: a policy acting in the environment's own episodes.

Episode i of a run with seed s is what `env.reset(seed=episode_seed(s, i))` begins, whichever
process plays it and whatever is played beside it; the policy draws from stream POLICY.
Nothing is drawn as a picture here: an episode keeps the rope, and its observations are made from
that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from knotgym.control.policies import Effort, Policy
from knotgym.datasets.trajectory import Episode
from knotgym.episode_batch import EpisodeBatch
from knotgym.streams import Stream, derived_seed, generator
from knotgym.tasks import TaskConfig


@dataclass(frozen=True, eq=False)
class Rollout:
    """One episode played to its end.

    Attributes:
        number: i.
        episode: what happened.
        effort: what planning took.
    """

    number: int
    episode: Episode
    effort: Effort

    @property
    def success(self) -> bool:
        """The episode ended in the goal."""
        return bool(self.episode.is_success[-1])


@dataclass(eq=False)
class _Track:
    """What has been seen of one episode."""

    start_qpos: np.ndarray
    goal_points: np.ndarray
    options: dict[str, int]
    goal: str
    points: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    ends: list[tuple[float, bool, bool]] = field(default_factory=list)
    infos: list[dict[str, object]] = field(default_factory=list)


def episode_seed(seed: int, number: int) -> int:
    """The seed of the reset that begins episode `number` of a run: 52 bits, so that JSON can hold
    it.
    """
    return derived_seed(Stream.EPISODE, seed, number)


def rollout(task: TaskConfig, policy: Policy, numbers: Sequence[int], seed: int) -> list[Rollout]:
    """Play episodes side by side.

    Args:
        task: the environment.
        policy: who acts.
        numbers: which episodes of the run, at least one.
        seed: of the run.
    """
    episodes = EpisodeBatch(task, len(numbers))
    tracks = []
    for index, number in enumerate(numbers):
        episodes.begin(index, np.random.default_rng(episode_seed(seed, number)))
        policy.begin(episodes, index, generator(Stream.POLICY, seed, number))
        info = episodes.info(index)
        options = {name: int(info[name]) for name in ("start", "goal")}
        track = _Track(
            episodes.simulation.qpos([index])[0],
            episodes.goal_points(index),
            options,
            str(info["goal_gauss_code"]),
        )
        track.points.append(episodes.simulation.points[index].copy())
        track.infos.append({**info, "move": ""})
        tracks.append(track)
    going = np.arange(len(numbers))
    while len(going):
        actions, moves = policy.act(episodes, going)
        rewards, terminated, truncated = episodes.step(actions, going)
        for k, index in enumerate(going.tolist()):
            track = tracks[index]
            track.actions.append(actions[k].copy())
            track.ends.append((float(rewards[k]), bool(terminated[k]), bool(truncated[k])))
            track.points.append(episodes.simulation.points[index].copy())
            track.infos.append({**episodes.info(index), "move": moves[k]})
        going = going[~(terminated | truncated)]
    return [
        Rollout(
            number,
            _episode(track, policy.name(index), episode_seed(seed, number)),
            policy.effort(index),
        )
        for index, (number, track) in enumerate(zip(numbers, tracks, strict=True))
    ]


def _episode(track: _Track, policy: str, seed: int) -> Episode:
    rewards, terminations, truncations = zip(*track.ends, strict=True)

    def column(name: str, dtype: type) -> np.ndarray:
        return np.array([info[name] for info in track.infos], dtype=dtype)

    moves = column("move", np.str_)
    return Episode(
        start_qpos=track.start_qpos,
        points=np.stack(track.points),
        goal_points=track.goal_points,
        actions=np.stack(track.actions),
        rewards=np.array(rewards, dtype=np.float64),
        terminations=np.array(terminations, dtype=bool),
        truncations=np.array(truncations, dtype=bool),
        gauss_code=column("gauss_code", np.str_),
        gauss_code_chiral=column("gauss_code_chiral", np.str_),
        crossings=column("crossings", np.int64),
        bead=column("bead", np.int64),
        force=column("force", np.float64),
        is_success=column("is_success", np.bool_),
        simulation_failed=column("simulation_failed", np.bool_),
        move=moves,
        goal_gauss_code=track.goal,
        seed=seed,
        options=track.options,
        policy=policy,
    )
