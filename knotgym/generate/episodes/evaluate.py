"""Evaluate the success rate of policies on tasks, crossing numbers and splits.

Confidence intervals are over states, see `cluster_interval`. With several crossing numbers or
splits, the results are a generalization matrix for policies trained on one of them.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream
from knotgym.common.tables import Table
from knotgym.control.policies import make_policy, training_card
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import episode_seed, rollouts
from knotgym.datasets.episodes import Episodes, goal_reached, merged
from knotgym.envs.task_states import task_sides
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.blocks import as_result, blocks, from_result
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.generate.episodes.results import Result, evaluation_in, show
from knotgym.generate.episodes.sources import sources
from knotgym.runs.compilation import compile_first
from knotgym.runs.executors import executor
from knotgym.runs.identity import identity
from knotgym.runs.intervals import cluster_interval
from knotgym.runs.journal import Result as Kept
from knotgym.runs.progress import Progress
from knotgym.runs.run import Call, Recipe, compute
from knotgym.runs.run import run as run_recipe
from knotgym.runs.run_options import RunOptions

# fields of a learner's card
_TRAINING = ("weights_sha256", "seconds", "episodes")


def play(policy: PolicyConfig, task: TaskConfig, numbers: range, seed: int) -> Kept:
    """Play a block of episodes; their steps aren't kept."""
    seeds = [episode_seed(seed, number, Stream.EVALUATION_EPISODE) for number in numbers]
    return as_result(rollouts(make_policy(policy), task, seeds, keep=None))


def evaluation(config: EvaluateConfig) -> Recipe[list[Result]]:
    """Play every setup; return the results in the order of `config.setups`."""
    setups = list(config.setups())
    numbers = blocks(config.episodes, config.task)
    parts = yield [
        Call(f"setup {setup} {few.start}-{few.stop - 1}", play, (*one, few, config.seed))
        for setup, one in enumerate(setups, 1)
        for few in numbers
    ]
    results = []
    for setup, one in enumerate(setups):
        own = parts[setup * len(numbers) : (setup + 1) * len(numbers)]
        results.append(_result_of(*one, merged([from_result(part) for part in own]).episodes))
    return results


def evaluate(config: EvaluateConfig, workers: int = 1) -> list[Result]:
    """Play every setup and write nothing; return the results in the order of `config.setups`."""
    _require_playable(config)
    with executor(workers) as pool:
        return compute(evaluation(config), pool=pool)


def _require_playable(config: EvaluateConfig) -> None:
    """Refuse setups whose policies don't fit, before any work is done.

    Raises:
        InvalidPolicy: a policy doesn't fit a task.
        InvalidInput: the state file lacks states that a task needs.
    """
    for policy, task in config.setups():
        make_policy(policy).compatible_task(task)
        task_sides(task)


def sources_of(config: EvaluateConfig) -> dict[str, Any]:
    """Return the digests of the policies and states of an evaluation, see `sources`."""
    return sources(config.policies, (task for _, task in config.setups()))


def run(
    config: EvaluateConfig,
    options: RunOptions,
    *,
    out: Path | None = None,
    progress: Progress | None = None,
) -> list[Result]:
    """Evaluate, print the results, and write the requested files.

    Args:
        config: what to evaluate.
        options: how to execute the run; with `resume`, a finished evaluation is only printed.
        out: JSON file to write, see `report`; a shard writes its journal beside it.
        progress: where progress is shown.

    Returns:
        The results; none for a shard.

    Raises:
        InvalidInput: resume, restart or a shard is requested without `out`.
        InvalidPolicy, InvalidInput: as in `_require_playable`.
        InvalidInput, Occupied, Failed: as in `runs.run.run`.
    """
    progress = progress or Progress(quiet=True)
    if out is None and (options.resume or options.restart or not options.shard.is_whole):
        raise InvalidInput(
            "--resume and --restart need the --out of the evaluation, as a shard does; give it too"
        )
    _require_playable(config)
    source, results = sources_of(config), list[Result]()

    def recipe(place: Path | None) -> Recipe[str]:
        nonlocal results
        results = yield from evaluation(config)
        if place is not None:
            text = as_text(report(config, results, source))
            place.write_text(text, encoding="utf-8")
        return f"{len(results)} results of {config.episodes} episodes each"

    prepare = partial(compile_first, engine=config.task.engine, workers=options.workers)
    if out is None:
        prepare(progress)
        with executor(options.workers) as pool:
            compute(recipe(None), pool=pool)
    else:
        run_recipe(
            recipe,
            out,
            identity(config, source),
            options,
            progress,
            is_folder=False,
            prepare=prepare,
            sources=lambda: sources_of(config),
        )
        if not options.shard.is_whole:
            return []
        if not results:  # it was finished already
            with evaluation_in(out) as (_, results):
                pass
    if not options.quiet:
        show(results, progress.console, config.task.engine)
    return results


def report(
    config: EvaluateConfig, results: Sequence[Result], source: dict[str, Any]
) -> dict[str, Any]:
    """Return the content of the result file; `source` is `sources_of(config)` before playing."""
    learners = {
        one.policy: {name: card[name] for name in _TRAINING if name in card}
        for one in config.policies
        if (card := training_card(one.policy)) is not None
    }
    return {
        **totals(results),
        **identity(config, source),
        "learners": learners,
        "results": [asdict(one) for one in results],
    }


def totals(results: Sequence[Result]) -> dict[str, Any]:
    """Return the success rate over all setups, its 95 % interval and the number of episodes."""
    columns: dict[str, list[Any]] = {"success": [], "start": [], "goal": []}
    for one in results:
        columns["success"] += one.outcomes["success"]
        for side, origin in (("start", one.start_states), ("goal", one.goal_states)):
            columns[side] += [f"{origin} {row}" for row in one.outcomes[side]]
    return {
        "success_rate": float(np.mean(columns["success"])),
        "interval": list(cluster_interval(*columns.values())),
        "episodes": len(columns["success"]),
    }


def as_text(report: dict[str, Any]) -> str:
    """Format a report as JSON, with each list of numbers on one line."""
    text = json.dumps(report, indent=1)
    return re.sub(r"\[[-\d\s.,]+\]", lambda found: " ".join(found[0].split()), text) + "\n"


def film(episodes: Episodes, task: TaskConfig, row: int = 0) -> list[NDArray[np.uint8]]:
    """Return the frames of a film of an episode, with all of its views and each pull."""
    from knotgym.rendering.video import film_frames

    one = episodes.select([row])
    own, steps = one.episodes, one.steps
    pulls = zip(steps["bead"][:-1].tolist(), steps["force"][:-1].astype(np.float64), strict=True)
    length = int(own["length"][0])
    return film_frames(
        list(steps["observation"].astype(np.float64)),
        own["goal_points"][0].astype(np.float64),
        [f"{own['policy'][0]}  step {k} of {length}" for k in range(length + 1)],
        list(pulls),
        goal_reached(one, task),
        task.views,
    )


def _result_of(policy: PolicyConfig, task: TaskConfig, played: Table) -> Result:
    """Return the result of a setup from the rows of its episodes."""
    success, length = played["success"], played["length"]
    named = {"start": "start", "goal": "goal", "success": "success", "steps": "length"}
    listed = {name: played[column].astype(np.int64).tolist() for name, column in named.items()}
    low, high = cluster_interval(listed["success"], listed["start"], listed["goal"])
    (starts, goals), *_ = task_sides(task)
    return Result(
        policy=policy.policy,
        task=task.tasks[0],
        nx=task.crossings[0],
        split=task.split,
        action=make_policy(policy).compatible_task(task).action,
        episodes=played.rows,
        successes=int(success.sum()),
        success_rate=float(success.mean()),
        low=low,
        high=high,
        steps=float(length[success].mean()) if success.any() else None,
        mean_return=float(played["total"].mean()),
        planned_actions=float(played["planned"].mean()),
        simulation_failures=int(played["failed"].sum()),
        start_states=starts.origin,
        goal_states=goals.origin,
        outcomes=listed,
    )
