"""Evaluation: how often a policy reaches its goals, on any tasks, crossings and splits, with
Wilson's interval.

Several policies, crossings and splits at once make the generalization matrix: a policy trained on
one, tested on all.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import knotgym
from knotgym.atomic_files import atomic_write
from knotgym.control.policies import PolicyConfig, make_policy
from knotgym.control.rollouts import Rollout, rollout
from knotgym.datasets.trajectory import Episode
from knotgym.episode_batch import OWN, SHIPPED, state_origins
from knotgym.errors import KnotgymError
from knotgym.runs.executors import executor
from knotgym.runs.pools import Pool
from knotgym.tasks import TaskConfig

SIDE_BY_SIDE = 8  # episodes of one piece of work


class InvalidEvaluation(KnotgymError, ValueError):
    """An evaluation that cannot be done as asked."""


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """What is evaluated.

    Attributes:
        policies: each on every task, crossing number and split.
        tasks, nx, splits: see `TaskConfig`.
        episodes: of each of these setups; episode i is the same for every policy.
        seed: of the run.
        task: the settings that all environments share; its task, nx and split are not used.
        filmed: episodes of each setup whose course is kept.
    """

    policies: tuple[PolicyConfig, ...]
    tasks: tuple[str, ...] = ("tie",)
    nx: tuple[int, ...] = (2,)
    splits: tuple[str, ...] = ("test",)
    episodes: int = 256
    seed: int = 0
    task: TaskConfig = TaskConfig(task="tie", observation="state")
    filmed: int = 0

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.seed < 0:
            raise InvalidEvaluation(
                f"episodes must be at least 1 and seed at least 0, got {self.episodes} and"
                f" {self.seed}"
            )
        if not all((self.policies, self.tasks, self.nx, self.splits)):
            raise InvalidEvaluation("name at least one policy, task, number of crossings and split")
        list(self.setups())  # refuses what no environment has

    def setups(self) -> Iterator[tuple[PolicyConfig, TaskConfig]]:
        """Every policy and environment."""
        for policy in self.policies:
            for task in self.tasks:
                for split in self.splits:
                    for nx in self.nx:
                        yield policy, replace(self.task, task=task, nx=nx, split=split)


@dataclass(frozen=True, kw_only=True)
class Result:
    """How one policy did in one setup.

    Attributes:
        policy, task, nx, split: which.
        episodes, successes: counted.
        success_rate, low, high: with the 95 % Wilson interval.
        steps: mean over the episodes that succeeded, None if none did.
        mean_return: rewards of an episode, mean.
        planned_actions, planning_seconds: mean of an episode.
        simulation_failures: episodes that ended because the simulation blew up.
        start_states, goal_states: where they were drawn from, "own" for the state file asked for
            or "shipped" for the one that ships.
    """

    policy: str
    task: str
    nx: int
    split: str
    episodes: int
    successes: int
    success_rate: float
    low: float
    high: float
    steps: float | None
    mean_return: float
    planned_actions: float
    planning_seconds: float
    simulation_failures: int
    start_states: str
    goal_states: str


class _Piece(NamedTuple):
    """Work for one process: some episodes of one setup."""

    policy: PolicyConfig
    task: TaskConfig
    numbers: range
    seed: int
    filmed: int


class _Played(NamedTuple):
    """What is counted of one episode, and its course if it is filmed."""

    success: bool
    steps: int
    total: float
    planned_actions: int
    planning_seconds: float
    failed: bool
    episode: Episode | None


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


def evaluate(config: EvaluateConfig, pool: Pool) -> tuple[list[Result], list[Episode]]:
    """Play every setup; the results in the order of `config.setups`, and the filmed episodes."""
    setups = list(config.setups())
    starts = range(0, config.episodes, SIDE_BY_SIDE)
    pieces = [
        _Piece(
            policy,
            task,
            range(first, min(first + SIDE_BY_SIDE, config.episodes)),
            config.seed,
            config.filmed,
        )
        for policy, task in setups
        for first in starts
    ]
    played = iter(pool.map(_play, pieces))
    results, films = [], []
    for policy, task in setups:
        episodes = [one for _ in starts for one in next(played)]
        results.append(_result(policy, task, episodes))
        films += [one.episode for one in episodes if one.episode is not None]
    return results, films


def report(config: EvaluateConfig, results: Sequence[Result]) -> dict[str, Any]:
    """What goes to the JSON file."""
    successes, episodes = (
        sum(one.successes for one in results),
        sum(one.episodes for one in results),
    )
    return {
        "version": knotgym.__version__,
        "success_rate": successes / episodes,
        "interval": list(wilson(successes, episodes)),
        "episodes": episodes,
        "settings": asdict(config),
        "results": [asdict(one) for one in results],
    }


def show(results: Sequence[Result], console: Console) -> None:
    """A row for each setup, and the matrix if there are several."""
    table = Table(
        "policy",
        "task",
        "split",
        "nx",
        "success",
        "95 % interval",
        "steps",
        "return",
        "planned actions",
        "planning s",
    )
    for one in results:
        steps = "" if one.steps is None else f"{one.steps:.1f}"
        interval = f"{100 * one.low:.1f} to {100 * one.high:.1f} %"
        effort = (
            (f"{one.planned_actions:.0f}", f"{one.planning_seconds:.2f}")
            if one.planned_actions
            else ("", "")
        )
        table.add_row(
            one.policy,
            one.task,
            one.split,
            str(one.nx),
            f"{100 * one.success_rate:.1f} %",
            interval,
            steps,
            f"{one.mean_return:.2f}",
            *effort,
        )
    console.print(table)
    for task, nx in dict.fromkeys(
        (one.task, one.nx)
        for one in results
        if {one.start_states, one.goal_states} == {OWN, SHIPPED}
    ):
        console.print(
            f"{task} nx {nx}: the state file has no plain loops; those that ship are used."
        )
    columns = list(dict.fromkeys(one.nx for one in results))
    if len(columns) > 1:
        matrix = Table(
            "policy", "task", "split", *(f"nx {nx}" for nx in columns), title="success, %"
        )
        for key in dict.fromkeys((one.policy, one.task, one.split) for one in results):
            cells = {
                one.nx: f"{100 * one.success_rate:.1f}"
                for one in results
                if (one.policy, one.task, one.split) == key
            }
            matrix.add_row(*key, *(cells[nx] for nx in columns))
        console.print(matrix)


def run(
    config: EvaluateConfig,
    *,
    workers: int,
    out: Path | None,
    video: Path | None,
    quiet: bool,
    console: Console,
) -> list[Result]:
    """Evaluate, show, and write what was asked for.

    Raises:
        InvalidEvaluation: fewer than 0 workers.
        UnknownFilm: the video is neither .mp4 nor .gif.
        InvalidSetting: the state file lacks what a task needs.
    """
    if workers < 0:
        raise InvalidEvaluation(f"workers must be at least 0, got {workers}")
    if video is not None:
        from knotgym.rendering.video import UnknownFilm, write_film

        if video.suffix.lower() not in (".mp4", ".gif"):
            raise UnknownFilm(f"a video ends in .gif or .mp4, got {str(video)!r}")
        config = config if config.filmed else replace(config, filmed=2)
    for policy in config.policies:
        make_policy(policy)  # refuses what isn't there before any work is done
    for _, task in config.setups():
        state_origins(task)  # so does this
    with executor(workers) as pool:
        results, films = evaluate(config, pool)
    if not quiet:
        show(results, console)
    if out is not None:
        with atomic_write(out) as temporary:
            temporary.write_text(
                json.dumps(report(config, results), indent=1) + "\n", encoding="utf-8"
            )
    if video is not None:
        write_film(video, [frame for episode in films for frame in film(episode, config.task)])
    return results


def film(episode: Episode, task: TaskConfig) -> list[NDArray[np.uint8]]:
    """The frames of an episode in all its views, its codes and the policy's reasons below: uint8
    (height, width, 3) each.
    """
    from knotgym.rendering.observations import observe, picture_config
    from knotgym.rendering.video import captioned

    picture = picture_config(replace(task, depth=False))
    frames = observe(episode.points, episode.goal_points, "pixels", picture)
    steps, moves = len(episode), episode.move
    out = []
    for k, frame in enumerate(frames):
        move = "" if moves is None else str(moves[k])
        reached = "  reached" if episode.is_success[k] else ""
        lines = [
            f"{episode.policy}  step {k} of {steps}  {move}{reached}",
            f"code {episode.gauss_code[k]}",
            f"goal {episode.goal_gauss_code}",
        ]
        out.append(captioned(frame, lines, scale=max(1, 384 // task.image_size)))
    return out + out[-1:] * 4


def _play(piece: _Piece) -> list[_Played]:
    rollouts = rollout(piece.task, make_policy(piece.policy), piece.numbers, piece.seed)
    return [_counted(one, one.number < piece.filmed) for one in rollouts]


def _counted(one: Rollout, filmed: bool) -> _Played:
    episode = one.episode
    total, failed = float(episode.rewards.sum()), bool(episode.simulation_failed[-1])
    return _Played(
        one.success,
        len(episode),
        total,
        one.effort.actions,
        one.effort.seconds,
        failed,
        episode if filmed else None,
    )


def _result(policy: PolicyConfig, task: TaskConfig, played: Sequence[_Played]) -> Result:
    successes = sum(one.success for one in played)
    low, high = wilson(successes, len(played))
    origins = state_origins(task)
    return Result(
        policy=policy.policy,
        task=task.task,
        nx=task.nx,
        split=task.split,
        episodes=len(played),
        successes=successes,
        success_rate=successes / len(played),
        low=low,
        high=high,
        steps=float(np.mean([one.steps for one in played if one.success])) if successes else None,
        mean_return=float(np.mean([one.total for one in played])),
        planned_actions=float(np.mean([one.planned_actions for one in played])),
        planning_seconds=float(np.mean([one.planning_seconds for one in played])),
        simulation_failures=sum(one.failed for one in played),
        start_states=origins["start"],
        goal_states=origins["goal"],
    )
