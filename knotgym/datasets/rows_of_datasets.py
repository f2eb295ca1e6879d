"""Datasets of the three kinds as rows with columns, for `subsets`: states, pictures, episodes."""

import hashlib
import json
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import require_output
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import Chosen, EpisodeReader
from knotgym.datasets.episode_writer import merge_episodes
from knotgym.datasets.finished_folders import finish_images, finish_states, write_used_walks
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
from knotgym.datasets.minari_dataset import MinariMetadata, metadata_of, publish
from knotgym.datasets.selectable_rows import (
    Destination,
    Rows,
    RowsOfDataset,
    json_list,
    selection_sentence,
    with_selection,
)
from knotgym.datasets.walks_file import read_walks
from knotgym.states.near_duplicates import families
from knotgym.states.split_names import CODE_SPLITS, STATE_SPLITS
from knotgym.states.splits import IMAGE_SPLITS
from knotgym.states.state_file import read_states, ships, states_at, write_states
from knotgym.topology.gauss import GaussCode

_REST = ("format", "format_version", "machines", "report", "summary", "splits", "files")


class _States(RowsOfDataset):
    splits = (*STATE_SPLITS, *CODE_SPLITS)

    def __init__(self, source: str | Path, path: Path) -> None:
        super().__init__(source, path)
        self.states = read_states(states_at(path))

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        flat = {name: values for name, values in self.states.table.items() if values.ndim == 1}
        return {"row": self.ids} | {name.replace("/", "."): flat[name] for name in flat}

    @property
    def ids(self) -> NDArray[np.int64]:
        return np.arange(len(self.states))

    def in_split(self, split: str) -> NDArray[np.bool_]:
        if split not in CODE_SPLITS:
            return super().in_split(split)
        of_nx = [self.states.rows(nx, split) for nx in sorted(set(self.states.nx.tolist()))]
        return np.isin(self.ids, np.concatenate(of_nx))

    def keys(self) -> list[list[Hashable]]:
        source, near = self.states.source, families(self.states.points).tolist()
        out: list[list[Hashable]] = [[("near", one)] for one in near]
        for row, keys in enumerate(out):
            if "seed" in source:
                keys.append(("seed", *source["seed"][row].tolist()))
            if {"dataset", "trajectory"} <= source.keys() and source["dataset"][row]:
                keys.append((str(source["dataset"][row]), int(source["trajectory"][row])))
        return out

    def digested(self) -> Path:
        return states_at(self.path)

    def earlier(self) -> list[dict[str, Any]]:
        earlier = self.states.attributes.get("selection", [])
        return super().earlier() or (earlier if isinstance(earlier, list) else [])

    def _write(self, rows: Rows, made: list[dict[str, Any]], path: Path) -> None:
        states = self.states.taken(rows).replaced({}, selection=made)
        if not self.path.is_dir():
            write_states(path, states)
            return
        manifest, faults = read_manifest(self.path)
        if faults:
            raise InvalidInput(f"{self.source}: {faults[0]}")
        path.mkdir()
        names = states.source.get("dataset", np.array([]))
        old = states.source.get("trajectory", np.array([]))
        if len(old):
            new = old.copy()
            for name in sorted(set(names.tolist()) - {""}):
                new[names == name] = np.arange((names == name).sum())
            states = states.replaced({"source/trajectory": new})
        write_states(path / "states.h5", states)
        for name in sorted(set(names.tolist()) - {""}):
            chosen = Chosen(self.path / "minari" / name, old[names == name].tolist())
            _publish(chosen, made, path / "states.h5", Destination(path / "minari", name))
        finish_states(path, states, manifest["report"], *_made(manifest, made))


class _Pictures(RowsOfDataset):
    splits = IMAGE_SPLITS

    def __init__(self, source: str | Path, path: Path) -> None:
        super().__init__(source, path)
        flat = [
            name for name, kind in COLUMNS.items() if name != "image" and not isinstance(kind, list)
        ]
        self.table = read_table(path, columns=[*flat, "points"])

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        out: dict[str, NDArray[Any]] = {}
        for name in self.table.column_names:
            values = self.table[name].combine_chunks()
            kind = COLUMNS[name]
            if isinstance(kind, dict):
                for inner, of in kind.items():
                    if isinstance(of, str):
                        out[f"{name}.{inner}"] = _array(values.field(inner))
            elif isinstance(kind, str):
                out[name] = _array(values)
        return out

    @property
    def ids(self) -> NDArray[np.int64]:
        return self.columns["source.row"]

    def keys(self) -> list[list[Hashable]]:
        near = families(points_of(self.table)).tolist()
        names = ("source.family", "source.walk")
        columns = [[(name, one) for one in self.columns[name].tolist()] for name in names]
        return [[("near", one), *shared] for one, *shared in zip(near, *columns, strict=True)]

    def earlier(self) -> list[dict[str, Any]]:
        metadata = self.table.schema.metadata or {}
        return super().earlier() or json_list(metadata.get(b"selection", b"[]").decode())

    def digested(self) -> Path:
        manifest = self.path / "manifest.json"
        return manifest if manifest.is_file() else shards(self.path)[0]

    def _write(self, rows: Rows, made: list[dict[str, Any]], path: Path) -> None:
        kept = np.zeros(self.count, dtype=bool)
        kept[rows] = True
        if not self.path.is_dir():
            table = read_table(self.path).filter(arrow().array(kept))
            metadata = {**table.schema.metadata, b"selection": json.dumps(made, sort_keys=True)}
            write_table(path, table.replace_schema_metadata(metadata))
            return
        manifest, faults = read_manifest(self.path)
        if faults:
            raise InvalidInput(f"{self.source}: {faults[0]}")
        files = shards(self.path)
        ends = np.cumsum([len(read_table(one, columns=["nx"])) for one in files])[:-1]
        chosen = dict(zip(files, np.split(kept, ends), strict=True))
        written = write_shards(path, chosen, int(manifest["config"]["rows_per_file"]))
        walks = read_walks(self.path / "walks.h5")
        write_used_walks(path, written, walks.state, [walks], walks.engine)
        finish_images(path, written, manifest["report"], *_made(manifest, made))


class _Episodes(RowsOfDataset):
    def __init__(self, source: str | Path, path: Path) -> None:
        super().__init__(source, path)
        self.reader = EpisodeReader(path)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        rows = [self._row(index) for index in range(len(self.reader))]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]} if rows else {}

    def _row(self, index: int) -> dict[str, Any]:
        reader = self.reader
        stored = reader.attributes(index)
        codes = reader.column(index, "gauss_code")
        goal = str(stored["goal_gauss_code"])
        return {
            "episode": reader.rows[index],
            "length": int(reader.lengths[index]),
            "success": bool(reader.column(index, "is_success").any()),
            "total_reward": float(reader.column(index, "rewards").sum()),
            "terminated": bool(reader.column(index, "terminations")[-1]),
            "truncated": bool(reader.column(index, "truncations")[-1]),
            "simulation_failed": bool(reader.column(index, "simulation_failed")[-1]),
            "policy": str(stored["policy"]),
            "goal_gauss_code": goal,
            "start_gauss_code": str(codes[0]),
            "final_gauss_code": str(codes[-1]),
            "nx": max(GaussCode.parse(goal).nx, GaussCode.parse(str(codes[0])).nx),
            "task": reader.task.task,
            "split": reader.task.split,
            "relabelled": bool(stored["relabelled"]),
            "seed": int(stored.get("seed", -1)),
            "start": int(stored.get("options/start", -1)),
            "goal": int(stored.get("options/goal", -1)),
        }

    @property
    def ids(self) -> NDArray[np.int64]:
        return np.array(self.reader.rows, dtype=np.int64)

    def in_split(self, split: str) -> NDArray[np.bool_]:
        own = self.reader.task.split
        if split != own:
            raise InvalidInput(f"the episodes of {self.source} are of split {own!r}")
        return np.ones(self.count, dtype=bool)

    def keys(self) -> list[list[Hashable]]:
        out: list[list[Hashable]] = []
        for index in range(self.count):
            start, actions, goal = (
                self.reader.column(index, name) for name in ("start_qpos", "actions", "goal_points")
            )
            # cuts of one episode begin alike
            keys: list[Hashable] = [("walk", start.tobytes(), actions[0].tobytes())]
            if self.columns["start_gauss_code"][index]:
                row = int(self.columns["start"][index])
                keys.append(("state", row) if row >= 0 else ("qpos", start.tobytes()))
            if self.columns["goal_gauss_code"][index]:
                row = int(self.columns["goal"][index])
                digest = hashlib.sha256(goal.tobytes()).digest()
                keys += [("state", row)] * (row >= 0) + [("points", digest)]
            out.append(keys)
        return out

    def digested(self) -> Path:
        return self.reader.path

    def earlier(self) -> list[dict[str, Any]]:
        return json_list(self.reader.file.attrs.get("selection", "[]"))

    def require_target(self, target: Destination) -> None:
        if not target.dataset_id:
            if target.out is None:
                raise InvalidInput("give an output: --out FILE, or --id for a Minari dataset")
            require_output(target.out, folder=False, overwrite=target.overwrite)

    def _placed(self, rows: Rows, made: list[dict[str, Any]], target: Destination) -> Path:
        if not target.dataset_id:
            return super()._placed(rows, made, target)
        own = None if ships(self.reader.task.states) else self.reader.states_path()
        return _publish(self._chosen(rows), made, own, target)

    def _chosen(self, rows: Rows) -> Chosen:
        return Chosen(self.reader.path, [self.reader.rows[row] for row in rows.tolist()])

    def _write(self, rows: Rows, made: list[dict[str, Any]], path: Path) -> None:
        entries = self.reader.metadata()
        attributes = {"selection": json.dumps(made, sort_keys=True)}
        if entries is not None:
            attributes["metadata"] = json.dumps(entries)
        merge_episodes([self._chosen(rows)], path, concatenate=True, attributes=attributes)


def opened(source: str | Path) -> RowsOfDataset:
    """Open a dataset by its path, name or id.

    Raises:
        MissingFile, InvalidInput: as in `resolve_dataset`.
    """
    kind, path = resolve_dataset(str(source))
    kinds: dict[str, Callable[[str | Path, Path], RowsOfDataset]]
    kinds = {"states": _States, "images": _Pictures, "episodes": _Episodes}
    return kinds[kind](source, path)


def _made(
    manifest: Mapping[str, Any], selections: list[dict[str, Any]]
) -> tuple[dict[str, Any], Any, Callable[[str], str]]:
    """Return a selection's request, its machines, and a function that adds it to a card."""
    request = {name: value for name, value in manifest.items() if name not in _REST}
    return (
        {**request, "selection": selections},
        manifest.get("machines"),
        partial(with_selection, made=selections),
    )


def _publish(
    chosen: Chosen, made: list[dict[str, Any]], states: Path | None, target: Destination
) -> Path:
    """Publish some episodes as a Minari dataset, with the metadata and states of their own."""
    metadata, reader = metadata_of(chosen.source), EpisodeReader(chosen)
    named = target.dataset_id
    task = None if states is None else replace(reader.task, states=named)
    if metadata is None:
        policy = str(reader.attributes(0)["policy"])
        metadata = MinariMetadata(dataset_id=named, algorithm_name=policy, description="")
    reader.close()
    description = "\n\n".join(filter(None, [metadata.description, selection_sentence(made[-1])]))
    metadata = replace(metadata, dataset_id=named, description=description)
    return publish(
        [chosen],
        metadata,
        target.out,
        concatenate=True,
        states=states,
        task=task,
        overwrite=target.overwrite,
        attributes={"selection": json.dumps(made, sort_keys=True)},
    )


def _array(values: Any) -> NDArray[Any]:
    return np.array(values.to_pylist())
