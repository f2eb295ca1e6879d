"""Evaluate the success rate of policies on tasks, crossing numbers and splits.

Confidence intervals are over states, see `cluster_interval`. With several crossing numbers or
splits, the results are a generalization matrix for policies trained on one of them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

import knotgym
from knotgym.common.atomic_files import Occupied, atomic_write, require_output
from knotgym.common.configuration import as_json, read_json
from knotgym.common.errors import KnotgymError
from knotgym.control.policies import PolicyConfig, make_policy, training_card
from knotgym.control.rollouts import EVALUATION, Rollout, rollout
from knotgym.datasets.trajectory import Episode
from knotgym.envs.episode_batch import OWN, SHIPPED, state_origins
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import reference_scores
from knotgym.generate.episodes.digests import digests, require_unchanged, sources
from knotgym.generate.episodes.unfinished_evaluation import PlayedEpisode, Unfinished, kept_beside
from knotgym.rope.engines import MUJOCO
from knotgym.runs.engine import require_same, whole_request
from knotgym.runs.executors import executor
from knotgym.runs.intervals import cluster_interval
from knotgym.runs.pools import Pool
from knotgym.runs.progress import Progress, compile_first, tell_if_long
from knotgym.runs.run_options import REFUSE_EXISTING, Existing, InvalidRun
from knotgym.runs.shards import Shard
from knotgym.runs.staging import may_be_finished
from knotgym.runs.tables import narrow_table

_SETUP = ("policy", "task", "split", "nx")  # columns
SIDE_BY_SIDE = 8  # episodes per piece of work


class InvalidEvaluation(KnotgymError, ValueError):
    """The requested evaluation can't be done."""


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """What to evaluate.

    Attributes:
        policies: each is evaluated on every task, crossing number and split.
        tasks, nx, splits: see `TaskConfig`.
        episodes: episodes per setup; episode i is the same for every policy.
        seed: random seed; evaluations have streams of their own, so no dataset has their episodes.
        task: settings shared by all environments; its task, nx and split are not used.
        filmed: number of episodes per setup to return for a film.
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
            raise InvalidEvaluation("give at least one policy, task, number of crossings and split")
        list(self.setups())  # raises if an environment can't be made

    def setups(self) -> Iterator[tuple[PolicyConfig, TaskConfig]]:
        """Yield every combination of policy and environment."""
        for policy in self.policies:
            for task in self.tasks:
                for split in self.splits:
                    for nx in self.nx:
                        yield policy, replace(self.task, task=task, nx=nx, split=split)


@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of one policy in one setup.

    Attributes:
        policy, task, nx, split: the setup.
        action: the view that the policy acted in, see `TaskConfig`.
        episodes, successes: numbers of episodes.
        success_rate, low, high: success rate and the 95 % interval of `cluster_interval`.
        steps: mean over successful episodes; None if there are none.
        mean_return: mean return of an episode.
        planned_actions, planning_seconds: means per episode.
        simulation_failures: episodes that ended because the simulation diverged.
        start_states, goal_states: source of the states, "own" for the requested state file or
            "shipped" for the included one.
        outcomes: for each episode `start` and `goal` (rows of those state files), `success` (0 or
            1) and `steps`.
    """

    policy: str
    task: str
    nx: int
    split: str
    action: str
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
    outcomes: dict[str, list[int]]


class _Piece(NamedTuple):
    """A unit of work: a few episodes of one setup."""

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
    """Play every setup, except the pieces that an unfinished evaluation has already played.

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
    # checkpoints have no films, so filmed pieces are played again
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


# fields of a learner's card
_TRAINING = ("weights_sha256", "seconds", "episodes")


def sources_of(config: EvaluateConfig) -> dict[str, Any]:
    """Return the digests of the policies and states of an evaluation, see `sources`."""
    return sources(config.policies, (task for _, task in config.setups()))


def report(
    config: EvaluateConfig, results: Sequence[Result], source: dict[str, Any]
) -> dict[str, Any]:
    """Return the content of the result file; `source` is `sources_of(config)` before playing."""
    columns: dict[str, list[Any]] = {"success": [], "start": [], "goal": []}
    for one in results:
        columns["success"] += one.outcomes["success"]
        for side, origin in (("start", one.start_states), ("goal", one.goal_states)):
            columns[side] += [f"{origin} {row}" for row in one.outcomes[side]]
    return {
        "version": knotgym.__version__,
        "success_rate": float(np.mean(columns["success"])),
        "interval": list(cluster_interval(*columns.values())),
        "episodes": len(columns["success"]),
        "settings": asdict(config),
        "digests": digests(source),
        "learners": {
            one.policy: {name: card[name] for name in _TRAINING}
            for one in config.policies
            if (card := training_card(one.policy)) is not None
        },
        "results": [asdict(one) for one in results],
    }


def as_text(report: dict[str, Any]) -> str:
    """Format a report as JSON, with each list of numbers on one line."""

    def on_one_line(found: re.Match[str]) -> str:
        return " ".join(found[0].split())

    return re.sub(r"\[[-\d\s.,]+\]", on_one_line, json.dumps(report, indent=1)) + "\n"


def show(results: Sequence[Result], console: Console, engine: str = MUJOCO) -> None:
    """Print a row per setup, and a matrix if there are several nx, in at most 80 columns."""
    reached = any(one.steps is not None for one in results)
    table = narrow_table(
        (*_SETUP, "success", "95 % interval", *(["steps"] if reached else []), "return"),
        left=_SETUP[:3],
    )
    for one in results:
        table.add_row(
            _acting(one),
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
            f"{task} nx {nx}: the state file has no plain loops; the included ones are used.",
            highlight=False,
        )
    if engine == MUJOCO:
        for line in reference_lines(results):
            console.print(line, highlight=False)
    else:
        console.print(f"engine {engine}, not the reference engine {MUJOCO}", highlight=False)
    columns = list(dict.fromkeys(one.nx for one in results))
    if len(columns) > 1:
        matrix = narrow_table(
            (*_SETUP[:3], *(f"nx {nx}" for nx in columns)), title="success, %", left=_SETUP[:3]
        )
        for key in dict.fromkeys((_acting(one), one.task, one.split) for one in results):
            cells = {
                one.nx: f"{100 * one.success_rate:.1f}"
                for one in results
                if (_acting(one), one.task, one.split) == key
            }
            matrix.add_row(*key, *(cells[nx] for nx in columns))
        console.print(matrix)


def _acting(result: Result) -> str:
    """Name the policy, and the view that it acted in unless that is "pull"."""
    return result.policy if result.action == "pull" else f"{result.policy} ({result.action})"


def reference_lines(results: Sequence[Result]) -> list[str]:
    """Return a line per task and nx with reference returns to compare a result with.

    References are always measured on readable states, with MuJoCo.
    """
    known = reference_scores()
    lines = []
    for task, nx in dict.fromkeys((one.task, one.nx) for one in results if one.action == "pull"):
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
    existing: Existing = REFUSE_EXISTING,
) -> list[Result]:
    """Evaluate, print the results, and write the requested files.

    With `existing.resume`, an interrupted evaluation with the same settings continues from its
    checkpoint beside `out`, and a finished one is only printed.

    Raises:
        InvalidEvaluation: `workers` is negative, or resume or restart is requested without `out`.
        InvalidRun: the checkpoint belongs to another evaluation or is corrupted.
        Occupied: `out` or `video` exists, an interrupted evaluation left work, or another process
            is evaluating to `out`.
        Unwritable: `out` or `video` can't be written.
        PictureError: the video format can't be written here.
        InvalidSetting: the state file lacks states that a task needs.
    """
    if workers < 0:
        raise InvalidEvaluation(f"workers must be at least 0, got {workers}")
    if out is None and (existing.resume or existing.restart):
        raise InvalidEvaluation(
            "--resume and --restart need the --out of the evaluation; give it too"
        )
    if video is not None:
        from knotgym.rendering.video import require_film, write_film

        require_film(video)
        config = config if config.filmed else replace(config, filmed=2)
    _require_playable(config)
    source = sources_of(config)
    done = None if out is None else _done_already(out, video, config, source, existing)
    if done is not None:
        if not quiet:
            show(done, console, config.task.engine)
            console.print(f"{out} is finished already", soft_wrap=True, highlight=False)
        return done
    for path in (out, video):
        if path is not None:
            require_output(path, folder=False, overwrite=existing.overwrite)
    progress = Progress(quiet=True) if progress is None else progress
    asked = whole_request({"config": as_json(config), "source": source}, Shard())
    with kept_beside(out, asked, existing, progress) as unfinished:
        spent = sum(policy.core_seconds for policy, _ in config.setups()) * config.episodes
        tell_if_long(progress, spent, workers)
        compile_first(progress)
        with executor(workers) as pool:
            results, films = evaluate(config, pool, progress, unfinished)
        require_unchanged(source, sources_of(config))
        if not quiet:
            show(results, console, config.task.engine)
        if video is not None:  # before `out`, which says that all is done
            frames = [frame for episode in films for frame in film(episode, config.task)]
            with atomic_write(video, overwrite=existing.overwrite) as temporary:
                write_film(temporary, frames)
        if out is not None:
            with atomic_write(out, overwrite=existing.overwrite) as temporary:
                temporary.write_text(as_text(report(config, results, source)), encoding="utf-8")
    if out is not None and not quiet:
        line = f"{out}: {len(results)} results of {config.episodes} episodes each"
        console.print(line, soft_wrap=True, highlight=False)
    if video is not None and not quiet:
        console.print(f"{video}: {len(films)} episodes", soft_wrap=True, highlight=False)
    return results


def _done_already(
    out: Path,
    video: Path | None,
    config: EvaluateConfig,
    source: dict[str, Any],
    existing: Existing,
) -> list[Result] | None:
    """Return the results at `out` if the evaluation to resume is finished, otherwise None.

    Raises:
        InvalidRun: the file belongs to another evaluation, and `existing` doesn't overwrite it.
        Occupied: the evaluation is finished, but its film is missing.
    """
    if not may_be_finished(out, existing) or not out.is_file():
        return None
    try:
        results = _finished(out, config, source)
    except InvalidRun:
        if existing.overwrite:
            return None
        raise
    if video is not None and not video.exists():
        raise Occupied(
            f"{out} is finished already, but the film {video} isn't there; --overwrite without"
            " --resume makes both again"
        )
    return results


def _require_playable(config: EvaluateConfig) -> None:
    """Raise if a policy or task doesn't exist, or if a policy can't act in a task."""
    acting = {one.policy: make_policy(one) for one in config.policies}
    for policy, task in config.setups():
        acting[policy.policy].suited(task)
        state_origins(task)


def _finished(out: Path, config: EvaluateConfig, source: dict[str, Any]) -> list[Result]:
    """Read the results of an evaluation with the same settings, policies, states and code.

    Raises:
        InvalidRun: the file belongs to another evaluation.
    """
    try:
        content = read_json(out)
        there = {name: content[name] for name in ("version", "settings", "digests")}
        results = [Result(**row) for row in content["results"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidRun(
            f"{out} isn't an evaluation of this version; choose another --out"
        ) from error
    asked = {
        "version": knotgym.__version__,
        "settings": as_json(config),
        "digests": digests(source),
    }
    require_same(there, asked, (), out)
    return results


def film(episode: Episode, task: TaskConfig) -> list[NDArray[np.uint8]]:
    """Return the frames of a film of an episode: all its views, each pull, and its reason."""
    from knotgym.rendering.video import film_frames

    moves = [""] * len(episode.points) if episode.move is None else episode.move
    headings = [
        f"{episode.policy}  step {k} of {len(episode)}  {move}" for k, move in enumerate(moves)
    ]
    pulls = [
        (int(bead), force / task.rope.max_force)
        for bead, force in zip(episode.bead[1:], episode.force[1:], strict=True)
    ]
    return film_frames(
        list(episode.points), episode.goal_points, headings, pulls, episode.is_success, task.views
    )


def _play(piece: _Piece) -> tuple[list[PlayedEpisode], list[Episode]]:
    policy = make_policy(piece.policy)
    rollouts = rollout(piece.task, policy, piece.numbers, piece.seed, streams=EVALUATION)
    films = [one.episode for one in rollouts if one.number < piece.filmed]
    return [_counted(one) for one in rollouts], films


def _counted(one: Rollout) -> PlayedEpisode:
    episode = one.episode
    return PlayedEpisode(
        episode.options["start"],
        episode.options["goal"],
        one.success,
        len(episode),
        float(episode.rewards.sum()),
        one.effort.actions,
        one.effort.seconds,
        bool(episode.simulation_failed[-1]),
    )


def _result(policy: PolicyConfig, task: TaskConfig, played: Sequence[PlayedEpisode]) -> Result:
    successes = sum(one.success for one in played)
    outcomes = {
        name: [int(getattr(one, name)) for one in played]
        for name in ("start", "goal", "success", "steps")
    }
    low, high = cluster_interval(outcomes["success"], outcomes["start"], outcomes["goal"])
    origins = state_origins(task)
    return Result(
        policy=policy.policy,
        task=task.task,
        nx=task.nx,
        split=task.split,
        action=make_policy(policy).suited(task).action,
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
        outcomes=outcomes,
    )
