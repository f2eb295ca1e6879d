"""Minari datasets: episode files in the folder that Minari looks in, with the metadata it reads.

    {out}/{dataset id}/data/main_data.hdf5      an episode file, see `episode_reader`
    {out}/{dataset id}/data/metadata.json       Minari's, images declared lossless
    {out}/{dataset id}/data/states.h5           the states it resets from, where they aren't those
                                                that ship

Minari itself would store images as JPEG, and lose seeds and options when datasets are combined; so
the files are written here.
"""

from __future__ import annotations

import copy
import json
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium

import knotgym
from knotgym.atomic_files import atomic_write, require_output, sha256
from knotgym.configuration import as_json
from knotgym.datasets.episode_reader import Count, EpisodeReader, InvalidEpisodeFile, uncounted
from knotgym.datasets.episode_writer import merge_episodes
from knotgym.datasets.states import minari_root, ships
from knotgym.hdf5_files import foreign_bytes_as
from knotgym.tasks import CODE_SPLITS, SPLITS, TaskConfig

_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")


@dataclass(frozen=True, kw_only=True)
class MinariMetadata:
    """What Minari's metadata says beyond what the episodes themselves say.

    Attributes:
        dataset_id: "{namespace}/{name}-v{version}", as "knotgym/tie-nx3/expert-v0".
        algorithm_name: the policy that acted.
        description: Markdown.
        author, author_email: names and addresses.
        code_permalink: where the code that made it can be seen.
        ref_min_score, ref_max_score: mean returns of a random and of an expert policy, for
            `minari.get_normalized_score`.
        num_episodes_average_score: episodes those means were taken over.
        eval_split: the states that the evaluation environment draws from.
        digests: of the policy, states, code and rope that made it, see `episodes.digests`; of
            merged datasets by their ids.

    Raises:
        InvalidEpisodeFile: Minari would not take the id, or only one of the two scores is given.
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
            raise InvalidEpisodeFile(
                "a dataset id is namespace/name-v0, letters, digits, - and _; got"
                f" {self.dataset_id!r}"
            )
        if (self.ref_min_score is None) != (self.ref_max_score is None):
            raise InvalidEpisodeFile(
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
    count: Count = uncounted,
) -> Path:
    """Merge episode files, compact ones too, into a Minari dataset; it appears whole or not at all.

    Args:
        sources: as `merge_episodes`.
        metadata: what Minari says of it.
        out: the root under which Minari would find the id; None for Minari's own.
        store: observations, "pixels", "state", "both" or "symbolic"; None for the sources' (the
            task's, if those are compact).
        concatenate, distinct: as `merge_episodes`.
        overwrite: replace a dataset of this id.
        states: a state file to carry along; a task whose `states` is the dataset's id resets from
            it, wherever the dataset goes.
        task, count: as `merge_episodes`.

    Returns:
        The dataset's folder.

    Raises:
        InvalidEpisodeFile: as `merge_episodes`; or nothing is to be stored.
        Occupied: there is a dataset of this id, and `overwrite` isn't asked for.
    """
    folder = Path(out or minari_root()) / metadata.dataset_id
    require_output(folder, folder=True, overwrite=overwrite)
    first = EpisodeReader(sources[0]) if sources else None
    if first is not None and store is None and first.stored == "none":
        store = first.task.observation
    if store == "none":
        raise InvalidEpisodeFile(
            "a Minari dataset has observations; the compact form is a file, see `compact`"
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
            attributes={"metadata": json.dumps(asdict(metadata))},
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
            _carry(states, data / "states.h5")
        size = sum(file.stat().st_size for file in data.iterdir()) + len(json.dumps(entries))
        entries["dataset_size"] = round(size / 1e6, 1)
        text = json.dumps(entries, sort_keys=True, separators=(",", ":"))
        (data / "metadata.json").write_text(text, encoding="utf-8")
    return folder


def dataset_files(data: Path) -> list[Path]:
    """The files in a dataset's `data` that are its own; whatever else lies there is none of it."""
    named = ("main_data.hdf5", "metadata.json", "states.h5", "collection.json")
    return [data / name for name in named if os.path.lexists(data / name)]


def loading_lines(dataset_id: str, root: str | os.PathLike[str] | None = None) -> list[str]:
    """Return the two lines that load a dataset, with Minari and as arrays.

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


def _carry(states: str | os.PathLike[str], target: Path) -> None:
    """Put a state file into a dataset: the same bytes on the disk once, where it lets us.

    A hard link and not a reference, so that a dataset that is moved or copied has its states with
    it; of a symbolic link, which hard links don't follow, its target. Files of ours are replaced,
    never changed.
    """
    try:
        os.link(os.path.realpath(states), target)
    except OSError:  # another disk, or one without links
        shutil.copyfile(states, target)


def merge_datasets(
    sources: Sequence[Any],
    dataset_id: str,
    out: str | os.PathLike[str] | None = None,
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> Path:
    """Put datasets of one task and split together into another, nothing encoded again.

    Minari's own `combine_datasets` makes JPEGs of pictures and forgets the evaluation split.

    Args:
        sources: datasets, or episode files, that share no episode.
        dataset_id: of the dataset to make.
        out: the root under which Minari would find it; None for Minari's own.
        count: told before each episode.
        overwrite: replace a dataset of this id.

    Returns:
        The dataset's folder.

    Raises:
        InvalidEpisodeFile: they don't go together.
        Occupied: there is a dataset of this id, and `overwrite` isn't asked for.
    """
    readers = [EpisodeReader(source) for source in sources]
    for name in ("split", "states"):
        asked = {_states_digest(one) if name == "states" else one.task.split for one in readers}
        if len(asked) > 1:
            raise InvalidEpisodeFile(
                f"datasets of one split and one state file can be merged; these differ in {name}:"
                f" {', '.join(str(one.path) for one in readers)}"
            )
    said = [metadata for source in sources if (metadata := metadata_of(source))]
    first, task = readers[0], None
    carried = None if ships(first.task.states) else first.states_path()
    if carried is not None:
        task = replace(first.task, states=dataset_id)
    same: dict[str, Any] = {}
    for name in ("code_permalink", "ref_min_score", "ref_max_score", "num_episodes_average_score"):
        values = {getattr(one, name) for one in said}
        same[name] = values.pop() if len(values) == 1 and len(said) == len(sources) else None
    policies = [one.algorithm_name for one in said] or [str(first.labels(0)["policy"])]
    metadata = MinariMetadata(
        dataset_id=dataset_id,
        algorithm_name=", ".join(dict.fromkeys(policies)),
        description="\n\n".join(
            [
                f"Merged of {', '.join(one.dataset_id for one in said) or 'episode files'}.",
                *(f"{one.dataset_id}: {one.description}" for one in said),
            ]
        ),
        author=tuple({name for one in said for name in one.author}),
        author_email=tuple({name for one in said for name in one.author_email}),
        eval_split=said[0].eval_split if said else "test",
        digests={one.dataset_id: one.digests for one in said if one.digests},
        **same,
    )
    for reader in readers:
        reader.close()
    return publish(
        sources,
        metadata,
        out,
        concatenate=True,
        distinct=True,
        states=carried,
        task=task,
        count=count,
        overwrite=overwrite,
    )


def _states_digest(reader: EpisodeReader) -> str:
    if ships(reader.task.states):
        return str(reader.task.states or "readable")
    path = reader.states_path()
    if not path.is_file():
        raise InvalidEpisodeFile(f"{reader.path} was reset from {path}, which isn't there")
    return sha256(path)


def compact(
    source: Any,
    target: str | os.PathLike[str],
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> None:
    """Write the compact form of a dataset: episodes and metadata without observations, one file.

    `publish([target], metadata_of(target))` makes the dataset again. `count` is told before each
    episode.
    """
    require_output(target, folder=False, overwrite=overwrite)
    metadata = metadata_of(source)
    with atomic_write(target, overwrite=overwrite) as temporary:
        merge_episodes(
            [source],
            temporary,
            store="none",
            attributes={} if metadata is None else {"metadata": json.dumps(asdict(metadata))},
            count=count,
        )


def metadata_of(source: Any) -> MinariMetadata | None:
    """The metadata of a dataset, or of the one that a compact file came from.

    None of an episode file that never was one.
    """
    reader = EpisodeReader(source)
    entries = reader.metadata()
    reader.close()
    with foreign_bytes_as(InvalidEpisodeFile, f"{reader.path}, its metadata"):
        return None if entries is None else MinariMetadata(**entries)


def minari_entries(metadata: MinariMetadata, task: TaskConfig) -> dict[str, Any]:
    """The entries of Minari's metadata.json, less the counts."""
    # here, for they take seconds to import, and reading a dataset needs neither
    import minari
    from minari.serialization import serialize_space

    from knotgym.env import action_space

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
        "action_space": serialize_space(action_space()),
        "env_spec": environment_spec(task).to_json(),
        "eval_env_spec": environment_spec(_evaluated(task, metadata.eval_split)).to_json(),
    }


def _evaluated(task: TaskConfig, split: str) -> TaskConfig:
    """The environment to evaluate in: of another split all goals, however few were trained on."""
    if task.split in CODE_SPLITS and split in SPLITS:
        split += "-code"
    return replace(task, split=split, max_goals=task.max_goals if split == task.split else None)


@lru_cache(maxsize=16)
def _bounds(task: TaskConfig) -> str:
    """The space of a task's observations as Minari's reader wants it, a number a pixel.

    Without it that reader would make the environment, and need knotgym to read a file.
    """
    from minari.serialization import serialize_space

    from knotgym.env import observation_space

    bounds = serialize_space(observation_space(task), to_string=False)
    return json.dumps(bounds, separators=(",", ":"))


def environment_spec(task: TaskConfig) -> gymnasium.envs.registration.EnvSpec:
    """The registered environment, every setting spelled out: a later default changes nothing."""
    spec = copy.deepcopy(gymnasium.spec(f"knotgym/{task.task.capitalize()}-v0"))
    spec.kwargs = as_json(task)
    return spec
