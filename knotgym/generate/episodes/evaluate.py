"""Evaluation: how often a policy reaches its goals, on any tasks, crossings and splits, with
Wilson's interval.

Several policies, crossings and splits at once make the generalization matrix: a policy trained on
one, tested on all.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

import knotgym
from knotgym.atomic_files import atomic_write, require_writable
from knotgym.configuration import as_json, read_json
from knotgym.control.learned_policies import is_learner, learner_card
from knotgym.control.policies import PolicyConfig, make_policy
from knotgym.control.rollouts import Rollout, rollout
from knotgym.datasets.trajectory import Episode
from knotgym.episode_batch import OWN, SHIPPED, state_origins
from knotgym.errors import KnotgymError
from knotgym.generate.episodes.collect import reference_scores
from knotgym.generate.episodes.unfinished_evaluation import (
    PlayedEpisode,
    Unfinished,
    kept_beside,
    request,
)
from knotgym.runs.engine import require_same
from knotgym.runs.executors import executor
from knotgym.runs.intervals import wilson
from knotgym.runs.pools import Pool
from knotgym.runs.progress import Progress, compile_first, tell_if_long
from knotgym.runs.run_options import InvalidRun
from knotgym.runs.tables import narrow_table
from knotgym.tasks import TaskConfig

_SETUP = ("policy", "task", "split", "nx")  # columns
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


def evaluate(
    config: EvaluateConfig,
    pool: Pool,
    progress: Progress | None = None,
    unfinished: Unfinished | None = None,
) -> tuple[list[Result], list[Episode]]:
    """Play every setup but for what is played of an unfinished evaluation.

    Returns:
        The results in the order of `config.setups`, and the filmed episodes.
    """
    kept = Unfinished() if unfinished is None else unfinished
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
    # of what was played no film is left
    left = [
        number
        for number, piece in enumerate(pieces)
        if number not in kept.pieces or piece.numbers.start < piece.filmed
    ]
    films: list[Episode] = []
    total = config.episodes * len(setups)
    done = total - sum(len(pieces[number].numbers) for number in left)
    if progress is not None:
        progress.stage("episodes", done, total)
    for number, (played, filmed) in zip(
        left, pool.map(_play, [pieces[number] for number in left]), strict=True
    ):
        kept.keep(number, played)
        films += filmed
        done += len(played)
        if progress is not None:
            progress.stage("episodes", done, total)
    results = []
    for row, (policy, task) in enumerate(setups):
        mine = range(row * len(starts), (row + 1) * len(starts))
        results.append(
            _result(policy, task, [one for number in mine for one in kept.pieces[number]])
        )
    return results, films


# of a learner's card
_TRAINING = ("weights_sha256", "seconds", "episodes")


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
        "learners": {
            one.policy: {name: learner_card(one.policy)[name] for name in _TRAINING}
            for one in config.policies
            if is_learner(one.policy)
        },
        "results": [asdict(one) for one in results],
    }


def show(results: Sequence[Result], console: Console) -> None:
    """A row for each setup, and the matrix if there are several; no wider than 80 columns."""
    reached = any(one.steps is not None for one in results)
    table = narrow_table(
        (*_SETUP, "success", "95 % interval", *(["steps"] if reached else []), "return"),
        left=_SETUP[:3],
    )
    for one in results:
        table.add_row(
            one.policy,
            one.task,
            one.split,
            str(one.nx),
            f"{100 * one.success_rate:.1f} %",
            f"{100 * one.low:.1f} to {100 * one.high:.1f} %",
            *(["" if one.steps is None else f"{one.steps:.1f}"] if reached else []),
            f"{one.mean_return:.2f}",
        )
    console.print(table)
    for one in results:
        if one.planned_actions:
            console.print(
                f"{one.policy}, {one.task} nx {one.nx}, {one.split}: planned with"
                f" {one.planned_actions:.0f} actions, {one.planning_seconds:.2f} s an episode",
                highlight=False,
            )
    for task, nx in dict.fromkeys(
        (one.task, one.nx)
        for one in results
        if {one.start_states, one.goal_states} == {OWN, SHIPPED}
    ):
        console.print(
            f"{task} nx {nx}: the state file has no plain loops; those that ship are used.",
            highlight=False,
        )
    for line in reference_lines(results):
        console.print(line, highlight=False)
    columns = list(dict.fromkeys(one.nx for one in results))
    if len(columns) > 1:
        matrix = narrow_table(
            (*_SETUP[:3], *(f"nx {nx}" for nx in columns)), title="success, %", left=_SETUP[:3]
        )
        for key in dict.fromkeys((one.policy, one.task, one.split) for one in results):
            cells = {
                one.nx: f"{100 * one.success_rate:.1f}"
                for one in results
                if (one.policy, one.task, one.split) == key
            }
            matrix.add_row(*key, *(cells[nx] for nx in columns))
        console.print(matrix)


def reference_lines(results: Sequence[Result]) -> list[str]:
    """Return a line for each task and nx with the mean returns that a result is to be read beside.

    The references are measured on readable states, whichever states the results are of.
    """
    known = reference_scores()
    lines = []
    for task, nx in dict.fromkeys((one.task, one.nx) for one in results):
        scores = known.get(f"{task}-nx{nx}")
        if scores is not None:
            lines.append(
                f"for reference, mean return of {task} nx {nx}: random {scores['random']:.2f},"
                f" expert {scores['expert']:.2f} ({scores['episodes']} episodes, test split,"
                " readable states)"
            )
    return lines


def run(
    config: EvaluateConfig,
    *,
    workers: int,
    out: Path | None,
    video: Path | None,
    quiet: bool,
    console: Console,
    progress: Progress | None = None,
    resume: bool = False,
) -> list[Result]:
    """Evaluate, show, and write what was asked for.

    With `resume` it goes on with what an evaluation of the same settings left beside `out` when it
    was interrupted; one that is finished is shown.

    Raises:
        InvalidEvaluation: fewer than 0 workers, or `resume` without `out`.
        InvalidRun: what is to be resumed is of another evaluation, or damaged.
        Occupied: another process is evaluating into `out`.
        Unwritable: nothing can be written where `out` or `video` are.
        UnknownFilm: the video is of no kind that can be written here.
        InvalidSetting: the state file lacks what a task needs.
    """
    if workers < 0:
        raise InvalidEvaluation(f"workers must be at least 0, got {workers}")
    if resume and out is None:
        raise InvalidEvaluation("--resume goes on with the evaluation of an --out; name it")
    if video is not None:
        from knotgym.rendering.video import require_film, write_film

        require_film(video)
        config = config if config.filmed else replace(config, filmed=2)
    for path in (out, video):
        if path is not None:
            require_writable(path)
    for policy in config.policies:
        make_policy(policy)  # refuses what isn't there before any work is done
    for _, task in config.setups():
        state_origins(task)  # so does this
    if resume and out is not None and out.exists() and video is None:
        results = _finished(out, config)
        if not quiet:
            show(results, console)
            console.print(f"{out} is finished already", soft_wrap=True, highlight=False)
        return results
    progress = Progress(quiet=True) if progress is None else progress
    with kept_beside(out, request(config), resume, progress) as unfinished:
        spent = sum(policy.core_seconds for policy, _ in config.setups()) * config.episodes
        tell_if_long(progress, spent, workers)
        compile_first(progress)
        with executor(workers) as pool:
            results, films = evaluate(config, pool, progress, unfinished)
        if not quiet:
            show(results, console)
        if out is not None:
            with atomic_write(out) as temporary:
                told = json.dumps(report(config, results), indent=1) + "\n"
                temporary.write_text(told, encoding="utf-8")
    if out is not None and not quiet:
        told = f"{out}: {len(results)} results of {config.episodes} episodes each"
        console.print(told, soft_wrap=True, highlight=False)
    if video is not None:
        frames = [frame for episode in films for frame in film(episode, config.task)]
        write_film(video, frames)
        if not quiet:
            console.print(f"{video}: {len(films)} episodes", soft_wrap=True, highlight=False)
    return results


def _finished(out: Path, config: EvaluateConfig) -> list[Result]:
    """What an evaluation of the same settings wrote.

    Raises:
        InvalidRun: the file is of another one.
    """
    try:
        said = read_json(out)
        there = {name: said[name] for name in ("version", "settings")}
        results = [Result(**row) for row in said["results"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidRun(
            f"{out} isn't an evaluation of this version; choose another --out"
        ) from error
    asked = {"version": knotgym.__version__, "settings": as_json(config)}
    require_same(there, asked, (), out)
    return results


def film(episode: Episode, task: TaskConfig) -> list[NDArray[np.uint8]]:
    """The frames of an episode in all its views, with each pull, why it was chosen, and both codes:
    uint8 (height, width, 3) each.
    """
    from knotgym.rendering.observations import picture_config
    from knotgym.rendering.video import film_frame

    steps, moves, picture = len(episode), episode.move, picture_config(replace(task, depth=False))
    frames = []
    for k, points in enumerate(episode.points):
        move = "" if moves is None else str(moves[k])
        reached = "  reached" if episode.is_success[k] else ""
        heading = f"{episode.policy}  step {k} of {steps}  {move}{reached}"
        pull = (
            (int(episode.bead[k + 1]), episode.force[k + 1] / task.rope.max_force)
            if k < steps
            else None
        )
        frames.append(film_frame(points, episode.goal_points, heading, pull, picture))
    return frames + frames[-1:] * 4


def _play(piece: _Piece) -> tuple[list[PlayedEpisode], list[Episode]]:
    rollouts = rollout(piece.task, make_policy(piece.policy), piece.numbers, piece.seed)
    films = [one.episode for one in rollouts if one.number < piece.filmed]
    return [_counted(one) for one in rollouts], films


def _counted(one: Rollout) -> PlayedEpisode:
    episode = one.episode
    return PlayedEpisode(
        one.success,
        len(episode),
        float(episode.rewards.sum()),
        one.effort.actions,
        one.effort.seconds,
        bool(episode.simulation_failed[-1]),
    )


def _result(policy: PolicyConfig, task: TaskConfig, played: Sequence[PlayedEpisode]) -> Result:
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
