"""Evaluate the success rate of policies on tasks, crossing numbers and splits.

Confidence intervals are over states, see `cluster_interval`. With several crossing numbers or
splits, the results are a generalization matrix for policies trained on one of them.
"""

import json
import os
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym import common, rendering, runs
from knotgym.common import Counts, Failed, InvalidInput, Occupied, Stream, sha256
from knotgym.control import PolicyConfig, compile_planning, make_policy, rollouts
from knotgym.datasets import STEPS, Episodes
from knotgym.envs import TaskConfig, task_sides
from knotgym.generate.collection import blocks
from knotgym.generate.entries import write_entry
from knotgym.generate.episode_configs import PROTOCOLS, EvaluateConfig
from knotgym.generate.results import Result, reached, read_evaluation, show
from knotgym.rope import ENGINES

# fields of a learner's card
_TRAINING = (
    *("learner", "data", "parameters", "updates", "seconds", "episodes"),
    *("seed", "action", "command", "weights_sha256"),
)


def _play(
    policy: PolicyConfig, task: TaskConfig, numbers: Sequence[int], seed: int, whole: bool
) -> runs.Result:
    """Play a block of episodes.

    Args:
        policy, task: the setup.
        numbers: of the episodes.
        seed: of the evaluation.
        whole: whether to keep their steps, to film or record them.
    """
    seeds = [Stream.EVALUATION_EPISODE.derived_seed(seed, number) for number in numbers]
    return rollouts(make_policy(policy), task, seeds, keep=STEPS if whole else None).columns()


# a result, the episodes and a film of each setup
Evaluation = tuple[list[Result], list[Episodes], list[Episodes]]


def _evaluation(config: EvaluateConfig, filmed: int, recorded: bool) -> runs.Recipe[Evaluation]:
    """Play every setup, in the order of `config.setups`, and its first episodes for a film."""
    setups, seed = list(config.setups()), config.seed
    numbers = [blocks(config.episodes, task, policy.plans) for policy, task in setups]
    calls, mark = list[runs.Call](), ", recorded" * recorded
    for number, (setup, parts) in enumerate(zip(setups, numbers, strict=True), 1):
        for few in parts:
            name = f"episodes of setup {number}{mark} {few.start}-{few.stop - 1}"
            calls.append(runs.Call(name, _play, (*setup, few, seed, recorded), len(few)))
    rest = map(Episodes.of, (yield calls))
    played = [Episodes.merged([*islice(rest, len(parts))]) for parts in numbers]
    calls, shown = [], zip(setups, played, strict=True) if filmed else ()
    for number, (setup, episodes) in enumerate(shown, 1):
        some: Sequence[int] = range(filmed)
        if config.failures:
            some = np.flatnonzero(~episodes.episodes["success"])[:filmed].tolist()
        name = f"filmed episodes of setup {number} {','.join(map(str, some))}"
        calls.append(runs.Call(name, _play, (*setup, some, seed, True), len(some)))
    if filmed and not any(call.items for call in calls):
        raise Failed("every episode reached its goal, so there is no failure to film")
    films = map(Episodes.of, (yield calls))
    results = []
    for (policy, task), episodes in zip(setups, played, strict=True):
        action = make_policy(policy).compatible_task(task).action
        results.append(Result.of(policy.policy, action, task, episodes.episodes))
    return results, played, [*films]


def _require_playable(config: EvaluateConfig) -> None:
    """Refuse setups whose policies don't fit, before any work is done."""
    for policy, task in config.setups():
        seen = make_policy(policy).compatible_task(task).observation
        if config.protocol and not config.shows(config.protocol, seen):
            raise InvalidInput(
                f"protocol {config.protocol} shows policies no more of the goal than observation"
                f" {PROTOCOLS[config.protocol]}; {policy.policy} observes {seen}"
            )
        task_sides(task)


def evaluate(
    config: EvaluateConfig,
    options: runs.RunOptions,
    *,
    out: Path | None = None,
    video: Path | None = None,
    record: Path | None = None,
    progress: runs.Progress | None = None,
) -> list[Result]:
    """Evaluate, print the results on `progress`, and write the requested files.

    Args:
        config: what to evaluate.
        options: how to execute the run; with `resume`, a finished evaluation is only printed.
        out: JSON file to write, see `_report`; a shard writes its journal beside it.
        video: film to write, of `config.filmed` episodes per setup.
        record: entry to write, see `entries`.
        progress: where progress is shown.

    Returns:
        The results; none for a shard.

    Raises:
        InvalidInput: resume, restart or a shard is requested without `out`, or a film of a shard.
        InvalidPolicy: a policy doesn't fit a task.
        InvalidInput: the state file lacks states that a task needs.
        InvalidInput, Occupied, Failed: as in `runs.runner.run`, and for `video`.
    """
    is_shown, progress = progress is not None, progress or runs.Progress(quiet=True)
    if out is None and (options.resume or options.restart):
        raise InvalidInput("--resume and --restart need the --out of the evaluation; give it too")
    if not options.shard.is_whole and (out is None or video or record):
        wrong = "needs the --out of the evaluation" if out is None else "is no film and no entry"
        raise InvalidInput(f"a shard {wrong}")
    if video is not None:
        rendering.Film(video)
    common.require_apart(out, video, record)
    _require_playable(config)
    both = {"video": video, "record": record}
    beside = {kind: more for kind, more in both.items() if more is not None}
    made_by, played = runs.identity(config), list[Evaluation]()
    recipe = partial(_recipe, config, made_by, beside, options.overwrite, played)
    plan = compile_planning if any(policy.plans for policy in config.policies) else None
    compiles: dict[str, Any] = {"engine": config.task.engine, "plan": plan}
    if out is None:
        with runs.executor(options.workers) as pool:
            runs.compile_first(progress, pool, **compiles)
            runs.compute(recipe(None), pool=pool, progress=progress, count=reached)
    else:
        make = partial(runs.run, is_folder=False, compiles=compiles, count=reached)
        make(recipe, out, made_by, options, progress)
        if not options.shard.is_whole:
            return []
        if not played:
            played.append((_finished(out, beside), [], []))
    ((results, _, films),) = played
    if is_shown:
        tasks = [task for _, task in config.setups()]
        show(results, progress.console, config.task.engine, config.protocol, tasks)
    if films:
        count = sum(episodes.episodes.rows for episodes in films)
        progress.say(f"{video}: {count} episodes")
    return results


def _recipe(
    config: EvaluateConfig,
    made_by: Any,
    beside: Mapping[str, Path],
    overwrite: bool,
    played: list[Evaluation],
    place: Path | None,
) -> runs.Recipe[str]:
    """Evaluate, add it to `played`, and write the requested files.

    Args:
        config: of the run.
        made_by: its identity.
        beside: where a "video" and a "record" are written.
        overwrite: whether these may be replaced.
        played: an empty list.
        place: where the result file is written; None for none.
    """
    for more in beside.values():
        common.require_output(more, folder=False, overwrite=overwrite, reads=made_by.reads)
    filmed = config.filmed if "video" in beside else 0
    results, episodes, films = yield from _evaluation(config, filmed, "record" in beside)
    played.append((results, episodes, films))
    # before the output, which says that all is done
    if "video" in beside:
        tasks = (task for _, task in config.setups())
        steps = sum(film_of.steps.rows for film_of in films)
        Counts.tell("drawing the film", Counts.from_now(), steps)
        frames = [*chain.from_iterable(map(film, films, tasks))]
        with common.atomic_write(beside["video"], overwrite=overwrite) as temporary:
            rendering.Film(temporary).write(frames)
    if "record" in beside:
        with common.atomic_write(beside["record"], overwrite=overwrite) as temporary:
            write_entry(temporary, config, episodes, _claims(config, results, made_by))
    if place is not None:
        digests = {kind: sha256(more) for kind, more in beside.items()}
        text = json.dumps(_report(config, results, made_by, digests), indent=1)
        # each list of numbers on one line
        text = re.sub(r"\[[-\d\s.,]+\]", lambda numbers: " ".join(numbers[0].split()), text)
        place.write_text(text + "\n", encoding="utf-8")
    return f"{len(results)} results of {config.episodes} episodes each"


def _finished(out: Path, beside: Mapping[str, Path]) -> list[Result]:
    """Return the results of a finished evaluation; what was asked for beside it must be its own."""
    evaluated = read_evaluation(out)
    for kind, more in beside.items():
        if not more.is_file() or sha256(more) != evaluated.beside.get(kind):
            fault = "is another's" if os.path.lexists(more) else "isn't there"
            raise Occupied(
                f"{out} is finished already, but {more} {fault}; --overwrite without --resume makes"
                " both again"
            )
    return evaluated.results


def _claims(
    config: EvaluateConfig, results: Sequence[Result], made_by: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return what an entry claims of each setup, and no replay proves."""
    files, commit = (made_by.get("source") or {}).get("policies", {}), _commit()
    return [
        {
            "action": result.action,
            "observation": make_policy(policy).compatible_task(task).observation,
            "plans": policy.plans,
            "simulated_per_pull": result.planned_actions / np.mean(result.outcomes["steps"]),
            "training": _training(policy),
            "files": files.get(policy.policy, {}),
            "versions": made_by["versions"],
            "commit": commit,
        }
        for (policy, task), result in zip(config.setups(), results, strict=True)
    ]


def _training(policy: PolicyConfig) -> dict[str, Any]:
    """Return what the card of a policy says of its training."""
    card = policy.card() or {}
    return {name: card[name] for name in _TRAINING if name in card}


def _commit(module: Path = Path(__file__)) -> str:
    """Return the commit of the checkout that holds a module; "" if it isn't one of its files, such
    as in an environment that lies inside another checkout.
    """
    git = partial(subprocess.run, cwd=module.parent, capture_output=True, text=True, check=True)
    try:
        git(("git", "ls-files", "--error-unmatch", module.name))
        return git(("git", "rev-parse", "HEAD")).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _report(
    config: EvaluateConfig,
    results: Sequence[Result],
    made_by: Mapping[str, Any],
    beside: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of the result file; its rate is over all setups.

    Args:
        config: what was evaluated.
        results: one for each setup.
        made_by: the run's identity.
        beside: digests of what was written with it, a "video" and a "record".
    """
    success, starts, goals = list[int](), list[str](), list[str]()
    for result in results:
        success += result.outcomes["success"]
        starts += [f"{result.start_states} {row}" for row in result.outcomes["start"]]
        goals += [f"{result.goal_states} {row}" for row in result.outcomes["goal"]]
    learners = {policy.policy: _training(policy) for policy in config.policies if policy.card()}
    return {
        "success_rate": float(np.mean(success)),
        "interval": list(runs.cluster_interval(success, starts, goals)),
        "episodes": len(success),
        **made_by,
        "engine": ENGINES[config.task.engine].behaviour(),
        "beside": dict(beside),
        "learners": learners,
        "results": [asdict(result) for result in results],
    }


def film(episodes: Episodes, task: TaskConfig) -> list[NDArray[np.uint8]]:
    """Return the frames of a film of episodes, with all of their views and each pull.

    Args:
        episodes: with their steps.
        task: that they were played in.

    Returns:
        RGB pictures of one size, uint8, one for each state.
    """
    frames = list[NDArray[np.uint8]]()
    for number in range(episodes.episodes.rows):
        episode = episodes.select([number])
        row, steps = episode
        beads, forces = steps["bead"][:-1].tolist(), steps["force"][:-1].astype(np.float64)
        length, pulls = int(row["length"][0]), [*zip(beads, forces, strict=True)]
        headings = [f"{row['policy'][0]}  step {k} of {length}" for k in range(length + 1)]
        ropes, goals = (a.astype(np.float64) for a in (steps["observation"], row["goal_points"]))
        reached = episode.goal_reached(task)
        frames += rendering.Film.frames([*ropes], goals[0], headings, pulls, reached, task.views)
    return frames
