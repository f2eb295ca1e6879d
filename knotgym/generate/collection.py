"""Collect a policy's episodes as a dataset.

Blocks of episodes are played side by side in any number of processes. An episode depends only on
the seed and its number, so the dataset's bytes don't depend on blocks, lanes or processes.
"""

import hashlib
import inspect
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import InvalidFile, InvalidInput, Mark, Stream, as_json, differences
from knotgym.control import PolicyConfig, compile_planning, make_policy, replay
from knotgym.datasets import Episodes, MinariMetadata, machine, open_episodes, publish
from knotgym.envs import TaskConfig
from knotgym.generate.episode_configs import CollectConfig, plain_id
from knotgym.generate.results import reached, reference_scores, references_of
from knotgym.rope import ENGINES
from knotgym.runs import Call, Progress, Recipe, Result, RunOptions, identity, require_free, run
from knotgym.states import is_bundled, minari_root, read_states, resolve_states, states_mark

_MOST_STEPS = 2**17  # of a block, which bounds its memory


def blocks(episodes: int, task: TaskConfig, plans: bool, first: int = 0) -> list[range]:
    """Divide the numbers of a run's episodes into blocks of about equal size.

    Episode i of a run has a seed of its own, so a block may have any size and be played anywhere.

    Args:
        episodes: how many.
        task: the task.
        plans: whether the policy searches, or an expert labels every state.
        first: number of the first episode.

    >>> blocks(200, TaskConfig(task="tie", engine="chain"), plans=False)
    [range(0, 50), range(50, 100), range(100, 150), range(150, 200)]
    """
    engine = ENGINES[task.engine]
    least, most = engine.blocks[plans]
    most = min(most, max(1, _MOST_STEPS // (task.horizon + 1)))
    size = min(max(-(-episodes // engine.pieces), least), most)
    count = -(-episodes // size)
    ends = [first + number * episodes // count for number in range(count + 1)]
    return [range(begin, end) for begin, end in zip(ends[:-1], ends[1:], strict=True)]


def _distinct_id(config: CollectConfig) -> str:
    """Return the default id of a collection: `plain_id`, with a mark for every setting but the
    number of episodes that changes its content.

    A set of states is named, a state file marked by its digest; settings of the environment and
    the policy that have no mark of their own share one digest.

    >>> config = CollectConfig(task=TaskConfig(task="tie"), policy=PolicyConfig(policy="expert"))
    >>> _distinct_id(config)
    'knotgym/tie-nx2/expert-pixels-v0'
    """
    task, policy = config.task, config.policy
    rules = [*differences(as_json(TaskConfig(**Mark.values(task, "named"))), as_json(task))]
    rules += differences(as_json(PolicyConfig(policy=policy.policy)), as_json(policy))
    digest = hashlib.sha256("; ".join(rules).encode()).hexdigest()[:8]
    marks = (
        states_mark(task.states),
        task.observation * (task.observation != CollectConfig.task.observation),
        f"seed{config.seed}" * (config.seed != 0),
        "successes" * (not config.keep_failed),
        "labelled" * (config.labels != ""),
        f"rules{digest}" * bool(rules),
    )
    return plain_id(task, policy, *marks)


def collect(
    config: CollectConfig,
    out: Path | None,
    options: RunOptions,
    *,
    progress: Progress | None = None,
    recorded: Path | None = None,
    columns: Callable[..., Mapping[str, Any]] | None = None,
) -> Path:
    """Collect a dataset and return its folder; a shard returns its journal.

    Args:
        config: which episodes.
        out: Minari root to write to; None for Minari's own.
        options: how to execute the run.
        progress: where progress is shown.
        recorded: a recording of the same episodes, whose pulls are made again instead.
        columns: a function of a module, `(batch, ids) -> {name: values}`, that computes columns of
            your own of each state, of the ropes `ids` of an `EpisodeBatch`: numbers, (n, ...) each.
            They are stored as `info/NAME`, and nothing can make them again.

    Raises:
        InvalidPolicy, InvalidInput: the policy doesn't fit the task, or no episode is left to keep.
        Occupied, InvalidFile, Failed: as in `runs.runner.run`.
    """
    config, folder = _named(config, out)
    # both are refused before any work is done: a task that doesn't fit, and a bad id
    make_policy(config.policy).compatible_task(config.policy_task)
    _metadata(config, Counter())
    if not is_bundled(config.task.states):
        read_states(resolve_states(config.task.states), images=False)

    advisers = [replace(config.policy, policy="expert")] if config.labels else []
    files = {recorded.name: recorded} if recorded else {}
    if columns is not None:
        name = getattr(columns, "__qualname__", "<nothing>")
        if "<" in name or not inspect.isfunction(columns):
            raise InvalidInput(f"columns must be a function that a module defines, got {columns!r}")
        files[f"columns {name}"] = Path(inspect.getfile(columns))
    made_by = identity(config, files, also=advisers)
    plan = compile_planning if config.policy.plans else None
    block = partial(_repeat, recorded) if recorded else partial(_play, columns=columns)
    recipe = partial(_episodes_of, config, made_by, block)
    compiles = {"engine": config.task.engine, "plan": plan}
    begin = partial(run, compiles=compiles, count=reached, identity_in=run_facts)
    return begin(recipe, folder, made_by, options, progress)


def _named(config: CollectConfig, out: Path | None) -> tuple[CollectConfig, Path]:
    """Return a collection with the id that its dataset gets, and the dataset's folder."""
    config = config if config.dataset_id else replace(config, dataset_id=_distinct_id(config))
    return config, (out or minari_root()) / config.dataset_id


def require_collectable(
    config: CollectConfig, out: Path | None, options: RunOptions
) -> CollectConfig:
    """Require that a collection's output doesn't exist and no interrupted run left work.

    Returns the configuration with the id that its dataset gets.

    Args:
        config: which episodes.
        out: Minari root to write to; None for Minari's own.
        options: what to do with what is there.

    Raises:
        Occupied: it does, and `options` don't say what to do with it.
    """
    config, folder = _named(config, out)
    require_free(folder, options, ", or another --id")
    return config


def _episodes_of(
    config: CollectConfig,
    made_by: Mapping[str, Any],
    block: Callable[[CollectConfig, range], Result],
    place: Path,
) -> Recipe[str]:
    """Play a collection's episodes and publish them as the folder `place`; return a summary."""
    parts = list[Episodes]()
    played = steps = 0
    plans = config.policy.plans or bool(config.labels)
    while coming := _coming(config, played, steps):
        results = yield [
            Call(f"episodes {few.start}-{few.stop - 1}", block, (config, few), items=len(few))
            for few in blocks(coming, config.task, plans, played)
        ]
        played += coming
        parts += [Episodes.of(result) for result in results]
        steps = sum(int(part.episodes["length"].sum()) for part in parts)
    if config.steps:
        parts = _first_steps(parts, config.steps)
    return _publish(config, parts, made_by, place)


def _coming(config: CollectConfig, played: int, steps: int) -> int:
    """Return how many episodes to play next, after so many with so many steps; 0 at the end."""
    if not config.steps:
        return config.episodes - played
    # at first as many as are needed if none ends early, then as many as by their mean length
    mean = steps / played if played else config.task.horizon
    return max(0, math.ceil((config.steps - steps) / mean))


def _first_steps(parts: list[Episodes], steps: int) -> list[Episodes]:
    """Cut off the episodes that aren't needed for so many steps."""
    lengths = np.concatenate([part.episodes["length"] for part in parts])
    needed = int(np.searchsorted(np.cumsum(lengths), steps)) + 1
    parts_kept = list[Episodes]()
    for part in parts:
        if needed < part.episodes.rows:
            return [*parts_kept, *[part.select(np.arange(needed))] * (needed > 0)]
        parts_kept.append(part)
        needed -= part.episodes.rows
    return parts_kept


def _play(
    config: CollectConfig, numbers: range, columns: Callable[..., Mapping[str, Any]] | None = None
) -> Result:
    """Play a block of a collection's episodes."""
    return config.played(numbers, config.seed, columns).columns()


@lru_cache(maxsize=2)
def recording_at(path: Path) -> Episodes:
    """Read a recording, once for the blocks of a run, as all starts are drawn."""
    return open_episodes(path).episodes


def _repeat(recorded: Path, config: CollectConfig, numbers: range) -> Result:
    """Play a block of a collection's episodes by the pulls of their recording.

    Raises:
        InvalidFile: the recording has fewer episodes.
    """
    stored = recording_at(recorded)
    if numbers.stop > (rows := stored.episodes.rows):
        name = config.dataset_id
        raise InvalidFile(f"{name} is recorded with {rows} episodes, got {config.episodes}")
    seeds = [Stream.EPISODE.derived_seed(config.seed, number) for number in numbers]
    part = stored.select(np.arange(numbers.start, numbers.stop))
    return replay(part, config.policy_task, seeds).columns()


def _publish(
    config: CollectConfig, parts: list[Episodes], made_by: Mapping[str, Any], place: Path
) -> str:
    """Publish a collection's episodes as the folder `place`; return a summary.

    Raises:
        InvalidInput: no episode is left to keep.
    """
    total = _total(parts, config.keep_failed)
    if not total["kept"]:
        raise InvalidInput(
            f"none of {total['played']} episodes reached the goal and failed ones are dropped, so"
            " nothing is left to write"
        )
    if not config.keep_failed:
        parts = [part.select(part.episodes["success"]) for part in parts]
    facts = {**made_by, "machines": [machine()], "summary": total}
    carried = None if is_bundled(config.task.states) else resolve_states(config.task.states)
    digests = {**made_by["source"], "versions": made_by["versions"], "rope": made_by["rope"]}
    metadata = replace(_metadata(config, total), digests=digests)
    root, facts = place.with_name(f"{place.name}-root"), {"run": facts}
    made = publish(
        parts, config.task, metadata, root, states=carried, facts=facts, form=config.form
    )
    made.rename(place)
    failed = total["played"] - total["succeeded"]
    return (
        f"{total['kept']} episodes, {total['steps']} steps; {total['succeeded']} of"
        f" {total['played']} reached the goal, {failed} failed"
        f" ({'kept' if config.keep_failed else 'dropped'}); planning"
        f" {total['planned'] / total['played']:.0f} simulated pulls an episode"
    )


def _total(parts: Sequence[Episodes], keep_failed: bool) -> dict[str, int]:
    """Count the episodes that were played, that succeeded and that are kept; add up the kept ones'
    `steps`, the pulls `planned`, and the episodes that `failed` because the simulation blew up.
    """
    names = ("success", "length", "planner_steps", "diverged")
    every = ([part.episodes[name] for part in parts] for name in names)
    success, lengths, planned, failed = map(np.concatenate, every)
    is_kept = success | keep_failed
    counts = {"played": is_kept.size, "succeeded": success.sum(), "kept": is_kept.sum()}
    counts |= {"steps": lengths[is_kept].sum(), "planned": planned.sum(), "failed": failed.sum()}
    return {name: int(count) for name, count in counts.items()}


def run_facts(dataset: Path) -> Mapping[str, Any]:
    """Return the facts about the run that made a dataset: `identity`, machines and summary.

    Raises:
        InvalidFile: it has none.
    """
    facts = open_episodes(dataset).attributes.get("run")
    if not isinstance(facts, dict):
        raise InvalidFile(f"{dataset} says nothing about the run that made it")
    return facts


def _metadata(config: CollectConfig, total: Mapping[str, int]) -> MinariMetadata:
    """Return Minari's metadata; reference scores are those of random and expert policies."""
    task, policy = config.task, config.policy
    scores = references_of(task)
    labels = " At every state stands what an expert would do there (infos/expert_action)."
    planned = total["planned"] / max(total["played"], 1)
    planning = f" Planning took {planned:.0f} simulated pulls an episode."
    text = (
        f"KnotGym, task {' or '.join(task.tasks)} with"
        f" {' or '.join(map(str, task.crossings))} crossings, {task.split} split, engine"
        f" {task.engine}: {total['kept']} episodes of policy {policy.policy}, seed"
        f" {config.seed}. {total['succeeded']} of {total['played']} episodes played reached the"
        f" goal within {task.horizon} steps; failed ones are"
        f" {'kept' if config.keep_failed else 'dropped'}.{labels * bool(config.labels)}"
        f"{planning * bool(planned)}"
    )
    if scores["ref_min_score"] is not None:
        protocol = reference_scores()[f"{task.states or 'readable'}-{task.engine}"]
        text += f" Reference scores are the mean returns of `{protocol['command']}`."
    return MinariMetadata(
        dataset_id=config.dataset_id,
        algorithm_name=policy.policy,
        description=text,
        author=config.author,
        author_email=config.author_email,
        code_permalink=config.code_permalink,
        **scores,
    )
