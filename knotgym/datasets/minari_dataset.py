"""Minari datasets: episode files in Minari's folder layout, with the metadata that it reads.

    {out}/{dataset id}/data/main_data.hdf5      an episode file, see `episode_reader`
    {out}/{dataset id}/data/metadata.json       Minari's metadata, without JPEG encoding
    {out}/{dataset id}/data/states.h5           the states it resets from, unless they are shipped

The files are written here, because Minari would store pictures as JPEG and drop seeds and options
when datasets are combined.
"""

import copy
import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium

import knotgym
from knotgym.common.atomic_files import atomic_write, require_output, sha256
from knotgym.common.configuration import as_json
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import foreign_bytes_as
from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.episode_writer import merge_episodes
from knotgym.envs.tasks import TaskConfig
from knotgym.states.split_names import CODE_SPLITS, STATE_SPLITS
from knotgym.states.state_file import minari_root, ships

_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")


@dataclass(frozen=True, kw_only=True)
class MinariMetadata:
    """The part of Minari's metadata that doesn't follow from the episodes.

    Attributes:
        dataset_id: "{namespace}/{name}-v{version}", such as "knotgym/tie-nx3/expert-v0".
        algorithm_name: name of the policy that acted.
        description: a description in Markdown.
        author, author_email: names and addresses.
        code_permalink: link to the code that generated the dataset.
        ref_min_score, ref_max_score: mean returns of a random and of an expert policy, for
            `minari.get_normalized_score`.
        num_episodes_average_score: number of episodes behind those means.
        eval_split: split of the evaluation environment.
        digests: digests of the policy, states, code and rope that generated it, see
            `episodes.digests`; after a merge, dataset id -> its digests.

    Raises:
        InvalidFile: the id is invalid for Minari, or only one of the two scores is given.
    """

    dataset_id: str
    algorithm_name: str
    description: str
    author: tuple[str, ...] = ()
    author_email: tuple[str, ...] = ()
    code_permalink: str | None = None
    ref_min_score: float | None = None
    ref_max_score: float | None = None
    num_episodes_average_score: int | None = None
    eval_split: str = "test"
    digests: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if _ID.fullmatch(self.dataset_id) is None:
            raise InvalidFile(
                "a dataset id has the form namespace/name-v0, of letters, digits, - and _; got"
                f" {self.dataset_id!r}"
            )
        if (self.ref_min_score is None) != (self.ref_max_score is None):
            raise InvalidFile(
                "reference scores come in pairs: give both ref_min_score and ref_max_score"
            )
        for name in ("author", "author_email"):
            object.__setattr__(self, name, tuple(sorted(getattr(self, name))))


def publish(
    sources: Sequence[Any],
    metadata: MinariMetadata,
    out: str | os.PathLike[str] | None = None,
    *,
    store: str | None = None,
    concatenate: bool = False,
    distinct: bool = False,
    overwrite: bool = False,
    states: str | os.PathLike[str] | None = None,
    task: TaskConfig | None = None,
    attributes: Mapping[str, str] | None = None,
    count: Count = uncounted,
) -> Path:
    """Merge episode files, including compact ones, into a Minari dataset; write it atomically.

    Args:
        sources: as for `merge_episodes`.
        metadata: the dataset's metadata.
        out: root folder of Minari datasets; None for Minari's own.
        store: observations, "pixels", "state", "both" or "symbolic"; None for the sources' (the
            task's, if the sources are compact).
        concatenate, distinct: as for `merge_episodes`.
        states: a state file to include; a task whose `states` is the dataset's id resets from it,
            even after the dataset is moved.
        task, attributes, count: as for `merge_episodes`.

    Returns:
        The dataset's folder.

    Raises:
        InvalidFile: as for `merge_episodes`, or `store` is "none".
        Occupied: there is a dataset of this id, and `overwrite` is false.
    """
    folder = Path(out or minari_root()) / metadata.dataset_id
    require_output(folder, folder=True, overwrite=overwrite)
    first = EpisodeReader(sources[0]) if sources else None
    if first is not None and store is None and first.stored == "none":
        store = first.task.observation
    if store == "none":
        raise InvalidFile(
            "a Minari dataset needs observations; for a file without them see `compact`"
        )
    with atomic_write(folder, overwrite=overwrite) as temporary:
        data = temporary / "data"
        data.mkdir(parents=True)
        merge_episodes(
            sources,
            data / "main_data.hdf5",
            store=store,
            concatenate=concatenate,
            distinct=distinct,
            task=task,
            attributes={**(attributes or {}), "metadata": json.dumps(asdict(metadata))},
            count=count,
        )
        merged = EpisodeReader(temporary)
        entries = {
            **minari_entries(metadata, merged.task),
            "total_episodes": len(merged),
            "total_steps": int(merged.lengths.sum()),
        }
        merged.close()
        if states is not None:
            shutil.copyfile(states, data / "states.h5")
        size = sum(file.stat().st_size for file in data.iterdir()) + len(json.dumps(entries))
        entries["dataset_size"] = round(size / 1e6, 1)
        text = json.dumps(entries, sort_keys=True, separators=(",", ":"))
        (data / "metadata.json").write_text(text, encoding="utf-8")
    return folder


def dataset_files(data: Path) -> list[Path]:
    """List the files in a dataset's `data` folder that belong to it, ignoring any others."""
    named = ("main_data.hdf5", "metadata.json", "states.h5", "collection.json")
    return [data / name for name in named if os.path.lexists(data / name)]


def loading_lines(dataset_id: str, root: str | os.PathLike[str] | None = None) -> list[str]:
    """Return the two lines of Python that load a dataset, with Minari and as arrays.

    >>> for line in loading_lines("knotgym/tie-nx3/expert-v0", "data"):
    ...     print(line)
    minari.load_dataset("knotgym/tie-nx3/expert-v0")  # with MINARI_DATASETS_PATH=data
    knotgym.loaders.arrays("data/knotgym/tie-nx3/expert-v0", observation="state")
    """
    named = dataset_id if root is None else (Path(root) / dataset_id).as_posix()
    where = "" if root is None else f"  # with MINARI_DATASETS_PATH={Path(root).as_posix()}"
    return [
        f'minari.load_dataset("{dataset_id}"){where}',
        f'knotgym.loaders.arrays("{named}", observation="state")',
    ]


def merge_datasets(
    sources: Sequence[Any],
    dataset_id: str,
    out: str | os.PathLike[str] | None = None,
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> Path:
    """Merge datasets of one task and split into a new one, and return its folder.

    Nothing is encoded again; Minari's own `combine_datasets` converts pictures to JPEG and drops
    the evaluation split.

    Args:
        sources: datasets or episode files that share no episode.
        dataset_id: id of the new dataset.
        out, count, overwrite: as for `publish`.

    Raises:
        InvalidFile: the sources can't be combined.
        Occupied: there is a dataset of this id, and `overwrite` is false.
    """
    readers = [EpisodeReader(source) for source in sources]
    for name in ("split", "states"):
        values = {_states_digest(one) if name == "states" else one.task.split for one in readers}
        if len(values) > 1:
            raise InvalidFile(
                f"datasets to merge must have one split and one state file; these differ in {name}:"
                f" {', '.join(str(one.path) for one in readers)}"
            )
    known = [metadata for source in sources if (metadata := metadata_of(source))]
    first, task = readers[0], None
    carried = None if ships(first.task.states) else first.states_path()
    if carried is not None:
        task = replace(first.task, states=dataset_id)
    same: dict[str, Any] = {}
    for name in ("code_permalink", "ref_min_score", "ref_max_score", "num_episodes_average_score"):
        values = {getattr(one, name) for one in known}
        same[name] = values.pop() if len(values) == 1 and len(known) == len(sources) else None
    policies = [one.algorithm_name for one in known] or [str(first.attributes(0)["policy"])]
    described = [f"Merged of {', '.join(one.dataset_id for one in known) or 'episode files'}."]
    described += [f"{one.dataset_id}: {one.description}" for one in known]
    metadata = MinariMetadata(
        dataset_id=dataset_id,
        algorithm_name=", ".join(dict.fromkeys(policies)),
        description="\n\n".join(described),
        author=tuple({name for one in known for name in one.author}),
        author_email=tuple({name for one in known for name in one.author_email}),
        eval_split=known[0].eval_split if known else "test",
        digests={one.dataset_id: one.digests for one in known if one.digests},
        **same,
    )
    for reader in readers:
        reader.close()
    how: dict[str, Any] = {"concatenate": True, "distinct": True, "overwrite": overwrite}
    return publish(sources, metadata, out, states=carried, task=task, count=count, **how)


def _states_digest(reader: EpisodeReader) -> str:
    if ships(reader.task.states):
        return str(reader.task.states or "readable")
    path = reader.states_path()
    if not path.is_file():
        raise InvalidFile(f"{reader.path} was reset from {path}, which doesn't exist")
    return sha256(path)


def compact(
    source: Any,
    target: str | os.PathLike[str],
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> None:
    """Write a dataset's compact form: one file of episodes and metadata, without observations.

    `publish([target], metadata_of(target))` restores the dataset. `source` is what `EpisodeReader`
    takes, `count` a progress callback; with `overwrite` an existing file is replaced.
    """
    require_output(target, folder=False, overwrite=overwrite)
    metadata = metadata_of(source)
    with atomic_write(target, overwrite=overwrite) as temporary:
        attributes = {} if metadata is None else {"metadata": json.dumps(asdict(metadata))}
        merge_episodes([source], temporary, store="none", attributes=attributes, count=count)


def metadata_of(source: Any) -> MinariMetadata | None:
    """Return a dataset's metadata, also from its compact file; None for other episode files."""
    reader = EpisodeReader(source)
    entries = reader.metadata()
    reader.close()
    with foreign_bytes_as(InvalidFile, f"{reader.path}, metadata"):
        return None if entries is None else MinariMetadata(**entries)


def minari_entries(metadata: MinariMetadata, task: TaskConfig) -> dict[str, Any]:
    """Return the entries of Minari's metadata.json except the counts."""
    # imported here, because importing them takes seconds and reading a dataset needs neither
    import minari
    from minari.serialization import serialize_space

    from knotgym.envs.environment import action_space

    given = {
        name: value
        for name, value in asdict(metadata).items()
        if name != "eval_split" and value not in (None, (), {})
    }
    here = [] if "+" in knotgym.__version__ else [f"knotgym>={knotgym.__version__}"]
    return {
        **given,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "minari_version": minari.__version__,
        "requirements": [*here, "minari>=0.5.4"],
        "observation_space": _bounds(replace(task, split="train", states=None)),
        "action_space": serialize_space(action_space(replace(task, action="pull"))),
        "env_spec": environment_spec(task).to_json(),
        "eval_env_spec": environment_spec(_evaluated(task, metadata.eval_split)).to_json(),
    }


def _evaluated(task: TaskConfig, split: str) -> TaskConfig:
    """Return the evaluation environment's task; in another split it has all goals."""
    if task.split in CODE_SPLITS and split in STATE_SPLITS:
        split += "-code"
    return replace(task, split=split, max_goals=task.max_goals if split == task.split else None)


@lru_cache(maxsize=16)
def _bounds(task: TaskConfig) -> str:
    """Return the JSON of a task's observation space, with Minari's one bound per pixel.

    Without this entry Minari would construct the environment, and need knotgym to read a file.
    """
    from minari.serialization import serialize_space

    from knotgym.envs.environment import observation_space

    bounds = serialize_space(observation_space(task), to_string=False)
    return json.dumps(bounds, separators=(",", ":"))


def environment_spec(task: TaskConfig) -> gymnasium.envs.registration.EnvSpec:
    """Return the environment's spec with every setting, so that later defaults don't matter."""
    spec = copy.deepcopy(gymnasium.spec(f"knotgym/{task.task.capitalize()}-v0"))
    spec.kwargs = as_json(task)
    return spec
