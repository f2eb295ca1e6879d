"""Verify what knotgym wrote: datasets, entries, and what a dataset says of itself.

A set's metadata are compared with the run that made it and with the reference scores of its task;
Minari normalizes returns by those. What nothing can compute again, `dataset verify` shows as
claimed.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import knotgym
from knotgym.common import InvalidFile
from knotgym.control import dataset_faults
from knotgym.datasets import EpisodeDataset, locate, open_episodes
from knotgym.generate.entries import read_entry
from knotgym.generate.results import references_of
from knotgym.states import resolve

_AUTHORS = ("author", "author_email")
CLAIMED = ("algorithm_name", *_AUTHORS, "code_permalink")  # of the metadata


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
    root = resolve(os.fspath(source))
    try:
        entry = read_entry(root)
    except InvalidFile as error:
        return [str(error)]
    if entry is None:
        return [*faults(source, sample=sample)]
    return [f"{root}: {fault}" for _, found in entry.recounted() for fault in found]


def faults(
    source: str | os.PathLike[str], each: Callable[..., Iterable[Any]] = map, sample: int = 0
) -> Iterator[str]:
    """Yield the faults of datasets, each as soon as it is found.

    Args:
        source, sample: as of `verify`, but no entry.
        each: `map` or a pool's.
    """
    clean = True
    for fault in dataset_faults(source, each, sample):
        clean = False
        yield fault
    for path in locate(os.fspath(source)).episodes if clean else ():
        opened = open_episodes(path)
        yield from (f"{opened.path}: {fault}" for fault in _metadata_faults(opened))


def _metadata_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield what a set's metadata say that its run and its task don't."""
    about, run = dataset.metadata, dataset.attributes.get("run")
    if about is None:
        return
    config = run.get("config") if isinstance(run, dict) else None
    policy = config.get("policy") if isinstance(config, dict) else None
    if isinstance(config, dict) and isinstance(policy, dict):
        acted = ", ".join(sorted({*map(str, dataset.episodes.episodes["policy"])}))
        if (said := about.get("algorithm_name")) not in (policy.get("policy"), acted):
            yield f"algorithm_name is {said!r}, the policy of its run {policy.get('policy')!r}"
        for name in _AUTHORS:
            said, right = (sorted(map(str, one.get(name) or ())) for one in (about, config))
            if said != right:
                yield f"{name} is {said}, that of its run {right}"
    versions = dataset.attributes.get("versions")
    if not isinstance(versions, dict) or versions.get("knotgym") != knotgym.__version__:
        return  # other versions may have had other scores
    for name, right in references_of(dataset.task).items():
        # where none were measured, a user may have
        if about.get(name) not in (right, None) and (right is not None or config is not None):
            yield f"{name} is {about[name]}, that of its task {right}"
