"""Merge datasets of one kind: states into a state file, episodes into a file or a Minari dataset.

Shards of a run aren't merged here: their journals are, by running again.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.datasets.episode_dataset import EpisodeDataset, require_alike, write_episodes
from knotgym.datasets.episodes import episode_digests
from knotgym.datasets.located import locate
from knotgym.datasets.minari_form import MinariMetadata, metadata_of
from knotgym.datasets.selectable import (
    Destination,
    EpisodeRows,
    StateRows,
    opened,
    publish_rows,
    require_target,
)
from knotgym.envs.task_states import task_sides
from knotgym.envs.tasks import TaskConfig
from knotgym.states.state_file import merge_states, ships, write_states


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
        InvalidInput: they are of different kinds, ropes, splits or states, or share a row.
        Occupied: the output exists, and `overwrite` is False.
    """
    if not given:
        raise InvalidInput("nothing to merge: give at least one dataset")
    found, target = [opened(name) for name in given], Destination(out, dataset_id, overwrite)
    states = [one.states for one in found if isinstance(one, StateRows)]
    datasets = [one.dataset for one in found if isinstance(one, EpisodeRows)]
    if len(given) not in (len(states), len(datasets)):
        kinds = ", ".join(locate(name).kind for name in given)
        raise InvalidInput(
            f"datasets to merge are all of states or all of trajectories, got {kinds}"
        )
    file = require_target(found[0], target, [locate(name).root for name in given])
    if states:
        merged = merge_states(states, distinct=True)
        with atomic_write(file, overwrite=overwrite) as temporary:
            write_states(temporary, merged)
        return f"{out}: {len(merged)} states"
    joint = replace(datasets[0], task=_joint_task(datasets))
    _require_distinct(datasets)
    parts = [one.episodes for one in datasets]
    count = f"{sum(one.episodes.rows for one in parts)} episodes"
    if dataset_id:
        made = publish_rows(joint, parts, _metadata(datasets, dataset_id), target, {})
        return f"{made}: {count}"
    with atomic_write(file, overwrite=overwrite) as temporary:
        write_episodes(temporary, parts, joint.task)
    return f"{out}: {count}"


def _joint_task(datasets: Sequence[EpisodeDataset]) -> TaskConfig:
    """Return the task that draws from those of all datasets; refuse what can't be joined.

    Tasks and nx may differ, and state files may have different names.
    """
    require_alike(datasets, ("task", "nx", "states"))
    first, wanted = datasets[0], _facts(datasets[0])
    for other in datasets[1:]:
        for name, value in _facts(other).items():
            if value != wanted[name]:
                raise InvalidInput(
                    f"datasets to merge must have one {name}; {first.path} has {wanted[name]},"
                    f" {other.path} has {value}"
                )
    tasks = {name: None for one in datasets for name in one.task.tasks}
    crossings = sorted({nx for one in datasets for nx in one.task.crossings})
    joint = replace(
        first.task,
        task=tuple(tasks) if len(tasks) > 1 else first.task.task,
        nx=tuple(crossings) if len(crossings) > 1 else first.task.nx,
    )
    if joint != first.task:  # its environment can be made
        task_sides(replace(joint, states=str(first.states_path())))
    return joint


def _facts(dataset: EpisodeDataset) -> dict[str, object]:
    return {
        "rope model": dataset.attributes.get("rope"),
        "form": dataset.attributes["form"],
        "state file, by its SHA-256": _states_digest(dataset),
    }


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
