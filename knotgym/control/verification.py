"""Verify a dataset of any kind: detect what a path or an id holds and run its checks.

Episodes are played again by `rollouts`, which is why this module isn't in `datasets`.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from knotgym.control.recorded_policy import RecordedPolicy
from knotgym.control.rollouts import rollouts
from knotgym.datasets.episode_verification import Count, uncounted, verify_episodes
from knotgym.datasets.episodes import Episodes
from knotgym.datasets.located import locate
from knotgym.datasets.machine import others
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.envs.tasks import TaskConfig
from knotgym.states.state_file import read_states

# a phrase in the faults of replays, which may differ on another machine because of rounding
_REPLAYED = ("bit for bit", "played again")
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # as the built-in `map`


def replay(episodes: Episodes, task: TaskConfig) -> Episodes:
    """Play episodes again from their starts and pulls."""
    return rollouts(RecordedPolicy(episodes), task, episodes.episodes)


def verify(source: str | os.PathLike[str]) -> list[str]:
    """Verify a dataset: checksums, schema, codes by two labellers, exact replays, pictures, splits.

    Args:
        source: a folder or a file that knotgym wrote, or the id of a Minari dataset.

    Returns:
        Faults; each names the file and, where possible, the row or step. Empty if there are none.

    Raises:
        FileNotFoundError: there is nothing at `source`.
        MissingExtra: `source` is a table of pictures and pyarrow isn't installed.
    """
    return list(faults(source))


def faults(
    source: str | os.PathLike[str], each: Map = map, count: Count = uncounted
) -> Iterator[str]:
    """Yield the faults that `verify` lists, each as soon as it is found.

    If only replays differ and the dataset was generated on another machine, a last line says how
    that machine differs. `each` replaces `map` and may run in parallel, see `image_faults`.
    """
    elsewhere, wrong = False, False
    for fault in _faults(source, each, count):
        replayed = any(phrase in fault for phrase in _REPLAYED)
        elsewhere, wrong = elsewhere or replayed, wrong or not replayed
        yield fault
    given = Path(source)
    differences = others(given) if elsewhere and not wrong and given.is_dir() else ""
    if differences:
        yield (
            f"{given}: generated on another machine, {differences}, which may round differently;"
            " everything but the replays is as it was written"
        )


def _faults(source: str | os.PathLike[str], each: Map, count: Count) -> Iterator[str]:
    found = locate(os.fspath(source))
    if found.pictures:
        # imported here, because only this check needs pyarrow
        from knotgym.datasets.image_verification import image_faults

        yield from image_faults(found.pictures, each, count)
    elif found.states and found.root.is_dir():
        yield from folder_faults(found.root, replay, count)
    elif found.states:
        yield from state_faults(read_states(found.states), count)
    else:
        for one in found.episodes:
            yield from verify_episodes(one, replay, count=count)
