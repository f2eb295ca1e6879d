"""Verify what knotgym wrote: datasets, entries, and what a dataset says of itself.

A set's metadata are compared with the run that made it and with the reference scores of its task;
Minari normalizes returns by those. A policy of the package plays some drawn episodes again. What
nothing can compute again, `dataset verify` shows as claimed.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import knotgym
from knotgym import datasets
from knotgym.common import InvalidFile, KnotgymError, from_json
from knotgym.control import replay
from knotgym.datasets import EpisodeDataset, open_episodes
from knotgym.generate.entries import acted_otherwise, read_entry, repeats
from knotgym.generate.episode_configs import CollectConfig
from knotgym.generate.results import references_of
from knotgym.states import resolve

_AUTHORS = ("author", "author_email")
_CLAIMED = (*_AUTHORS, "code_permalink")  # of the metadata, and nothing can confirm them
_DRAWN = {False: 16, True: 4}  # episodes played again, of a policy that plans or not


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
    recounted = _recounted(resolve(os.fspath(source)))
    return [*faults(source, sample=sample)] if recounted is None else recounted


def faults(
    source: str | os.PathLike[str], each: Callable[..., Iterable[Any]] = map, sample: int = 0
) -> Iterator[str]:
    """Yield the faults of datasets, each as soon as it is found.

    Args:
        source, sample: as of `verify`, but no entry.
        each: `map` or a pool's.
    """
    clean, located = True, datasets.locate(os.fspath(source))
    for fault in datasets.faults(located, replay, each, sample):
        clean = False
        yield fault
    for path in located.episodes if clean else ():
        opened = open_episodes(path)
        yield from (f"{opened.path}: {fault}" for fault in _metadata_faults(opened))
        yield from _recounted(opened.path) or ()


def _recounted(path: Path) -> list[str] | None:
    """Return the faults of an entry, played from where its seeds begin; None if it isn't one."""
    try:
        entry = read_entry(path)
    except InvalidFile as error:
        return [str(error)]
    return entry and [f"{path}: {fault}" for _, faults in entry.recounted() for fault in faults]


def claims(dataset: EpisodeDataset) -> set[str]:
    """Return the names of what a set says and nothing here could make again or compare."""
    about, acting = dataset.metadata or {}, _acting(dataset)
    said = {name for name in _CLAIMED if about.get(name)}
    said |= {"policy", *(["algorithm_name"] * ("algorithm_name" in about))} if not acting else set()
    for name, right in references_of(dataset.task).items():
        if about.get(name) and (_is_other(dataset) or not right):
            said.add(name)
    return said | {*dataset.episodes.claims()}


def _metadata_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield what a set's metadata say that its run and its task don't."""
    about, run = dataset.metadata, dataset.attributes.get("run")
    if (acting := _acting(dataset)) is not None:
        task = replace(dataset.found_task, observation=acting.policy_task.observation)
        drawn = dataset.drawn(_DRAWN[acting.policy.plans])
        seeds = drawn.episodes.episodes["seed"].tolist()
        row = acted_otherwise(acting.policy, task, drawn.episodes, seeds)
        if row is not None:
            who = acting.policy.policy
            yield f"episode {drawn.numbers[row]}: {who}, played again, pulls otherwise"
    if about is None:
        return
    config = run.get("config") if isinstance(run, dict) else None
    policy = config.get("policy") if isinstance(config, dict) else None
    if isinstance(config, dict) and isinstance(policy, dict):
        acted = ", ".join(sorted({*map(str, dataset.episodes.episodes["policy"])}))
        if (said := about.get("algorithm_name")) not in (policy.get("policy"), acted):
            yield f"algorithm_name is {said!r}, the policy of its run {policy.get('policy')!r}"
        for name in _AUTHORS:
            said, right = (sorted(map(str, said_of.get(name) or ())) for said_of in (about, config))
            if said != right:
                yield f"{name} is {said}, that of its run {right}"
    if _is_other(dataset):
        return  # other versions may have had other scores
    for name, right in references_of(dataset.task).items():
        # where none were measured, a user may have
        if about.get(name) not in (right, None) and (right is not None or config is not None):
            yield f"{name} is {about[name]}, that of its task {right}"


def _is_other(dataset: EpisodeDataset) -> bool:
    """Whether another version of the package made a set."""
    versions = dataset.attributes.get("versions")
    return not isinstance(versions, dict) or versions.get("knotgym") != knotgym.__version__


def _acting(dataset: EpisodeDataset) -> CollectConfig | None:
    """Return the run of a set if its policy can be played again; None otherwise."""
    run: Any = dataset.attributes.get("run")
    with suppress(
        KnotgymError, LookupError, TypeError, ValueError
    ):  # by attributes of a stranger's
        config = from_json(CollectConfig, run["config"])
        source = run["source"] or {}
        # pulls of earlier recordings are of the policies of their time
        if source.keys() <= {"states", "policies"} and repeats(config.policy, run["versions"]):
            return config
    return None
