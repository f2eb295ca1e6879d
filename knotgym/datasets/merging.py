"""Merge datasets of one kind: states into a state file, episodes into a file or a Minari dataset.

Shards of a run aren't merged here: their journals are, by running again.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from knotgym.common import InvalidInput, atomic_write, require_output, sha256
from knotgym.datasets.episode_dataset import (
    STATES_DIGEST,
    EpisodeDataset,
    require_alike,
    write_episodes,
)
from knotgym.datasets.located import locate
from knotgym.datasets.minari_form import MinariMetadata, metadata_of, publish
from knotgym.datasets.selectable import EpisodeRows, StateRows, opened, require_file
from knotgym.envs import TaskConfig, task_sides
from knotgym.states import is_bundled, merge_states, minari_root, repeated, write_states


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
    found, sources = [opened(name) for name in given], [locate(name).root for name in given]
    states = [one.states for one in found if isinstance(one, StateRows)]
    datasets = [one.dataset for one in found if isinstance(one, EpisodeRows)]
    if len(given) not in (len(states), len(datasets)):
        kinds = ", ".join(locate(name).kind for name in given)
        raise InvalidInput(
            f"datasets to merge are all of states or all of trajectories, got {kinds}"
        )
    if dataset_id:
        if states:
            raise InvalidInput("an id is for episodes; give --out for states")
        folder = Path(out or minari_root()) / dataset_id
        require_output(folder, folder=True, overwrite=overwrite, reads=sources)
    elif out is None:
        raise InvalidInput("give an output, --out, or for episodes --id for a Minari dataset")
    else:
        require_file(out, sources, overwrite)
    if states and out:
        merged = merge_states(states, distinct=True)
        with atomic_write(out, overwrite=overwrite) as temporary:
            write_states(temporary, merged)
        return f"{out}: {len(merged)} states"
    task, parts = _joint_task(datasets), [one.episodes for one in datasets]
    _require_distinct(datasets)
    kept = datasets[0].facts
    facts = kept if len(datasets) == 1 else {k: v for k, v in kept.items() if k == STATES_DIGEST}
    if dataset_id:
        made = publish(
            parts,
            task,
            _metadata(datasets, dataset_id),
            out,
            states=_states(datasets[0]),
            facts=facts,
            overwrite=overwrite,
        )
    elif out:
        made = out
        with atomic_write(out, overwrite=overwrite) as temporary:
            write_episodes(temporary, parts, task, facts)
    return f"{made}: {sum(one.episodes.rows for one in parts)} episodes"


def _states(dataset: EpisodeDataset) -> Path | None:
    """Return the state file that a dataset of these episodes must include; None if bundled."""
    return None if is_bundled(dataset.task.states) else dataset.states_path()


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
    states = _states(dataset)
    return {
        "rope model": dataset.attributes.get("rope"),
        "form": dataset.attributes["form"],
        "state file, by its SHA-256": sha256(states) if states else dataset.task.states,
    }


def _require_distinct(datasets: Sequence[EpisodeDataset]) -> None:
    """Refuse two episodes with the same start, goal and pulls."""
    every = [(one, row) for one in datasets for row in range(one.episodes.episodes.rows)]
    for pair in repeated(digest for one in datasets for digest in one.episodes.digests()):
        first, second = (f"episode {every[k][1]} of {every[k][0].path}" for k in pair)
        raise InvalidInput(
            f"{first} and {second} are the same; merge datasets that share no episode"
        )


def _metadata(datasets: Sequence[EpisodeDataset], dataset_id: str) -> MinariMetadata:
    """Join the metadata of datasets; their reference scores aren't those of the whole."""
    known = [metadata for one in datasets if (metadata := metadata_of(one))]
    policies = {str(name) for one in datasets for name in one.episodes.episodes["policy"]}
    described = [f"Merged of {', '.join(one.name for one in datasets)}."]
    described += [f"{one.dataset_id}: {one.description}" for one in known]
    return MinariMetadata(
        dataset_id=dataset_id,
        algorithm_name=", ".join(sorted(policies)),
        description="\n\n".join(described),
        author=tuple({name for one in known for name in one.author}),
        author_email=tuple({name for one in known for name in one.author_email}),
        digests={one.dataset_id: one.digests for one in known if one.digests},
    )
