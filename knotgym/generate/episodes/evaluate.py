"""Evaluate the success rate of policies on tasks, crossing numbers and splits.

Confidence intervals are over states, see `cluster_interval`. With several crossing numbers or
splits, the results are a generalization matrix for policies trained on one of them.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, Occupied, Stream, Table, atomic_write, require_output
from knotgym.control import PolicyConfig, episode_seed, make_policy, rollouts, training_card
from knotgym.datasets import STEPS, Episodes, episodes_of, goal_reached, merged
from knotgym.envs import TaskConfig, task_sides
from knotgym.generate.episodes.collect import blocks
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.generate.episodes.results import Result, evaluation_in, show
from knotgym.runs import (
    Call,
    Progress,
    Recipe,
    RunOptions,
    cluster_interval,
    compile_first,
    compute,
    executor,
    identity,
    shown_on,
)
from knotgym.runs import Result as Kept
from knotgym.runs import run as run_recipe

# fields of a learner's card
_TRAINING = ("weights_sha256", "seconds", "episodes")


def play(policy: PolicyConfig, task: TaskConfig, numbers: range, seed: int, film: bool) -> Kept:
    """Play a block of episodes.

    Args:
        policy, task: the setup.
        numbers: of the episodes.
        seed: of the evaluation.
        film: whether to keep their steps.
    """
    seeds = [episode_seed(seed, number, Stream.EVALUATION_EPISODE) for number in numbers]
    return rollouts(make_policy(policy), task, seeds, keep=STEPS if film else None).columns()


Evaluation = tuple[list[Result], list[Episodes]]  # a result and a film of each setup


def _evaluation(config: EvaluateConfig, filmed: int = 0) -> Recipe[Evaluation]:
    """Play every setup, in the order of `config.setups`, and its first episodes for a film."""
    setups = list(config.setups())
    numbers = [blocks(config.episodes, task, policy.plans) for policy, task in setups]
    calls = [
        Call(
            f"episodes of setup {setup} {few.start}-{few.stop - 1}",
            play,
            (*one, few, config.seed, False),
            len(few),
        )
        for setup, (one, own) in enumerate(zip(setups, numbers, strict=True), 1)
        for few in own
    ]
    films = [
        Call(f"film {setup}", play, (*one, range(filmed), config.seed, True), filmed)
        for setup, one in enumerate(setups, 1)
        if filmed
    ]
    parts = [episodes_of(part) for part in (yield [*calls, *films])]
    results, rest = list[Result](), iter(parts)
    for one, own in zip(setups, numbers, strict=True):
        results.append(_result_of(*one, merged([*islice(rest, len(own))]).episodes))
    return results, parts[len(calls) :]


def _reached(played: Kept) -> dict[str, int]:
    return {"reached the goal": int(played["episodes/success"].sum())}


def _require_playable(config: EvaluateConfig) -> None:
    """Refuse setups whose policies don't fit, before any work is done.

    Raises:
        InvalidPolicy: a policy doesn't fit a task.
        InvalidInput: the state file lacks states that a task needs.
    """
    for policy, task in config.setups():
        make_policy(policy).compatible_task(task)
        task_sides(task)


def evaluate(
    config: EvaluateConfig,
    options: RunOptions,
    *,
    out: Path | None = None,
    video: Path | None = None,
    progress: Progress | None = None,
) -> list[Result]:
    """Evaluate, print the results, and write the requested files.

    Args:
        config: what to evaluate.
        options: how to execute the run; with `resume`, a finished evaluation is only printed.
        out: JSON file to write, see `report`; a shard writes its journal beside it.
        video: film to write, of `config.filmed` episodes per setup.
        progress: where progress is shown.

    Returns:
        The results; none for a shard.

    Raises:
        InvalidInput: resume, restart or a shard is requested without `out`, or a film of a shard.
        InvalidPolicy, InvalidInput: as in `_require_playable`.
        InvalidInput, Occupied, Failed: as in `runs.runner.run`, and for `video`.
    """
    progress = progress or Progress(quiet=True)
    if out is None and (options.resume or options.restart):
        raise InvalidInput("--resume and --restart need the --out of the evaluation; give it too")
    if not options.shard.is_whole and (out is None or video is not None):
        wrong = "needs the --out of the evaluation" if out is None else "can't be filmed"
        raise InvalidInput(f"a shard {wrong}")
    if video is not None:
        from knotgym.rendering import require_film

        require_film(video)
    _require_playable(config)
    made_by, results, films = identity(config), list[Result](), list[Episodes]()

    def recipe(place: Path | None) -> Recipe[str]:
        nonlocal results, films
        if video is not None:
            require_output(video, folder=False, overwrite=options.overwrite, reads=made_by.reads)
        filmed = 0 if video is None else config.filmed
        results, films = yield from _evaluation(config, filmed)
        if video is not None:  # before the output, which says that all is done
            _write_film(config, films, video, options.overwrite)
        if place is not None:
            text = as_text(report(config, results, made_by))
            place.write_text(text, encoding="utf-8")
        return f"{len(results)} results of {config.episodes} episodes each"

    if out is None:
        with executor(options.workers) as pool:
            compile_first(progress, config.task.engine, pool=pool)
            compute(recipe(None), pool=pool, on_progress=shown_on(progress, _reached))
    else:
        run_recipe(
            recipe,
            out,
            made_by,
            options,
            progress,
            is_folder=False,
            prepare=lambda shown, pool: compile_first(shown, config.task.engine, pool=pool),
            count=_reached,
        )
        if not options.shard.is_whole:
            return []
        if not results:  # it was finished already
            with evaluation_in(out) as (_, results):
                pass
        if video is not None and not video.exists():
            raise Occupied(
                f"{out} is finished already, but the film {video} isn't there; --overwrite without"
                " --resume makes both again"
            )
    if not options.quiet:
        show(results, progress.console, config.task.engine)
    if video is not None:
        count = sum(one.episodes.rows for one in films)
        progress.say(f"{video}: {count} episodes")
    return results


def report(
    config: EvaluateConfig, results: Sequence[Result], made_by: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the content of the result file.

    Args:
        config: what was evaluated.
        results: one for each setup.
        made_by: the run's identity.
    """
    learners = {
        one.policy: {name: card[name] for name in _TRAINING if name in card}
        for one in config.policies
        if (card := training_card(one.policy)) is not None
    }
    return {
        **_totals(results),
        **made_by,
        "learners": learners,
        "results": [asdict(one) for one in results],
    }


def _totals(results: Sequence[Result]) -> dict[str, Any]:
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
    """Return the frames of a film of an episode, with all of its views and each pull.

    Args:
        episodes: with their steps.
        task: that they were played in.
        row: which of them.

    Returns:
        RGB pictures of one size, uint8, one for each state.
    """
    from knotgym.rendering import film_frames

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


def _write_film(
    config: EvaluateConfig, films: Sequence[Episodes], video: Path, overwrite: bool
) -> None:
    from knotgym.rendering import write_film

    frames = [
        frame
        for (_, task), one in zip(config.setups(), films, strict=True)
        for row in range(one.episodes.rows)
        for frame in film(one, task, row)
    ]
    with atomic_write(video, overwrite=overwrite) as temporary:
        write_film(temporary, frames)


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
        mean_return=float(played["return_"].mean()),
        planned_actions=float(played["planner_steps"].mean()),
        simulation_failures=int(played["diverged"].sum()),
        start_states=starts.origin,
        goal_states=goals.origin,
        outcomes=listed,
    )
