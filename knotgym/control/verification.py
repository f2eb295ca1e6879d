"""Verify a dataset of any kind: detect what a path or an id holds and run its checks.

Episodes are played again by `rollouts`, which is why this module isn't in `datasets`.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import Stream
from knotgym.control.recorded_policy import replay
from knotgym.datasets import ReplayFault, faults, locate, open_episodes
from knotgym.envs import EpisodeBatch

_LANES = 256
_MOST_EPISODES = 10_000_000
_ROUNDING = 1e-9  # m and 1: other processors round the noise of a reset differently
Count = Callable[[str, int, int], None]  # progress callback (stage, done, total)
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # as the built-in `map`


def verify(source: str | os.PathLike[str], *, sample: int = 0) -> list[str]:
    """Verify a dataset: checksums, schema, codes by two labellers, exact replays, pictures, splits.

    Args:
        source: a folder or a file that knotgym wrote, or the id of a Minari dataset.
        sample: of episodes, how many drawn ones to play again, where all would take too long; 0 for
            all. Columns are then not compared with Minari's form.

    Returns:
        Faults; each names the file and, where possible, the row or step. Empty if there are none.

    Raises:
        FileNotFoundError: there is nothing at `source`.
        MissingExtra: `source` is a table of pictures and pyarrow isn't installed.
    """
    return list(dataset_faults(source, sample=sample))


def dataset_faults(
    source: str | os.PathLike[str], each: Map = map, count: Count = lambda *_: None, sample: int = 0
) -> Iterator[str]:
    """Yield the faults that `verify` lists, each as soon as it is found.

    If only replays differ, a last line says that machines round differently. `each` replaces `map`
    and may run in parallel, for files of pictures.
    """
    elsewhere, wrong = False, False
    for fault in _faults(source, each, count, sample):
        replayed = isinstance(fault, ReplayFault)
        elsewhere, wrong = elsewhere or replayed, wrong or not replayed
        yield fault
    if elsewhere and not wrong:
        yield (
            f"{source}: only replays differ, and other machines may round differently; the manifest"
            " says which made it"
        )


def _faults(source: str | os.PathLike[str], each: Map, count: Count, sample: int) -> Iterator[str]:
    found = locate(os.fspath(source))
    if found.kind != "episodes":
        yield from faults(found, replay, each, count)
        return
    for one in found.episodes:
        own = [*faults(found._replace(episodes=(one,)), replay, each, count, sample)]
        yield from own or _start_faults(one, sample)


def _start_faults(source: Path, sample: int) -> Iterator[str]:
    """Yield episodes of a collection that don't begin as the seeds of its run say."""
    dataset = open_episodes(source).drawn(sample)
    run, rows = dataset.attributes.get("run"), dataset.episodes.episodes
    config = run.get("config") if isinstance(run, dict) else None
    if not isinstance(config, dict):
        return
    seed, count = config.get("seed"), config.get("episodes")
    if config.get("steps"):  # takes the place of `episodes`; as many were played as it took
        summary = run.get("summary") if isinstance(run, dict) else None
        count = summary.get("played") if isinstance(summary, dict) else None
    if type(seed) is not int or type(count) is not int or not 0 <= count <= _MOST_EPISODES:
        yield f"{dataset.path}: its run had seed {seed!r} and {count!r} episodes, not two numbers"
        return
    # a collection may keep successes alone: then its seeds are some of these
    of_run = [Stream.EPISODE.derived_seed(seed, number) for number in range(count)]
    task = dataset.found_task
    for first in range(0, rows.rows, _LANES):
        some = np.arange(first, min(first + _LANES, rows.rows))
        own = rows.take(some)
        # begun again as the run began them, which draws start, goal and noise from the seed
        batch = EpisodeBatch(task, len(some))
        batch.begin(np.arange(len(some)), own["seed"].clip(0).tolist())
        off = np.abs(batch.start_qpos - own["start_qpos"]).max(axis=1)
        wrong = {
            "its seed is none of the run's": ~np.isin(own["seed"], of_run),
            "its seed draws another start": batch.start_row != own["start"],
            "its seed draws another goal": batch.goal_row != own["goal"],
            "its seed draws another noise of the start": off > _ROUNDING,
        }
        for row, found in zip(some.tolist(), zip(*wrong.values(), strict=True), strict=True):
            if any(found):
                number = dataset.numbers[row]
                yield f"{dataset.path}, episode {number}: {[*wrong][found.index(True)]}"
