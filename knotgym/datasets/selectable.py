"""Datasets of the three kinds as rows: columns to select by, keys to split by, and a way to write.

A state, an episode and a picture are one row each. `subsets` works on any of them; what differs is
here, one class a kind.
"""

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import atomic_write, require_apart, require_output, sha256
from knotgym.common.errors import InvalidInput, one_line
from knotgym.datasets.episode_dataset import FILE, EpisodeDataset, open_episodes, write_episodes
from knotgym.datasets.episodes import Episodes, gauss_codes
from knotgym.datasets.finished_folders import finish_images, finish_states
from knotgym.datasets.image_table import (
    COLUMNS,
    arrow,
    points_of,
    read_table,
    shards,
    write_shards,
    write_table,
)
from knotgym.datasets.located import resolve_dataset
from knotgym.datasets.manifest_check import read_manifest
from knotgym.datasets.minari_form import MinariMetadata, metadata_of, publish
from knotgym.states.near_duplicates import families
from knotgym.states.split_names import CODE_SPLITS, STATE_SPLITS
from knotgym.states.splits import IMAGE_SPLITS
from knotgym.states.state_file import (
    States,
    minari_root,
    read_states,
    ships,
    states_at,
    write_states,
)

Rows = NDArray[np.int64]
Selections = list[dict[str, Any]]
_REST = ("format", "format_version", "machines", "report", "summary", "splits", "files")


class Destination(NamedTuple):
    """Where a selection is written: a file or folder, or for `dataset_id` a root of Minari's."""

    out: str | Path | None = None
    dataset_id: str = ""
    overwrite: bool = False


class Selectable(Protocol):
    """A dataset to select from.

    Attributes:
        path: of the file or folder.
        columns: name -> one value per row.
        ids: int64 (n,), how `delete` names the rows.
        splits: name -> bool (n,), the rows of each split.
    """

    path: Path

    @property
    def columns(self) -> dict[str, NDArray[Any]]: ...
    @property
    def ids(self) -> Rows: ...
    @property
    def splits(self) -> dict[str, NDArray[np.bool_]]: ...
    def keys(self) -> list[list[Hashable]]:
        """Return for each row what it shares with rows that must stay in the same part."""

    def digested(self) -> Path:
        """Return the file whose checksum identifies the source."""

    def earlier(self) -> Selections:
        """Return the selections by which the source itself was made."""

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        """Write rows to a new file or folder."""


class _States:
    def __init__(self, path: Path) -> None:
        self.path, self.states = path, read_states(states_at(path))

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        flat = {name: values for name, values in self.states.table.items() if values.ndim == 1}
        return {"row": self.ids} | {name.replace("/", "."): flat[name] for name in flat}

    @property
    def ids(self) -> Rows:
        return np.arange(len(self.states))

    @property
    def splits(self) -> dict[str, NDArray[np.bool_]]:
        found = {name: np.asarray(self.states.split == name) for name in STATE_SPLITS}
        every = sorted(set(self.states.nx.tolist()))
        for name in CODE_SPLITS:
            rows = [self.states.rows(nx, name) for nx in every]
            found[name] = np.isin(self.ids, np.concatenate([*rows, np.zeros(0, np.int64)]))
        return found

    def keys(self) -> list[list[Hashable]]:
        source, near = self.states.source, families(self.states.points).tolist()
        out: list[list[Hashable]] = [[("near", one)] for one in near]
        shared = [name for name in ("seed", "trajectory", "rope") if name in source]
        for row, keys in enumerate(out):
            keys += [(name, np.asarray(source[name][row]).tobytes()) for name in shared]
        return out

    def digested(self) -> Path:
        return states_at(self.path)

    def earlier(self) -> Selections:
        return _selections(self.states.attributes.get("selection"))

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        states = self.states.taken(rows).replaced({}, selection=made)
        if not self.path.is_dir():
            write_states(path, states)
            return
        manifest = _manifest(self.path)
        path.mkdir()
        kept: list[tuple[EpisodeDataset, Episodes]] = []
        for file in sorted((self.path / "minari").glob(f"**/data/{FILE}")):
            dataset = open_episodes(file)
            episodes, states = _of_states(dataset, rows, len(self.states), states)
            kept += [(dataset, episodes)] if episodes.episodes.rows else []
        write_states(path / "states.h5", states)
        for dataset, episodes in kept:
            target = Destination(path / "minari", dataset.name)
            _publish(dataset, episodes, made, path / "states.h5", target)
        finish_states(path, states, manifest["report"], *_made(manifest, made))


class _Pictures:
    def __init__(self, path: Path) -> None:
        self.path = path
        flat = [
            name for name, kind in COLUMNS.items() if name != "image" and not isinstance(kind, list)
        ]
        self.table = read_table(path, columns=[*flat, "points"])

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        out: dict[str, NDArray[Any]] = {}
        for name in self.table.column_names:
            values, kind = self.table[name].combine_chunks(), COLUMNS[name]
            if isinstance(kind, dict):
                plain = [inner for inner, of in kind.items() if isinstance(of, str)]
                out |= {f"{name}.{one}": np.array(values.field(one).to_pylist()) for one in plain}
            elif isinstance(kind, str):
                out[name] = np.array(values.to_pylist())
        return out

    @property
    def ids(self) -> Rows:
        return self.columns["source.row"]

    @property
    def splits(self) -> dict[str, NDArray[np.bool_]]:
        return {name: np.asarray(self.columns["split"] == name) for name in IMAGE_SPLITS}

    def keys(self) -> list[list[Hashable]]:
        near = families(points_of(self.table)).tolist()
        ropes = zip(self.columns["source.seed"], self.columns["source.rope"], strict=True)
        return [[("near", one), ("rope", *rope)] for one, rope in zip(near, ropes, strict=True)]

    def digested(self) -> Path:
        manifest = self.path / "manifest.json"
        return manifest if manifest.is_file() else shards(self.path)[0]

    def earlier(self) -> Selections:
        if self.path.is_dir():
            return _selections(read_manifest(self.path)[0].get("selection"))
        return _selections((self.table.schema.metadata or {}).get(b"selection", b"[]").decode())

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        kept = np.zeros(len(self.ids), dtype=bool)
        kept[rows] = True
        if not self.path.is_dir():
            table = read_table(self.path).filter(arrow().array(kept))
            metadata = {**table.schema.metadata, b"selection": json.dumps(made, sort_keys=True)}
            write_table(path, table.replace_schema_metadata(metadata))
            return
        manifest, files = _manifest(self.path), shards(self.path)
        ends = np.cumsum([len(read_table(one, columns=["nx"])) for one in files])[:-1]
        chosen = dict(zip(files, np.split(kept, ends), strict=True))
        written = write_shards(path, chosen)
        finish_images(path, written, manifest["report"], *_made(manifest, made))


class _Episodes:
    def __init__(self, path: Path) -> None:
        self.path, self.dataset = path, open_episodes(path)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        (own, steps), task = self.dataset.episodes, self.dataset.task
        found = {name: values for name, values in own.items() if values.ndim == 1}
        found = {"episode": self.ids, **found, "goal_gauss_code": gauss_codes(own["goal_visits"])}
        if "visits" in steps:
            first, last = self.dataset.episodes.offsets[:-1], self.dataset.episodes.last()
            found |= {
                "terminated": steps["terminated"][last - 1],
                "truncated": steps["truncated"][last - 1],
                "start_gauss_code": gauss_codes(steps["visits"][first]),
                "final_gauss_code": gauss_codes(steps["visits"][last]),
            }
        texts = {"task": task.task, "split": task.split}
        return found | {name: np.full(own.rows, text) for name, text in texts.items()}

    @property
    def ids(self) -> Rows:
        return np.arange(self.dataset.episodes.episodes.rows)

    @property
    def splits(self) -> dict[str, NDArray[np.bool_]]:
        return {self.dataset.task.split: np.ones(len(self.ids), dtype=bool)}

    def keys(self) -> list[list[Hashable]]:
        (own, steps), task = self.dataset.episodes, self.dataset.task
        first = self.dataset.episodes.offsets[:-1]
        out: list[list[Hashable]] = []
        for row in range(own.rows):
            start = own["start_qpos"][row].tobytes()
            pull = steps["bead"][first[row]].tobytes() + steps["force"][first[row]].tobytes()
            keys: list[Hashable] = [("walk", start, pull)]  # cuts of one episode begin alike
            # states without crossings are shared by nearly all episodes
            if task.start_nx:
                keys.append(("state", int(own["start"][row])))
            if own["goal_visits"][row].any():
                goal, shown = int(own["goal"][row]), own["goal_visits"][row].tobytes()
                keys.append(("state", goal) if goal >= 0 else ("goal", shown))
            out.append(keys)
        return out

    def digested(self) -> Path:
        return self.dataset.path

    def earlier(self) -> Selections:
        return _selections(self.dataset.attributes.get("selection"))

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        facts = {**self.dataset.facts, "selection": made}
        write_episodes(path, [self.dataset.episodes.select(rows)], self.dataset.task, facts)

    def publish(self, rows: Rows, made: Selections, target: Destination) -> Path:
        """Write rows as a Minari dataset, with the states that it resets from."""
        own = None if ships(self.dataset.task.states) else self.dataset.states_path()
        return _publish(self.dataset, self.dataset.episodes.select(rows), made, own, target)


def opened(source: str | Path) -> Selectable:
    """Open a dataset by its path, name or id.

    Raises:
        MissingFile, InvalidInput: as in `resolve_dataset`.
    """
    kind, path = resolve_dataset(str(source))
    kinds: dict[str, Callable[[Path], Selectable]]
    kinds = {"states": _States, "images": _Pictures, "episodes": _Episodes}
    return kinds[kind](path)


def require_target(given: Selectable, target: Destination) -> None:
    """Refuse an output that exists, or that isn't one for this kind of dataset."""
    episodes = isinstance(given, _Episodes)
    if target.dataset_id and not episodes:
        raise InvalidInput("an id is for episodes; give --out for states and pictures")
    if target.dataset_id:
        require_apart(Path(target.out or minari_root()) / target.dataset_id, [given.path])
    else:
        if target.out is None:
            raise InvalidInput("give an output, --out, or for episodes --id for a Minari dataset")
        require_apart(target.out, [given.path])
        folder = given.path.is_dir() and not episodes
        require_output(target.out, folder=folder, overwrite=target.overwrite)


def write_rows(
    given: Selectable, source: str, rows: Rows, how: Mapping[str, Any], target: Destination
) -> Path:
    """Write some rows, at least one, as a new dataset; return its path."""
    if not len(rows):
        raise InvalidInput(f"none of the {len(given.ids)} rows of {source} is left")
    require_target(given, target)
    made = {
        "from": source,
        "sha256": sha256(given.digested()),
        "rows": len(given.ids),
        "kept": len(rows),
        **how,
        "knotgym": knotgym.__version__,
    }
    every = [*given.earlier(), made]
    if isinstance(given, _Episodes) and target.dataset_id:
        return given.publish(rows, every, target)
    assert target.out is not None
    with atomic_write(target.out, overwrite=target.overwrite) as path:
        try:
            given.write(rows, every, path)
        except (LookupError, TypeError, AttributeError) as error:
            raise InvalidInput(
                f"{source} has a manifest that knotgym didn't write: {one_line(error)}"
            ) from error
    return Path(target.out)


def selection_sentence(made: Mapping[str, Any]) -> str:
    """Say in a card how a dataset was selected."""
    facts = ("from", "rows", "kept", "sha256", "knotgym")
    how = {name: value for name, value in made.items() if name not in facts}
    return (
        f"{made['kept']} of the {made['rows']} rows of {Path(made['from']).name}"
        f" (SHA-256 {made['sha256']}), selected by {json.dumps(how, sort_keys=True)}."
    )


def _with_selection(text: str, made: Sequence[Mapping[str, Any]]) -> str:
    lines = "\n".join(f"{number}. {selection_sentence(one)}" for number, one in enumerate(made, 1))
    says = "Counts of the run that made the data are those of the first source."
    return f"{text.rstrip()}\n\n## Selection\n\n{says}\n\n{lines}\n"


def _manifest(folder: Path) -> dict[str, Any]:
    manifest, faults = read_manifest(folder)
    if faults:
        raise InvalidInput(f"{folder}: {faults[0]}")
    return manifest


def _made(
    manifest: Mapping[str, Any], selections: Selections
) -> tuple[dict[str, Any], Any, Callable[[str], str]]:
    """Return a selection's request, its machines, and a function that adds it to a card."""
    request = {name: value for name, value in manifest.items() if name not in _REST}
    added = partial(_with_selection, made=selections)
    return {**request, "selection": selections}, manifest.get("machines"), added


def _of_states(
    dataset: EpisodeDataset, rows: Rows, count: int, states: States
) -> tuple[Episodes, States]:
    """Return the episodes whose goals are among some of `count` states, and these states.

    Both name each other by their new numbers.
    """
    new = np.full(count, -1)
    new[rows] = np.arange(len(rows))
    own, columns = dataset.episodes.episodes, {}
    kept = np.ones(own.rows, dtype=bool)
    for name, nx in (("start", dataset.task.start_nx), ("goal", dataset.task.goal_nx)):
        # plain loops come from the set that ships where the file has none
        if nx or name == "goal":
            known = (own[name] >= 0) & (own[name] < count)
            columns[name] = np.where(known, new[np.where(known, own[name], 0)], -1)
            kept &= columns[name] >= 0
    renumbered = dataset.episodes._replace(episodes=own.replaced(**columns)).select(kept)
    if "source/trajectory" in states.table:
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
        mine, old = states.source["dataset"] == dataset.name, states.source["trajectory"]
        led = np.where(mine & (old >= 0) & (old < own.rows), old, own.rows)
        changed = np.where(mine, number[led], old).astype(old.dtype)
        states = states.replaced({"source/trajectory": changed})
    return renumbered, states


def _publish(
    source: EpisodeDataset,
    episodes: Episodes,
    made: Selections,
    states: Path | None,
    target: Destination,
) -> Path:
    """Publish episodes as a Minari dataset, with the metadata of their source."""
    metadata = metadata_of(source) or MinariMetadata(
        dataset_id=target.dataset_id,
        algorithm_name=", ".join(sorted(set(episodes.episodes["policy"].tolist()))),
        description="",
    )
    sentences = filter(None, [metadata.description, selection_sentence(made[-1])])
    metadata = replace(metadata, dataset_id=target.dataset_id, description="\n\n".join(sentences))
    return publish(
        [episodes],
        source.task,
        metadata,
        target.out,
        states=states,
        facts={**source.facts, "selection": made},
        overwrite=target.overwrite,
    )


def _selections(found: Any) -> Selections:
    """Return selections as a list; they may be stored as JSON."""
    if isinstance(found, str):
        found = json.loads(found)
    return found if isinstance(found, list) else []
