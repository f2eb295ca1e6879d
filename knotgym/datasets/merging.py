"""Merge datasets of states or of episodes that share no row.

Files of episodes become a Minari dataset, too. Shards of a run aren't merged here: their journals
are, by running again.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from knotgym.common import (
    Counts,
    InvalidInput,
    atomic_write,
    by_name,
    one_line,
    require_output,
    sha256,
)
from knotgym.datasets.episode_dataset import (
    STATES_DIGEST,
    EpisodeDataset,
    require_alike,
    write_episodes,
)
from knotgym.datasets.episode_verification import shared_faults
from knotgym.datasets.located import locate, require_file
from knotgym.datasets.minari_form import MinariMetadata, metadata_of, publish
from knotgym.datasets.subsets import opened
from knotgym.envs import TaskConfig, task_sides
from knotgym.states import (
    States,
    is_bundled,
    merge_states,
    minari_root,
    repeated,
    resolve,
    write_states,
)

_SCORES = ("ref_min_score", "ref_max_score", "num_episodes_average_score")  # of the metadata


def merge(
    given: Sequence[str], out: Path | None = None, dataset_id: str = "", overwrite: bool = False
) -> str:
    """Merge datasets that share no row; return a one-line summary.

    Args:
        given: paths or ids, of states or of episodes.
        out: the file to write; with `dataset_id` the Minari root.
        dataset_id: for episodes, the id of a Minari dataset to write.
        overwrite: replace what is there.

    Raises:
        MissingFile: one of them doesn't exist.
        InvalidInput: they are of different kinds, ropes, engines, splits or states, or share a row.
        Occupied: the output exists, and `overwrite` is False.
    """
    if not given:
        raise InvalidInput("nothing to merge: give at least one dataset")
    opened_data, sources = [opened(name).data for name in given], [resolve(name) for name in given]
    states = [data for data in opened_data if isinstance(data, States)]
    datasets = [data for data in opened_data if isinstance(data, EpisodeDataset)]
    if len(given) not in (len(states), len(datasets)):
        kinds = ", ".join(locate(name).kind for name in given)
        raise InvalidInput(f"datasets to merge are all of states or all of episodes, got {kinds}")
    if dataset_id:
        if states:
            raise InvalidInput("an id is for episodes; give --out for states")
        target = Path(out or minari_root()) / dataset_id
        require_output(target, folder=True, overwrite=overwrite, reads=sources)
    elif out is None:
        raise InvalidInput("give an output, --out, or for episodes --id for a Minari dataset")
    else:
        require_file(target := out, sources, overwrite)
    if states:
        merged = merge_states(states, distinct=True)
        rows = range(len(merged))
        for fault in shared_faults(merged.points, merged.split, rows, rows):
            raise InvalidInput(f"merged, {fault}; leave one out, see `knotgym dataset delete`")
        with atomic_write(target, overwrite=overwrite) as temporary:
            write_states(temporary, merged)
        return f"{target}: {len(merged)} states"
    task, engine = _joint_task(datasets), _one_engine(datasets)
    _require_distinct(datasets)
    parts, facts = [dataset.episodes for dataset in datasets], datasets[0].facts
    if len(datasets) > 1:
        facts = {name: fact for name, fact in facts.items() if name == STATES_DIGEST}
    facts = {**facts, "engine": engine}
    if dataset_id:
        about, carried = _metadata(datasets, dataset_id), _states(datasets[0])
        publish(parts, task, about, out, states=carried, facts=facts, overwrite=overwrite)
    else:
        with atomic_write(target, overwrite=overwrite) as temporary:
            write_episodes(temporary, parts, task, facts)
    return f"{target}: {sum(map(len, datasets))} episodes"


def _states(dataset: EpisodeDataset) -> Path | None:
    """Return the state file that a dataset of these episodes must include; None if bundled."""
    return None if is_bundled(dataset.task.states) else dataset.states_path()


def _joint_task(datasets: Sequence[EpisodeDataset]) -> TaskConfig:
    """Return the task that draws from those of all datasets; refuse what can't be joined.

    Tasks and nx may differ, and state files may have different names.
    """
    require_alike(datasets, _facts)
    first = datasets[0]
    joint = TaskConfig.joined([dataset.task for dataset in datasets])
    if joint != first.task:  # its environment can be made
        task_sides(replace(joint, states=str(first.states_path())))
    return joint


def _facts(dataset: EpisodeDataset) -> dict[str, object]:
    states = _states(dataset)
    settings = {n: v for n, v in vars(dataset.task).items() if n not in ("task", "nx", "states")}
    return settings | {
        "rope model": dataset.attributes.get("rope"),
        "form": dataset.attributes["form"],
        "state file, by its SHA-256": sha256(states) if states else dataset.task.states,
    }


def _one_engine(datasets: Sequence[EpisodeDataset]) -> str | None:
    """Return the digest of the engine that made all datasets; None if one doesn't say it."""
    said = {dataset.path: dataset.attributes.get("engine") for dataset in datasets}
    digests = {str(digest): path for path, digest in said.items() if digest is not None}
    if len(digests) > 1:
        which = ", ".join(f"{path} {digest}" for digest, path in digests.items())
        raise InvalidInput(one_line(f"engines that do otherwise made these datasets: {which}"))
    return None if None in said.values() else next(iter(digests))


def _require_distinct(datasets: Sequence[EpisodeDataset]) -> None:
    """Refuse two episodes with the same start, goal and pulls."""
    every = [(dataset, row) for dataset in datasets for row in range(len(dataset))]
    told = Counts.over(datasets, "comparing episodes of datasets")
    for pair in repeated(digest for dataset in told for digest in dataset.episodes.digests()):
        first, second = (f"episode {every[k][1]} of {every[k][0].path}" for k in pair)
        raise InvalidInput(f"{first} and {second} are the same; merge sets that share no episode")


def _metadata(datasets: Sequence[EpisodeDataset], dataset_id: str) -> MinariMetadata:
    """Join the metadata of datasets; equal reference scores are those of the whole."""
    known = [metadata for dataset in datasets if (metadata := metadata_of(dataset))]
    policies = {str(name) for dataset in datasets for name in dataset.episodes.episodes["policy"]}
    described = [f"Merged of {', '.join(dataset.name for dataset in datasets)}."]
    described += [f"{metadata.dataset_id}: {metadata.description}" for metadata in known]
    scores = [{name: getattr(metadata, name) for name in _SCORES} for metadata in known]
    is_one = len(scores) == len(datasets) and all(score == scores[0] for score in scores)
    return MinariMetadata(
        dataset_id=dataset_id,
        algorithm_name=", ".join(sorted(policies)),
        description="\n\n".join(described),
        author=tuple({name for metadata in known for name in metadata.author}),
        author_email=tuple({name for metadata in known for name in metadata.author_email}),
        digests=by_name((about.dataset_id, about.digests) for about in known if about.digests),
        **(scores[0] if is_one else {}),
    )
