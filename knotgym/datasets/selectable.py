"""Datasets of the three kinds as rows: columns to select by, keys to split by, and a way to write.

A state, an episode and a picture are one row each. What is written is a file of rows: a state file,
an episode file or a Parquet file.
"""

import json
from collections.abc import Hashable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import atomic_write, require_apart, require_output, sha256
from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.datasets.episode_dataset import (
    open_episodes,
    single_of,
    write_episodes,
)
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import (
    COLUMNS,
    PHOTO_COLUMNS,
    arrow,
    parquet,
    points_of,
    read_table,
    shards,
)
from knotgym.datasets.located import locate_own, refuse_minaris_folder, root_of
from knotgym.states.near_duplicates import families
from knotgym.states.state_file import read_states, write_states

Rows = NDArray[np.int64]
Selections = list[dict[str, Any]]


# Each kind has:
#   digested    the file whose checksum identifies the source
#   earlier     the selections by which the source itself was made
#   columns     name -> one value per row
#   count       number of rows
#   keys()      for each row what it shares with rows that must stay in the same part
#   write()     write rows to a new file


class StateRows:
    def __init__(self, path: Path) -> None:
        self.digested, self.states = path, read_states(path)
        self.earlier = _selections(self.states.attributes.get("selection", []), path)
        self.count = len(self.states)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        flat = {name: values for name, values in self.states.table.items() if values.ndim == 1}
        return {"row": np.arange(self.count)} | {
            name.replace("/", "."): flat[name] for name in flat
        }

    def keys(self) -> list[list[Hashable]]:
        near, seed = families(self.states.points), self.states.source.get("seed")
        seeds = np.arange(self.count)[:, None] if seed is None else seed
        return [
            [("near", int(near[row])), ("rope", tuple(seeds[row].tolist()))]
            for row in range(len(near))
        ]

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        write_states(path, self.states.taken(rows).replaced({}, selection=made))


class _PictureRows:
    def __init__(self, path: Path) -> None:
        self.path, self.digested = path, shards(path)[0]
        stored = arrow("pyarrow.parquet").read_schema(self.digested).names
        flat = [
            name
            for name, kind in (COLUMNS | PHOTO_COLUMNS).items()
            if kind != "image" and not isinstance(kind, list) and name in (*COLUMNS, *stored)
        ]
        self.table = read_table(path, columns=[*flat, "points"])
        stored = (self.table.schema.metadata or {}).get(b"selection", b"[]")
        try:
            self.earlier = _selections(json.loads(stored), path)
        except ValueError as error:
            raise InvalidFile(f"{path}: its selection isn't JSON: {error}") from error
        self.count = len(self.table)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        out: dict[str, NDArray[Any]] = {}
        for name in self.table.column_names:
            values = self.table[name].combine_chunks()
            kind = (COLUMNS | PHOTO_COLUMNS)[name]
            if isinstance(kind, dict):
                plain = [inner for inner, of in kind.items() if isinstance(of, str)]
                out |= {f"{name}.{one}": np.array(values.field(one).to_pylist()) for one in plain}
            elif isinstance(kind, str):
                out[name] = np.array(values.to_pylist())
        return out

    def keys(self) -> list[list[Hashable]]:
        near = families(points_of(self.table)).tolist()
        ropes = zip(self.columns["source.seed"], self.columns["source.rope"], strict=True)
        return [[("near", one), ("rope", *rope)] for one, rope in zip(near, ropes, strict=True)]

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        kept = np.isin(np.arange(self.count), rows)
        table = read_table(self.path).filter(arrow().array(kept))
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
        found = {name: values for name, values in own.items() if values.ndim == 1}
        found = {
            "episode": np.arange(self.count),
            **found,
            "goal_gauss_code": gauss_codes(own["goal_visits"]),
        }
        if "visits" in steps:
            first, last = self.dataset.episodes.offsets[:-1], self.dataset.episodes.last()
            found |= {
                "terminated": steps["terminated"][last - 1],
                "truncated": steps["truncated"][last - 1],
                "start_gauss_code": gauss_codes(steps["visits"][first]),
                "final_gauss_code": gauss_codes(steps["visits"][last]),
            }
        single, number = task.singles, single_of(self.dataset)
        return found | {
            "task": np.array([one.task for one in single])[number],
            "nx": np.array([one.nx for one in single])[number],
            "split": np.full(own.rows, task.split),
        }

    def keys(self) -> list[list[Hashable]]:
        own, number = self.dataset.episodes.episodes, single_of(self.dataset)
        untying = np.array([one.start_nx > 0 for one in self.dataset.task.singles])[number]
        tied = np.asarray(own["goal_visits"].any(axis=1))
        # states without crossings are shared by nearly all episodes
        return [
            [row for row, crosses in ((start, tangled), (goal, tying)) if crosses]
            for start, tangled, goal, tying in zip(
                own["start"], untying, own["goal"], tied, strict=True
            )
        ]

    def write(self, rows: Rows, made: Selections, path: Path) -> None:
        facts = {**self.dataset.facts, "selection": made}
        write_episodes(path, [self.dataset.episodes.select(rows)], self.dataset.task, facts)


Selectable = StateRows | _PictureRows | EpisodeRows


def opened(source: str | Path) -> Selectable:
    """Open a dataset by its path, name or id.

    Raises:
        MissingFile, InvalidInput, InvalidFile: as `locate_own`; or it is several datasets.
    """
    found = locate_own(str(source)).only()
    if found.pictures:
        return _PictureRows(found.pictures)
    return StateRows(found.states) if found.states else EpisodeRows(found.episodes[0])


def require_file(out: Path, sources: Iterable[Path], overwrite: bool) -> None:
    """Refuse an output that exists, is one of its sources, or lies in Minari's folder."""
    require_output(out, folder=False, overwrite=overwrite)
    refuse_minaris_folder(out)
    require_apart(out, sources)


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
    require_file(out, [root_of(source)], overwrite)
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
