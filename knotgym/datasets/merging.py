"""Merge datasets of one kind: states into a state file, episodes into a file or a Minari dataset.

Shards of a run aren't merged here: their journals are, by running again.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from knotgym.common.atomic_files import atomic_write, require_output, sha256
from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.datasets.episode_dataset import EpisodeDataset, open_episodes, write_episodes
from knotgym.datasets.episodes import episode_digests
from knotgym.datasets.located import (
    refuse_minaris_folder,
    require_apart_from,
    resolve_dataset,
    sources,
)
from knotgym.datasets.minari_form import MinariMetadata, metadata_of, publish
from knotgym.envs.tasks import TaskConfig
from knotgym.states.state_file import (
    merge_states,
    minari_root,
    read_states,
    ships,
    states_at,
    write_states,
)


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
        InvalidInput: they are of different kinds, tasks, ropes, splits or states, or share a row.
        Occupied: the output exists, and `overwrite` is False.
    """
    if not given:
        raise InvalidInput("nothing to merge: give at least one dataset")
    for name in given:
        sources(name)  # refuses links
    found = [resolve_dataset(name) for name in given]
    kinds = {one.kind for one in found}
    if len(kinds) > 1 or "images" in kinds:
        raise InvalidInput(
            "datasets to merge are all of states or all of trajectories, got"
            f" {', '.join(one.kind for one in found)}"
        )
    if not dataset_id:
        if out is None:
            raise InvalidInput("give an output, --out, or for episodes --id for a Minari dataset")
        require_output(out, folder=False, overwrite=overwrite)
        refuse_minaris_folder(out)
    require_apart_from(Path(out or minari_root()) / dataset_id, *given)
    if kinds == {"states"}:
        if dataset_id or out is None:
            raise InvalidInput("an id is for episodes; give --out for states")
        states = merge_states([read_states(states_at(path)) for _, path in found], distinct=True)
        with atomic_write(out, overwrite=overwrite) as temporary:
            write_states(temporary, states)
        return f"{out}: {len(states)} states"
    datasets = [open_episodes(path) for _, path in found]
    task = _one_task(datasets)
    _require_distinct(datasets)
    parts, count = (
        [one.episodes for one in datasets],
        sum(one.episodes.episodes.rows for one in datasets),
    )
    if dataset_id:
        first = datasets[0]
        states_file = None if ships(task.states) else first.states_path()
        metadata = _metadata(datasets, dataset_id)
        made = publish(parts, task, metadata, out, states=states_file, overwrite=overwrite)
        return f"{made}: {count} episodes"
    assert out is not None
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_episodes(temporary, parts, task)
    return f"{out}: {count} episodes"


def _one_task(datasets: Sequence[EpisodeDataset]) -> TaskConfig:
    """Return the task that datasets share; their state files may have different names."""
    first = datasets[0]
    for other in datasets[1:]:
        if replace(other.task, states=None) != replace(first.task, states=None):
            raise InvalidInput(
                f"datasets to merge must have one task; {first.path} has {first.task},"
                f" {other.path} has {other.task}"
            )
        if other.attributes.get("rope") != first.attributes.get("rope"):
            raise InvalidInput(f"{first.path} and {other.path} are of different rope models")
        if other.episodes.is_recording != first.episodes.is_recording:
            raise InvalidInput(f"one of {first.path} and {other.path} is a recording; expand it")
        if _states_digest(other) != _states_digest(first):
            raise InvalidInput(
                f"datasets to merge must have one state file; {first.path} and {other.path} were"
                " reset from different ones"
            )
    return first.task


def _states_digest(dataset: EpisodeDataset) -> str:
    if ships(dataset.task.states):
        return str(dataset.task.states or "readable")
    path = dataset.states_path()
    if not path.is_file():
        raise InvalidFile(f"{dataset.path} was reset from {path}, which doesn't exist")
    return sha256(path)


def _require_distinct(datasets: Sequence[EpisodeDataset]) -> None:
    """Refuse two episodes with the same start, goal and pulls."""
    seen: dict[bytes, str] = {}
    for dataset in datasets:
        for row, digest in enumerate(episode_digests(dataset.episodes)):
            here = f"episode {row} of {dataset.path}"
            earlier = seen.setdefault(digest, here)
            if earlier is not here:
                raise InvalidInput(
                    f"{earlier} and {here} are the same; merge datasets that share no episode"
                )


def _metadata(datasets: Sequence[EpisodeDataset], dataset_id: str) -> MinariMetadata:
    """Join the metadata of datasets; scores and links are kept if they are those of all."""
    known = [metadata for one in datasets if (metadata := metadata_of(one))]
    policies = {str(name) for one in datasets for name in one.episodes.episodes["policy"]}
    described = [f"Merged of {', '.join(one.name for one in datasets)}."]
    described += [f"{one.dataset_id}: {one.description}" for one in known]
    joined = MinariMetadata(
        dataset_id=dataset_id,
        algorithm_name=", ".join(sorted(policies)),
        description="\n\n".join(described),
        author=tuple({name for one in known for name in one.author}),
        author_email=tuple({name for one in known for name in one.author_email}),
        digests={one.dataset_id: one.digests for one in known if one.digests},
    )
    shared = ("code_permalink", "ref_min_score", "ref_max_score", "num_episodes_average_score")
    facts = {tuple(getattr(one, name) for name in shared) for one in known}
    if len(facts) == 1 and len(known) == len(datasets):
        joined = replace(joined, **dict(zip(shared, facts.pop(), strict=True)))
    return joined
