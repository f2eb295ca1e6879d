"""Rollouts: a policy acting in the environment's own episodes.

Episode i of a run with seed s is what `env.reset(seed=episode_seed(s, i))` begins, whichever
process plays it and whatever is played beside it. Datasets and scores draw from different streams
(`DATASET`, `EVALUATION`): no seed makes an evaluation play the episodes of a dataset. No picture is
drawn here: an episode keeps the rope, and its observations are made from that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.expert import Expert
from knotgym.control.policy import Effort, Policy
from knotgym.datasets.trajectory import Episode
from knotgym.episode_batch import EpisodeBatch
from knotgym.rope import Array
from knotgym.streams import Stream, derived_seed, generator
from knotgym.tasks import TaskConfig


class EpisodeStreams(NamedTuple):
    """What the seeds of environments and the draws of policies are taken from."""

    episode: Stream
    policy: Stream


DATASET = EpisodeStreams(Stream.EPISODE, Stream.POLICY)
EVALUATION = EpisodeStreams(Stream.EVALUATION_EPISODE, Stream.EVALUATION_POLICY)


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
    """What has been seen of one episode; the lists have a place for each action, or each state."""

    start_qpos: Array
    goal_points: Array
    options: dict[str, int]
    goal: str
    points: list[Array] = field(default_factory=list)
    infos: list[dict[str, object]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    labels: list[NDArray[np.float32]] = field(default_factory=list)
    labelling: Effort = Effort()
    rewards: list[float] = field(default_factory=list)
    terminations: list[bool] = field(default_factory=list)
    truncations: list[bool] = field(default_factory=list)

    def see(self, episodes: EpisodeBatch, index: int, move: str) -> None:
        """Keep the state that the episode is in now, and why it came to be."""
        self.points.append(episodes.simulation.points[index].copy())
        self.infos.append({**episodes.info(index), "move": move})

    def ask(
        self, labeller: Expert, episodes: EpisodeBatch, index: int, rng: np.random.Generator
    ) -> None:
        """Keep what an expert would do in the state that the episode is in now."""
        action, effort = labeller.advise(episodes, index, rng)
        self.labels.append(action)
        self.labelling = self.labelling.plus(effort)


def episode_seed(seed: int, number: int, streams: EpisodeStreams = DATASET) -> int:
    """The seed of the reset that begins episode `number` of a run, 52 bits for JSON's sake."""
    return derived_seed(streams.episode, seed, number)


def rollout(
    task: TaskConfig,
    policy: Policy,
    numbers: Sequence[int],
    seed: int,
    *,
    streams: EpisodeStreams = DATASET,
    attempt: int = 0,
    labeller: Expert | None = None,
) -> list[Rollout]:
    """Play episodes side by side.

    Args:
        task: the environment; the policy may take another observation of it.
        policy: who acts.
        numbers: which episodes of the run, at least one.
        seed: of the run.
        streams: what the episodes are for.
        attempt: the policy draws otherwise in each; the episodes begin alike.
        labeller: asked at every state what it would do, which changes nothing.
    """
    episodes = EpisodeBatch(policy.suited(task), len(numbers))
    tracks = []
    seeds = [episode_seed(seed, number, streams) for number in numbers]
    for index, number in enumerate(numbers):
        episodes.begin(index, np.random.default_rng(seeds[index]))
        policy.begin(episodes, index, generator(streams.policy, seed, number, attempt))
        tracks.append(_begun(episodes, index))
    under_way = np.arange(len(numbers))
    while len(under_way):
        if labeller is not None:
            for index in under_way.tolist():
                key = (seed, numbers[index], len(tracks[index].actions))
                tracks[index].ask(labeller, episodes, index, generator(Stream.EXPERT_LABEL, *key))
        actions, moves = policy.act(episodes, under_way)
        rewards, terminated, truncated = episodes.step(actions, under_way)
        for row, index in enumerate(under_way.tolist()):
            track = tracks[index]
            track.actions.append(np.clip(actions[row], -1, 1))  # as the simulation read it
            track.rewards.append(float(rewards[row]))
            track.terminations.append(bool(terminated[row]))
            track.truncations.append(bool(truncated[row]))
            track.see(episodes, index, moves[row])
        under_way = under_way[~(terminated | truncated)]
    return [
        Rollout(
            number,
            _episode(track, policy.name(index), seeds[index]),
            policy.effort(index).plus(track.labelling),
        )
        for index, (number, track) in enumerate(zip(numbers, tracks, strict=True))
    ]


def _begun(episodes: EpisodeBatch, index: int) -> _Track:
    """The track of an episode that has just begun."""
    info = episodes.info(index)
    track = _Track(
        start_qpos=episodes.simulation.qpos([index])[0],
        goal_points=episodes.goal_points(index),
        options={name: int(info[name]) for name in ("start", "goal")},
        goal=str(info["goal_gauss_code"]),
    )
    track.see(episodes, index, move="")
    return track


def _episode(track: _Track, policy: str, seed: int) -> Episode:
    def column(name: str, dtype: type) -> NDArray[Any]:
        return np.array([info[name] for info in track.infos], dtype=dtype)

    return Episode(
        start_qpos=track.start_qpos,
        points=np.stack(track.points),
        goal_points=track.goal_points,
        actions=np.stack(track.actions),
        rewards=np.array(track.rewards, dtype=np.float64),
        terminations=np.array(track.terminations, dtype=bool),
        truncations=np.array(track.truncations, dtype=bool),
        gauss_code=column("gauss_code", np.str_),
        gauss_code_chiral=column("gauss_code_chiral", np.str_),
        crossings=column("crossings", np.int64),
        bead=column("bead", np.int64),
        force=column("force", np.float64),
        applied_share=column("applied_share", np.float64),
        is_success=column("is_success", np.bool_),
        simulation_failed=column("simulation_failed", np.bool_),
        move=column("move", np.str_),
        expert_action=(
            np.stack([*track.labels, np.zeros(6, dtype=np.float32)]) if track.labels else None
        ),
        goal_gauss_code=track.goal,
        seed=seed,
        options=track.options,
        policy=policy,
    )
