"""Minari's form of a dataset, written once from the columns of its episodes.

    main_data.hdf5      /episode_{k}    attributes: id, total_steps, seed, options/start,
                                        options/goal, policy, goal_gauss_code
        observations                    pixels, state, a group of both, symbols or marked vertices
        actions rewards terminations truncations
        infos/*                         one entry a state: codes, crossings, success, vertices, ...;
                                        bead, force and applied_share are of the pull that led there
    metadata.json       Minari's metadata, without JPEG encoding

The files are written here, because Minari would store pictures as JPEG and drop seeds and options
when datasets are combined. Pictures are rendered from the vertices. Our own readers use neither
file; `minari_faults` compares both with the columns.
"""

import copy
import errno
import hashlib
import json
import os
import re
import shutil
import stat
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5p, h5s, h5t
from numpy.typing import NDArray

import knotgym
from knotgym import (
    common,
    envs,  # OpenCV on first use
)
from knotgym.common import Counts, InvalidFile, InvalidInput, new_hdf5, one_line, require_output
from knotgym.datasets.episode_dataset import (
    FILE,
    MAIN,
    STATES_DIGEST,
    STATES_FILE,
    EpisodeDataset,
    open_episodes,
    write_episodes,
)
from knotgym.datasets.episodes import Episodes, Statistics, gauss_codes
from knotgym.envs import TaskConfig
from knotgym.rope import VIEWS
from knotgym.states import SPLITS, minari_root

Arrays = dict[str, NDArray[Any]]
MINARI_STEPS = 100_000  # larger datasets are published without Minari's form by default
METADATA = "metadata.json"
_OF_PULLS = {  # arrays of pulls -> columns
    **{"actions": "action", "rewards": "reward"},
    **{"terminations": "terminated", "truncations": "truncated"},
}
_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")
_SEALED, _COMPARED = "knotgym_digests", 8  # entry of metadata.json; episodes that are compared
_COUNTED = ("dataset_size", "minari_version", "requirements")  # of the machine that wrote them
# A chunk of pictures is a strip: a few pixel rows of eight consecutive frames, which differ little.
# In a strip the same rows of the previous frame lie within gzip's window of 32 kB.
_STRIP_FRAMES, _STRIP_BYTES = 8, 12288
_PACKED_BYTES = 4096  # smaller arrays aren't compressed
_METADATA_BYTES = 1 << 16  # of the file that headers are gathered in, so that writes are few


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
        digests: digests of the policy, states, code and rope that generated it; after a merge,
            dataset id -> its digests.

    Raises:
        InvalidInput: the id is invalid for Minari.
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
    digests: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if _ID.fullmatch(self.dataset_id) is None:
            raise InvalidInput(
                f"a dataset id has the form namespace/name-v0, got {self.dataset_id!r}"
            )
        for name in ("author", "author_email"):
            object.__setattr__(self, name, tuple(sorted(getattr(self, name))))

    @staticmethod
    def faults(dataset: EpisodeDataset) -> Iterator[str]:
        """Yield where Minari's files beside a dataset aren't what follows from its columns."""
        return minari_faults(dataset)


def publish(
    parts: Sequence[Episodes],
    task: TaskConfig,
    metadata: MinariMetadata,
    out: str | os.PathLike[str] | None = None,
    *,
    states: str | os.PathLike[str] | None = None,
    facts: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    form: str = "",
) -> Path:
    """Write episodes as a Minari dataset; the folder appears when it is complete.

    It has Minari's own files too, unless it is a recording or `form` says otherwise.

    Args:
        parts: sets of episodes, which are appended.
        task: the environment. With `states` its state file is named by the dataset's id, so that it
            is found after the dataset is moved.
        metadata: the dataset's metadata.
        out: root folder of Minari datasets; None for Minari's own.
        states: a state file to include.
        facts: further attributes of the episode file: run, selection.
        form: "minari", "columns", or "", which is minari for up to MINARI_STEPS pulls.

    Returns:
        The dataset's folder.

    Raises:
        InvalidInput: the parts can't be combined.
        Occupied: there is a dataset of this id, and `overwrite` is false.
    """
    folder = Path(out or minari_root()) / metadata.dataset_id
    require_output(folder, folder=True, overwrite=overwrite, reads=[])  # callers know the sources
    if states is not None:
        task = replace(task, states=metadata.dataset_id)
    pulls = sum(int(part.episodes["length"].sum()) for part in parts)
    with common.atomic_write(folder, overwrite=overwrite) as temporary:
        data = temporary / "data"
        data.mkdir(parents=True)
        extra = {**(facts or {}), "metadata": asdict(metadata)}
        if states is not None:
            copy_file(Path(states), data / STATES_FILE)
            extra[STATES_DIGEST] = common.sha256(data / STATES_FILE)
        # what is stepped again is read once, so it needn't be mapped
        pack = all(part.is_recording for part in parts)
        write_episodes(data / FILE, parts, task, extra, pack=pack)
        wanted = form == "minari" or (not form and pulls <= MINARI_STEPS)
        if wanted and not any(part.is_recording for part in parts):
            write_minari(open_episodes(data / FILE), data)
    return folder


def require_file(
    out: Path,
    sources: Iterable[Path],
    overwrite: bool,
    *,
    folder: bool = False,
    pictures: bool = False,
) -> None:
    """Check that a plain file, or a folder of such, can be written.

    Args:
        out: its path.
        sources: what it is made from.
        overwrite: whether it may replace an older one.
        folder: whether it is a folder.
        pictures: whether it holds pictures, which are known by the suffix .parquet.

    Raises:
        InvalidInput: it is in Minari's folder, or has the suffix of another kind of file.
        Occupied: as of `require_output`.
    """
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise InvalidInput(
            f"{out} is in Minari's folder, where Minari can't read a plain file: merge with --id"
            " knotgym/name-v0, or give another --out"
        )
    if not folder and pictures != (out.suffix == ".parquet"):
        rule = "must end in .parquet, as files" if pictures else "must not end in .parquet, the end"
        raise InvalidInput(f"{out} {rule} of pictures")
    require_output(out, folder=folder, overwrite=overwrite, reads=sources)


def copy_file(source: Path, target: Path) -> None:
    """Copy the bytes of a regular file; raise OSError for a link or anything else."""
    with open(os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(source))
        with open(target, "wb") as copy:
            shutil.copyfileobj(file, copy)


def write_minari(dataset: EpisodeDataset, data: Path) -> None:
    """Write Minari's two files into the folder that holds the dataset's own files.

    Raises:
        InvalidFile: the dataset has no metadata.
    """
    statistics = _Statistics()
    with new_hdf5(data / MAIN, libver=("v110", "v110"), meta_block_size=_METADATA_BYTES) as file:
        rows = dataset.episodes.episodes.rows
        told = Counts.over(_contents(dataset), "writing Minari's form", rows)
        for k, (attributes, arrays) in enumerate(told):
            _write_group(file, f"episode_{k}", attributes, arrays)
            statistics.add(arrays)
    entries = {**_minari_entries(dataset), "statistics": statistics.found()}
    size = sum(file.stat().st_size for file in data.iterdir()) + len(json.dumps(entries))
    entries["dataset_size"] = round(size / 1e6, 1)
    entries[_SEALED] = _seals(dataset, data / MAIN, entries)
    text = json.dumps(entries, sort_keys=True, separators=(",", ":"))
    (data / METADATA).write_text(text, encoding="utf-8")


class _Statistics:
    """What to normalize by, of the arrays of episodes that are added."""

    def __init__(self) -> None:
        self._of = defaultdict[str, Statistics](Statistics)

    def add(self, arrays: Arrays) -> None:
        for name, values in arrays.items():
            if name.startswith(("observations", "actions")) and values.dtype.kind == "f":
                self._of[name].add(values[: len(arrays["actions"])])

    def found(self) -> dict[str, dict[str, list[float]]]:
        # the digits that tell one float32 from another
        return {
            name: {what: [float(str(one)) for one in own] for what, own in of.found().items()}
            for name, of in self._of.items()
        }


def minari_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield where Minari's files aren't those that `write_minari` wrote of these columns.

    Their digests are in metadata.json, bound to those of the columns; a sample of episodes is
    compared besides. Of files that an earlier version wrote, all are.
    """
    data = dataset.path.parent
    main, described = data / MAIN, data / METADATA
    if not main.exists() and not described.exists():
        return
    try:
        entries = common.read_json(described)
        expected, sealed = json.loads(json.dumps(_minari_entries(dataset))), entries.get(_SEALED)
        for name in sorted({**expected, **entries}.keys() - {*_COUNTED, "statistics", _SEALED}):
            if not _same_json(entries.get(name), expected.get(name)):
                yield f"{described}: {name} isn't what follows from the episodes"
        some = dataset.drawn(_COMPARED) if sealed is not None else dataset
        statistics = _Statistics()
        with h5py.File(main, locking=False) as file:
            if len(file) != dataset.episodes.episodes.rows:
                yield f"{main}: it has {len(file)} episodes"
            told = Counts.over(some.numbers.tolist(), "comparing Minari's form")
            for k, (attributes, arrays) in zip(told, _contents(some), strict=True):
                statistics.add(arrays)
                name = f"episode_{k}"
                for fault in _different(file, name, attributes, arrays):
                    yield f"{main}: {fault}"
        if some is dataset and not _same_json(entries.get("statistics"), statistics.found()):
            yield f"{described}: statistics isn't what follows from the episodes"
        if sealed is not None and sealed != _seals(dataset, main, entries):
            yield f"{data}: Minari's form isn't the one that was written with the episodes"
    except Exception as error:  # there is no end to what foreign bytes make h5py raise
        yield f"{data}: Minari's form can't be read: {one_line(error)}"


def _seals(dataset: EpisodeDataset, main: Path, entries: Mapping[str, Any]) -> dict[str, str]:
    """Return digests of the columns, of their file's attributes and of Minari's two files."""
    unsealed = {name: value for name, value in entries.items() if name != _SEALED}
    text = json.dumps(unsealed, sort_keys=True).encode()
    columns = {name: str(dataset.attributes.get(name)) for name in ("digest", "expansion")}
    return {**columns, MAIN: common.sha256(main), METADATA: hashlib.sha256(text).hexdigest()}


def metadata_of(dataset: EpisodeDataset) -> MinariMetadata | None:
    """Return a dataset's metadata; None for a file of episodes that has none.

    Raises:
        InvalidFile: it isn't as knotgym writes it.
    """
    if dataset.metadata is None:
        return None
    with InvalidFile.instead(f"{dataset.path} has invalid metadata", TypeError, ValueError):
        return MinariMetadata(**dataset.metadata)


def _minari_entries(dataset: EpisodeDataset) -> dict[str, Any]:
    """Return the entries of Minari's metadata.json except the size.

    Raises:
        InvalidFile: the dataset has no metadata.
    """
    # imported here, because importing them takes seconds and reading a dataset needs neither
    import minari
    from minari.serialization import serialize_space

    metadata, task = metadata_of(dataset), dataset.task
    split = SPLITS[task.split].tested_on
    goals = task.max_goals if split == task.split else None  # in another split all
    if metadata is None:
        raise InvalidFile(f"{dataset.path} has no metadata of a Minari dataset")
    given = {n: value for n, value in asdict(metadata).items() if value not in (None, (), {})}
    here = [] if "+" in knotgym.__version__ else [f"knotgym>={knotgym.__version__}"]
    lengths = dataset.episodes.episodes["length"]
    return {
        **given,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "minari_version": minari.__version__,
        "requirements": [*here, "minari>=0.5.4"],
        "observation_space": _bounds(replace(task, split="train", states=None)),
        "action_space": serialize_space(VIEWS[TaskConfig.action].space(task.beads)),
        "env_spec": _environment_spec(task).to_json(),
        "eval_env_spec": _environment_spec(replace(task, split=split, max_goals=goals)).to_json(),
        "total_episodes": len(lengths),
        "total_steps": int(lengths.sum()),
    }


def _environment_spec(task: TaskConfig) -> gymnasium.envs.registration.EnvSpec:
    """Return the environment's spec with every setting, so that later defaults don't matter."""
    spec = copy.deepcopy(gymnasium.spec(f"knotgym/{task.tasks[0].capitalize()}-v0"))
    spec.kwargs = common.as_json(task)
    return spec


def loading_lines(dataset_id: str, root: str | os.PathLike[str] | None = None) -> list[str]:
    """Return the lines of Python that load a dataset: with Minari, if it has that form, as arrays.

    >>> for line in loading_lines("knotgym/large-v0", "data"):
    ...     print(line)
    knotgym.loaders.arrays("data/knotgym/large-v0", observation="state")
    # Minari's own files: knotgym dataset export data/knotgym/large-v0 --to minari --out FOLDER
    """
    named = dataset_id if root is None else (Path(root) / dataset_id).as_posix()
    where = "" if root is None else f"  # with MINARI_DATASETS_PATH={Path(root).as_posix()}"
    ours = f'knotgym.loaders.arrays("{named}", observation="state")'
    if (Path(root or minari_root()) / dataset_id / "data" / METADATA).is_file():
        return [f'minari.load_dataset("{dataset_id}"){where}', ours]
    return [ours, f"# Minari's own files: knotgym dataset export {named} --to minari --out FOLDER"]


def data_files(data: Path) -> list[Path]:
    """List the files in a dataset's `data` folder that belong to it, ignoring any others."""
    named = (FILE, MAIN, METADATA, STATES_FILE)
    return [data / name for name in named if os.path.lexists(data / name)]


def _contents(dataset: EpisodeDataset) -> Iterator[tuple[dict[str, Any], Arrays]]:
    """Yield each episode's attributes and its arrays by path."""
    for k, (attributes, arrays) in enumerate(_minari_episodes(dataset)):
        yield attributes, arrays | _observations(dataset, k)


def _minari_episodes(dataset: EpisodeDataset) -> Iterator[tuple[dict[str, Any], Arrays]]:
    """Yield each episode's attributes and its arrays by path, except the observations."""
    (rows, steps), offsets = dataset.episodes, dataset.episodes.offsets
    failed = np.zeros(steps.rows, dtype=bool)
    failed[dataset.episodes.last()] = rows["diverged"]
    share = steps["applied_fraction"].astype(np.float64)
    applied = share[:, None] * steps["force"].astype(np.float64)
    applied *= dataset.task.rope_config.max_force

    def _led(values: NDArray[Any], at_first: float = 0) -> NDArray[Any]:
        """Move each pull's values to the state that it led to."""
        moved = np.roll(values, 1, axis=0)
        moved[offsets[:-1]] = at_first
        return moved

    goals = gauss_codes(rows["goal_visits"])
    infos = {
        "gauss_code": gauss_codes(steps["visits"]),
        "gauss_code_chiral": gauss_codes(steps["visits"], steps["signs"]),
        "goal_gauss_code": goals[dataset.episodes.episode_of()],
        "crossings": steps["crossings"].astype(np.int64),
        "is_success": dataset.episodes.goal_reached(dataset.task),
        "simulation_failed": failed,
        "points": steps["observation"],
        "bead": _led(steps["bead"].astype(np.int64), -1),
        "force": _led(applied),
        "applied_share": _led(share, 1),
    }
    infos |= {  # those that not every set has, which have no other place in Minari's form
        c.name.replace("/", "_"): steps[c.name] if c.of == "state" else _led(steps[c.name])
        for c in steps.schema.columns
        if c.optional
    }
    numbers = {"seed": rows["seed"], "options/start": rows["start"], "options/goal": rows["goal"]}
    for k in range(rows.rows):
        pulls, states = slice(offsets[k], offsets[k + 1] - 1), slice(offsets[k], offsets[k + 1])
        attributes: dict[str, Any] = {
            "id": int(dataset.numbers[k]),
            "total_steps": int(rows["length"][k]),
            "policy": str(rows["policy"][k]),
            "goal_gauss_code": str(goals[k]),
            **{name: int(column[k]) for name, column in numbers.items() if column[k] >= 0},
        }
        own_pulls = {name: steps[column][pulls] for name, column in _OF_PULLS.items()}
        yield attributes, own_pulls | {f"infos/{n}": array[states] for n, array in infos.items()}


def _observations(dataset: EpisodeDataset, k: int) -> Arrays:
    """Return an episode's observations by path."""
    shown = dataset.select([k]).seen()
    if not isinstance(shown, dict):
        return {"observations": shown}
    return {f"observations/{name}": array for name, array in shown.items()}


def _different(
    stored: h5py.File, name: str, attributes: Mapping[str, Any], arrays: Arrays
) -> Iterator[str]:
    """Yield the arrays and attributes of an episode that aren't those of the columns."""
    items: dict[str, Any] = {}
    stored[name].visititems(items.__setitem__)
    held = {path: one for path, one in items.items() if not isinstance(one, h5py.Group)}
    for path in sorted(held.keys() ^ arrays.keys()):
        yield f"{name}/{path} is {'missing' if path in arrays else 'not written by knotgym'}"
    said = dict(stored[name].attrs)
    said = {key: one.decode() if isinstance(one, bytes) else one for key, one in said.items()}
    if said != attributes:
        yield f"{name}: its attributes aren't those of the columns"
    for path in sorted(held.keys() & arrays.keys()):
        kept, right = held[path], _stored(arrays[path])
        # nothing outside the file is read, and nothing is unpickled
        here = isinstance(kept, h5py.Dataset)
        here = here and not (kept.external or kept.is_virtual)
        same = here and (kept.dtype, kept.shape) == (right.dtype, right.shape)
        if not same or kept[()].tobytes() != right.tobytes():  # NaN is none's equal
            yield f"{name}/{path} isn't that of the columns"


def _stored(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array as the file has it: text is encoded."""
    if array.dtype.kind != "U":
        return array
    texts = np.strings.encode(array, "utf-8")
    return texts.astype(h5py.string_dtype("utf-8", max(1, texts.dtype.itemsize)))


# An episode has some twenty arrays, most of them small. For each of them h5py's own classes repeat
# the same look-ups and checks, which take longer than writing.


def _write_group(file: h5py.File, name: str, attributes: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a group with attributes and arrays, whose paths have one slash at most."""
    whole = h5g.create(file.id, name.encode(), gcpl=_GROUP)
    for attribute, value in sorted(attributes.items()):
        text = np.array(value, _TEXT) if isinstance(value, str) else np.array(value)
        h5a.create(whole, attribute.encode(), _type(text.dtype), h5s.create(h5s.SCALAR)).write(text)
    groups = {"": whole}
    for path, array in arrays.items():
        folder, _, leaf = path.rpartition("/")
        if folder not in groups:
            groups[folder] = h5g.create(whole, folder.encode(), gcpl=_GROUP)
        _write_array(groups[folder], leaf.encode(), array)


def _write_array(group: h5g.GroupID, name: bytes, array: NDArray[Any]) -> None:
    array, made = _stored(array), _CONTIGUOUS
    if array.dtype == np.uint8:
        rows = max(1, min(array.shape[1], _STRIP_BYTES // array[0, 0].nbytes))
        made = _properties()
        made.set_chunk((min(len(array), _STRIP_FRAMES), rows, *array.shape[2:]))
        made.set_deflate(1)
    elif array.nbytes >= _PACKED_BYTES:
        # with bytes of the same weight side by side, and goals that repeat, vertices halve
        made = _properties()
        made.set_chunk(array.shape)
        made.set_shuffle()
        made.set_deflate(1)
    space = h5s.create_simple(array.shape)
    stored = h5d.create(group, name, _type(array.dtype), space, made)
    if array.size:
        stored.write(h5s.ALL, h5s.ALL, np.ascontiguousarray(array))


def _properties(kind: h5p.PropClassID = h5p.DATASET_CREATE) -> h5p.PropOCID:
    """Return properties of an object's making: no times, so that equal data have equal bytes."""
    made = h5p.create(kind)
    made.set_obj_track_times(False)
    return made


@lru_cache(maxsize=256)
def _type(dtype: np.dtype[Any]) -> h5t.TypeID:
    return h5t.py_create(dtype, logical=True)


_TEXT, _CONTIGUOUS = h5py.string_dtype("utf-8"), _properties()
_GROUP = _properties(h5p.GROUP_CREATE)


def _same_json(there: Any, expected: Any) -> bool:
    """Whether two entries are equal; texts of JSON are compared as what they hold.

    A keyword that an older specification of an environment lacks has its default.
    """
    if all(isinstance(one, str) and one[:1] == "{" for one in (there, expected)):
        there, expected = json.loads(there), json.loads(expected)
        if "kwargs" in expected:
            usual = common.as_json(TaskConfig(task="tie"))
            there["kwargs"] = {**usual, **(there.get("kwargs") or {})}
    return bool(there == expected)


@lru_cache(maxsize=16)
def _bounds(task: TaskConfig) -> str:
    """Return the JSON of a task's observation space, with Minari's one bound per pixel.

    Without this entry Minari would construct the environment, and need knotgym to read a file.
    """
    from minari.serialization import serialize_space

    space = envs.OBSERVATIONS[task.observation].space_of(task)
    bounds = serialize_space(space, to_string=False)
    return json.dumps(bounds, separators=(",", ":"))
