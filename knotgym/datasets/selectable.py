"""Datasets of the three kinds as rows: columns to select by, keys to split by, and a way to write.

A state, an episode and a picture are one row each. What is written is a file of rows: a state file,
an episode file or a Parquet file.
"""

import json
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import InvalidFile, InvalidInput, atomic_write, require_output, sha256
from knotgym.datasets.episode_dataset import EpisodeDataset, open_episodes, write_episodes
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import (
    arrow,
    column_names,
    columns_among,
    parquet,
    points_of,
    read_table,
    shards,
)
from knotgym.datasets.located import locate, refuse_minaris_folder
from knotgym.rope import Array
from knotgym.states import families, read_states, resolve, write_states

Rows = NDArray[np.int64]
Selections = list[dict[str, Any]]


# Each kind has:
#   digested    the file whose checksum identifies the source
#   earlier     the selections by which the source itself was made
#   columns     name -> one value per row
#   count       number of rows
#   shared()    int64 (count, 2): what rows that must stay in one part have in common, -1 if nothing
#   write()     write rows to a new file


class StateRows:
    def __init__(self, path: Path) -> None:
        self.digested, self.states = path, read_states(path)
        self.earlier = _selections(self.states.attributes.get("selection", []), path)
        self.count = len(self.states)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        flat = {name: values for name, values in self.states.table.items() if values.ndim == 1}
        named = {name.replace("/", "."): values for name, values in flat.items()}
        return {"row": np.arange(self.count), **named}

    def shared(self) -> Rows:
        ropes = self.states.source.get("seed", np.arange(self.count)[:, None])
        return _families_and_ropes(self.states.points, ropes)

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        write_states(path, self.states.take(rows).replaced({}, selection=made))


class _PictureRows:
    def __init__(self, path: Path) -> None:
        self.path, self.digested = path, shards(path)[0]
        stored = column_names(self.digested)
        known = columns_among(stored)
        wanted = [name for name in known if name in stored and known[name] != "image"]
        self.table, self.count = (table := read_table(path, columns=wanted)), len(table)
        try:
            earlier = json.loads((table.schema.metadata or {}).get(b"selection", b"[]"))
        except ValueError as error:
            raise InvalidFile(f"{path}: its selection isn't JSON: {error}") from error
        self.earlier = _selections(earlier, path)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        flat = self.table.flatten()  # a struct becomes columns such as source.rope
        kinds = arrow("pyarrow.types")
        return {
            name: np.array(values.to_pylist())
            for name, values in zip(flat.column_names, flat.columns, strict=True)
            if not kinds.is_nested(values.type)
        }

    def shared(self) -> Rows:
        ropes = np.stack([self.columns["source.seed"], self.columns["source.rope"]], axis=1)
        return _families_and_ropes(points_of(self.table), ropes)

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        table = read_table(self.path).take(rows)
        metadata = {**(table.schema.metadata or {}), b"selection": json.dumps(made)}
        path.write_bytes(parquet(table.replace_schema_metadata(metadata)))


class EpisodeRows:
    def __init__(self, path: Path) -> None:
        self.dataset = open_episodes(path)
        self.digested = self.dataset.path
        self.earlier = _selections(self.dataset.attributes.get("selection", []), path)
        self.count = self.dataset.episodes.episodes.rows

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        (own, steps), task = self.dataset.episodes, self.dataset.task
        single, number = task.singles, _single_of(self.dataset)
        found = {
            "episode": np.arange(self.count),
            **{name: values for name, values in own.items() if values.ndim == 1},
            "goal_gauss_code": gauss_codes(own["goal_visits"]),
            "task": np.array([one.task for one in single])[number],
            "nx": np.array([one.nx for one in single])[number],
            "split": np.full(own.rows, task.split),
        }
        if "visits" in steps:
            first, last = self.dataset.episodes.offsets[:-1], self.dataset.episodes.last()
            found |= {
                "terminated": steps["terminated"][last - 1],
                "truncated": steps["truncated"][last - 1],
                "start_gauss_code": gauss_codes(steps["visits"][first]),
                "final_gauss_code": gauss_codes(steps["visits"][last]),
            }
        return found

    def shared(self) -> Rows:
        own, number = self.dataset.episodes.episodes, _single_of(self.dataset)
        tangled = np.array([one.start_nx > 0 for one in self.dataset.task.singles])[number]
        # states without crossings are shared by nearly all episodes
        starts = np.where(tangled, own["start"], -1)
        return np.stack([starts, np.where(own["goal_visits"].any(axis=1), own["goal"], -1)], axis=1)

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        facts = {**self.dataset.facts, "selection": made}
        write_episodes(path, [self.dataset.episodes.select(rows)], self.dataset.task, facts)


def _families_and_ropes(points: Array, ropes: Rows) -> Rows:
    """Number near-duplicates and, with other numbers, the ropes that rows are frames of."""
    rope = np.unique(ropes, axis=0, return_inverse=True)[1].ravel()
    return np.stack([families(points), len(points) + rope], axis=1)


Selectable = StateRows | _PictureRows | EpisodeRows


def opened(source: str | Path) -> Selectable:
    """Open a dataset by its path, name or id.

    Raises:
        MissingFile, InvalidInput, InvalidFile: as `locate`; or it is several datasets.
    """
    found = locate(str(source)).only()
    if found.pictures:
        return _PictureRows(found.pictures)
    return StateRows(found.states) if found.states else EpisodeRows(found.episodes[0])


def require_file(out: Path, sources: Iterable[Path], overwrite: bool) -> None:
    """Refuse an output that exists, is one of its sources, or lies in Minari's folder."""
    require_output(out, folder=False, overwrite=overwrite, reads=sources)
    refuse_minaris_folder(out)


def write_rows(
    given: Selectable,
    source: str,
    rows: Rows,
    how: Mapping[str, Any],
    out: Path,
    overwrite: bool = False,
) -> Path:
    """Write some rows, at least one, as a new file; return its path."""
    if not len(rows):
        raise InvalidInput(f"none of the {given.count} rows of {source} is left")
    require_file(out, [resolve(source)], overwrite)
    counts = {"sha256": sha256(given.digested), "rows": given.count, "kept": len(rows)}
    made = {"from": source, **counts, **how, "knotgym": knotgym.__version__}
    with atomic_write(out, overwrite=overwrite) as path:
        given.write(rows, [*given.earlier, made], path)
    return out


def _selections(found: Any, path: Path) -> Selections:
    """Return the selections that a file tells of, which may be a stranger's."""
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise InvalidFile(f"{path}: its selection should be a list of objects, got {found!r:.80}")
    return found


def _single_of(dataset: EpisodeDataset) -> NDArray[np.int64]:
    """Return which of `task.singles` each episode is of, by the crossings of its start and goal.

    A recording doesn't hold the start's crossings, so there the first with the goal's is returned.
    """
    own, steps = dataset.episodes
    goals = np.count_nonzero(own["goal_visits"], axis=1) // 2
    first = dataset.episodes.offsets[:-1]
    starts = steps["crossings"][first] if "crossings" in steps else np.full(len(first), -1)
    unlike = [2 * (goals != one.goal_nx) + (starts != one.start_nx) for one in dataset.task.singles]
    return np.argmin(unlike, axis=0)
