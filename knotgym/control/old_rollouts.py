"""Rollouts: let a policy act in episodes of the environment.

Episode i of a run with seed s starts as after `env.reset(seed=episode_seed(s, i))`, whichever
process plays it and whatever else is played beside it. Datasets and evaluations draw from different
streams (`DATASET`, `EVALUATION`), so no seed makes an evaluation play the episodes of a dataset.
Rollouts record the rope and no pictures; observations are rendered from it later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.streams import Stream, derived_seed, generator
from knotgym.control.policy import NO_MACRO, Effort, Policy
from knotgym.datasets.trajectory import MACRO_INFOS, Episode
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.model import Array

if TYPE_CHECKING:
    from knotgym.control.expert import Expert


class EpisodeStreams(NamedTuple):
    """The random streams of a run: for the environments' seeds, and for the policy."""

    episode: Stream
    policy: Stream


DATASET = EpisodeStreams(Stream.EPISODE, Stream.POLICY)
EVALUATION = EpisodeStreams(Stream.EVALUATION_EPISODE, Stream.EVALUATION_POLICY)


@dataclass(frozen=True, eq=False)
class Rollout:
    """One complete episode.

    Attributes:
        number: of the episode in its run.
        episode: states, actions, rewards and infos.
        effort: cost of planning, for the policy and the expert's advice together.
    """

    number: int
    episode: Episode
    effort: Effort

    @property
    def success(self) -> bool:
        """Whether the episode reached the goal, where it ends unless the task is endless."""
        return bool(self.episode.is_success.any())


@dataclass(eq=False)
class _Track:
    """Record of one episode under way.

    `points` and `infos` have an entry per state, one more than the other lists, which have an entry
    per action.
    """

    start_qpos: Array
    goal_points: Array
    options: dict[str, int]
    goal: str
    points: list[Array] = field(default_factory=list)
    infos: list[dict[str, object]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    macros: list[tuple[int, ...]] = field(default_factory=list)  # empty, or one per action
    expert_actions: list[NDArray[np.float32]] = field(default_factory=list)
    advice: Effort = Effort()  # cost of the expert's actions
    rewards: list[float] = field(default_factory=list)
    terminations: list[bool] = field(default_factory=list)
    truncations: list[bool] = field(default_factory=list)

    def see(self, episodes: EpisodeBatch, index: int, move: str) -> None:
        """Record the current state, and the reason for the action that led to it."""
        self.points.append(episodes.simulation.points[index].copy())
        self.infos.append({**episodes.info(index), "move": move})

    def ask(
        self, expert: Expert, episodes: EpisodeBatch, index: int, rng: np.random.Generator
    ) -> None:
        """Record what an expert would do in the current state."""
        action, effort = expert.advise(episodes, index, rng)
        self.expert_actions.append(action)
        self.advice = self.advice.plus(effort)


def episode_seed(seed: int, number: int, streams: EpisodeStreams = DATASET) -> int:
    """The reset seed of episode `number` of a run; 52 bits, which JSON numbers keep exactly."""
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
        task: the environment; the policy may replace its observation.
        policy: the policy that acts.
        numbers: which episodes of the run, at least one.
        seed: of the run.
        streams: DATASET or EVALUATION.
        attempt: changes the policy's random draws; the episodes start in the same states.
        labeller: an expert whose action is recorded at every state, without being taken.
    """
    episodes = EpisodeBatch(policy.suited(task), len(numbers))
    tracks = []
    seeds = [episode_seed(seed, number, streams) for number in numbers]
    for index, number in enumerate(numbers):
        episodes.begin(index, np.random.default_rng(seeds[index]))
        policy.begin(episodes, index, generator(streams.policy, seed, number, attempt))
        tracks.append(_begun(episodes, index))
    under_way = np.arange(len(numbers))
    moves: dict[int, str] = {}
    while len(under_way):
        if labeller is not None:
            for index in under_way.tolist():
                key = (seed, numbers[index], len(tracks[index].actions))
                tracks[index].ask(labeller, episodes, index, generator(Stream.EXPERT_LABEL, *key))
        deciding = under_way[~episodes.view.busy[under_way]]
        if len(deciding):
            choice = policy.act(episodes, deciding)
            episodes.view.begin(choice.actions, deciding)
            moves |= dict(zip(deciding.tolist(), choice.moves, strict=True))
            if choice.macros is not None:
                for index, macro in zip(deciding.tolist(), choice.macros.tolist(), strict=True):
                    tracks[index].macros.append(tuple(macro))
        # whatever the view, an episode is its pulls
        pulls = episodes.view.next_pulls(under_way).astype(np.float32)
        rewards, terminated, truncated = episodes.step(pulls, under_way)
        for row, index in enumerate(under_way.tolist()):
            track = tracks[index]
            track.actions.append(np.clip(pulls[row], -1, 1))  # as the simulation read it
            track.rewards.append(float(rewards[row]))
            track.terminations.append(bool(terminated[row]))
            track.truncations.append(bool(truncated[row]))
            if task.action == "macro":
                first = episodes.view.pulls[index] == 1
                track.macros.append((first, *episodes.view.macros[index].tolist()))
            track.see(episodes, index, moves[index])
        under_way = under_way[~(terminated | truncated)]
    return [
        Rollout(
            number,
            _episode(track, policy.name(index), seeds[index]),
            policy.effort(index).plus(track.advice),
        )
        for index, (number, track) in enumerate(zip(numbers, tracks, strict=True))
    ]


def _begun(episodes: EpisodeBatch, index: int) -> _Track:
    """Start the record of an episode that has just been reset."""
    info = episodes.info(index)
    track = _Track(
        start_qpos=episodes.start_qpos[index].copy(),
        goal_points=episodes.goal_points(index),
        options={name: int(info[name]) for name in ("start", "goal")},
        goal=str(info["goal_gauss_code"]),
    )
    track.see(episodes, index, move="")
    return track


def _episode(track: _Track, policy: str, seed: int) -> Episode:
    def column(name: str, dtype: type) -> NDArray[Any]:
        return np.array([info[name] for info in track.infos], dtype=dtype)

    macros: dict[str, Any] = {}
    if track.macros:
        table = np.array([NO_MACRO, *track.macros], dtype=np.int64)
        macros = dict(zip(MACRO_INFOS, table.T.copy(), strict=True))
        macros["macro_start"] = macros["macro_start"].astype(bool)
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
        **macros,
        expert_action=(
            # the last state has no action; a row of zeros keeps one row per state
            np.stack([*track.expert_actions, np.zeros(6, dtype=np.float32)])
            if track.expert_actions
            else None
        ),
        goal_gauss_code=track.goal,
        seed=seed,
        options=track.options,
        policy=policy,
    )
