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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym import common, envs  # OpenCV on first use
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
from knotgym.datasets.episodes import Episodes, gauss_codes
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
        """Yield how Minari's form of a dataset differs from its columns."""
        return minari_faults(dataset)


class Statistics:
    """What to normalize arrays by, name by name; blocks of rows are added one by one."""

    def __init__(self) -> None:
        self._blocks = defaultdict[str, list[tuple[Any, ...]]](list)

    def add(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add rows (n, ...) of each array."""
        for name, rows in arrays.items():
            values = rows.astype(np.float64)
            sums = values.sum(0), (values**2).sum(0)
            self._blocks[name].append((len(rows), *sums, values.min(0), values.max(0)))

    def found(self) -> dict[str, dict[str, NDArray[np.float32]]]:
        """Return "mean", "std", "min" and "max" of each number of an array's rows, float32 (...).

        A number that never changes has std 1, so that one can divide by it.
        """
        summaries = {}
        for name, blocks in self._blocks.items():
            counts, total, squares, low, high = zip(*blocks, strict=True)
            mean = sum(total) / sum(counts)
            std = np.sqrt(np.maximum(sum(squares) / sum(counts) - mean**2, 0))
            both = {"mean": mean, "std": np.where(std > 1e-6, std, 1)}
            both |= {"min": np.min(low, axis=0), "max": np.max(high, axis=0)}
            summaries[name] = {what: np.asarray(value, np.float32) for what, value in both.items()}
        return summaries


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
        write_episodes(data / FILE, parts, task, extra)
        wanted = form == "minari" or (not form and pulls <= MINARI_STEPS)
        if wanted and not parts[0].is_recording:
            write_minari(open_episodes(data / FILE))
    return folder


def copy_file(source: Path, target: Path) -> None:
    """Copy the bytes of a regular file; raise OSError for a link or anything else."""
    with open(os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(source))
        with open(target, "wb") as copy:
            shutil.copyfileobj(file, copy)


def write_minari(dataset: EpisodeDataset) -> None:
    """Write Minari's two files beside the dataset's own file.

    Raises:
        InvalidFile: the dataset has no metadata.
    """
    data, statistics = dataset.path.parent, Statistics()
    with new_hdf5(data / MAIN, libver=("v110", "v110"), meta_block_size=_METADATA_BYTES) as file:
        told = Counts.over(_contents(dataset), "writing Minari's form", len(dataset))
        for k, (attributes, arrays) in enumerate(told):
            episode = file.create_group(f"episode_{k}")
            episode.attrs.update(sorted(attributes.items()))
            for path, array in arrays.items():
                stored = _stored(array)
                episode.create_dataset(path, data=stored, **_packing(stored))
            statistics.add(_numbers(arrays))
    entries = {**_minari_entries(dataset), "statistics": _listed(statistics)}
    size = sum(file.stat().st_size for file in data.iterdir()) + len(json.dumps(entries))
    entries["dataset_size"] = round(size / 1e6, 1)
    entries[_SEALED] = _seals(dataset, entries)
    text = json.dumps(entries, sort_keys=True, separators=(",", ":"))
    (data / METADATA).write_text(text, encoding="utf-8")


def _numbers(arrays: Arrays) -> Arrays:
    """Return the observations and actions of an episode that can be normalized, a row a pull."""
    count = len(arrays["actions"])
    return {
        name: values[:count]
        for name, values in arrays.items()
        if name.startswith(("observations", "actions")) and values.dtype.kind == "f"
    }


def _listed(statistics: Statistics) -> dict[str, dict[str, list[float]]]:
    """Return statistics with the digits that tell one float32 from another, as JSON has them."""
    return {
        name: {what: [float(str(value)) for value in values] for what, values in of_name.items()}
        for name, of_name in statistics.found().items()
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
        statistics = Statistics()
        with h5py.File(main, locking=False) as file:
            if len(file) != len(dataset):
                yield f"{main}: it has {len(file)} episodes"
            told = Counts.over(some.numbers.tolist(), "comparing Minari's form")
            for k, (attributes, arrays) in zip(told, _contents(some), strict=True):
                statistics.add(_numbers(arrays))
                for fault in _different(file[f"episode_{k}"], attributes, arrays):
                    yield f"{main}: episode_{k}{fault}"
        if some is dataset and not _same_json(entries.get("statistics"), _listed(statistics)):
            yield f"{described}: statistics isn't what follows from the episodes"
        if sealed is not None and sealed != _seals(dataset, entries):
            yield f"{data}: Minari's form isn't the one that was written with the episodes"
    except Exception as error:  # there is no end to what foreign bytes make h5py raise
        yield f"{data}: Minari's form can't be read: {one_line(error)}"


def _seals(dataset: EpisodeDataset, entries: Mapping[str, Any]) -> dict[str, str]:
    """Return digests of the columns, of their file's attributes and of Minari's two files."""
    unsealed = {name: value for name, value in entries.items() if name != _SEALED}
    text = json.dumps(unsealed, sort_keys=True).encode()
    columns = {name: str(dataset.attributes.get(name)) for name in ("digest", "expansion")}
    main = common.sha256(dataset.path.with_name(MAIN))
    return {**columns, MAIN: main, METADATA: hashlib.sha256(text).hexdigest()}


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
    if metadata is None:
        raise InvalidFile(f"{dataset.path} has no metadata of a Minari dataset")
    split = SPLITS[task.split].tested_on
    goals = task.max_goals if split == task.split else None  # in another split all
    spec, specs = copy.deepcopy(gymnasium.spec(f"knotgym/{task.tasks[0].capitalize()}-v0")), {}
    tested = replace(task, split=split, max_goals=goals)
    for name, played in {"env_spec": task, "eval_env_spec": tested}.items():
        spec.kwargs = common.as_json(played)  # every setting, so that later defaults don't matter
        specs[name] = spec.to_json()
    given = {n: value for n, value in asdict(metadata).items() if value not in (None, (), {})}
    here = [] if "+" in knotgym.__version__ else [f"knotgym>={knotgym.__version__}"]
    lengths = dataset.episodes.episodes["length"]
    space = envs.OBSERVATIONS[task.observation].space_of(task)
    # one bound a pixel: without them Minari would make the environment, and need knotgym for that
    bounds = json.dumps(serialize_space(space, to_string=False), separators=(",", ":"))
    return {
        **given,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "minari_version": minari.__version__,
        "requirements": [*here, "minari>=0.5.4"],
        "observation_space": bounds,
        "action_space": serialize_space(VIEWS[TaskConfig.action].space(task.beads)),
        **specs,
        "total_episodes": len(lengths),
        "total_steps": int(lengths.sum()),
    }


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
        arrays = {name: steps[column][pulls] for name, column in _OF_PULLS.items()}
        arrays |= {f"infos/{name}": values[states] for name, values in infos.items()}
        seen = dataset.select([k]).seen()
        parts = seen.items() if isinstance(seen, dict) else [("", seen)]
        arrays |= {f"observations/{name}".rstrip("/"): values for name, values in parts}
        yield attributes, arrays


def _different(episode: h5py.Group, attributes: Mapping[str, Any], arrays: Arrays) -> Iterator[str]:
    """Yield the arrays and attributes of an episode that aren't those of the columns."""
    items: dict[str, Any] = {}
    episode.visititems(items.__setitem__)
    stored = {path: item for path, item in items.items() if not isinstance(item, h5py.Group)}
    for path in sorted(stored.keys() ^ arrays.keys()):
        yield f"/{path} is {'missing' if path in arrays else 'not written by knotgym'}"
    said = {
        name: value.decode() if isinstance(value, bytes) else value
        for name, value in episode.attrs.items()
    }
    if said != attributes:
        yield ": its attributes aren't those of the columns"
    for path in sorted(stored.keys() & arrays.keys()):
        item, right = stored[path], _stored(arrays[path])
        # nothing outside the file is read, and nothing is unpickled
        here = isinstance(item, h5py.Dataset) and not (item.external or item.is_virtual)
        same = here and (item.dtype, item.shape) == (right.dtype, right.shape)
        if not same or item[()].tobytes() != right.tobytes():  # NaN is none's equal
            yield f"/{path} isn't that of the columns"


def _stored(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array as the file has it: text is encoded."""
    if array.dtype.kind != "U":
        return array
    texts = np.strings.encode(array, "utf-8")
    return texts.astype(h5py.string_dtype("utf-8", max(1, texts.dtype.itemsize)))


def _packing(array: NDArray[Any]) -> dict[str, Any]:
    """Return how an array is compressed, as keywords of h5py; {} if it is small."""
    if array.dtype == np.uint8:
        rows = max(1, min(array.shape[1], _STRIP_BYTES // array[0, 0].nbytes))
        chunks = (min(len(array), _STRIP_FRAMES), rows, *array.shape[2:])
        return {"chunks": chunks, "compression": "gzip", "compression_opts": 1}
    if array.nbytes < _PACKED_BYTES:
        return {}
    # with bytes of the same weight side by side, and goals that repeat, vertices halve
    options = {"chunks": array.shape, "shuffle": True}
    return {**options, "compression": "gzip", "compression_opts": 1}


def _same_json(there: Any, expected: Any) -> bool:
    """Whether two entries are equal; texts of JSON are compared as what they hold.

    A keyword that an older specification of an environment lacks has its default.
    """
    if all(isinstance(text, str) and text[:1] == "{" for text in (there, expected)):
        there, expected = json.loads(there), json.loads(expected)
        if "kwargs" in expected:
            usual = common.as_json(TaskConfig(task="tie"))
            there["kwargs"] = {**usual, **(there.get("kwargs") or {})}
    return bool(there == expected)
