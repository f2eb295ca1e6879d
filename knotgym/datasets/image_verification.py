"""Check of a perception table: every label, measure and picture recomputed, every walk made again,
no leak between splits.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from rich.console import Console
from rich.table import Table

from knotgym.atomic_files import sha256
from knotgym.configuration import from_json
from knotgym.datasets.image_folder import WALKS_FORMAT, WALKS_VERSION, summary
from knotgym.datasets.image_rows import labels, measures
from knotgym.datasets.image_table import (
    GRADES,
    SPLITS,
    InvalidImages,
    arrow,
    encode,
    points_of,
    read_rows,
    read_table,
    shards,
)
from knotgym.datasets.label_limits import at_base, pressed_together, visits_too_close
from knotgym.datasets.near_duplicates import NEAR, distances
from knotgym.generate.images.walks import WALKS, retrace
from knotgym.relaxation import RelaxationConfig, relaxed
from knotgym.rendering.appearance import Appearance, render
from knotgym.rope import Array, Rope, RopeConfig
from knotgym.runs.executors import executor
from knotgym.topology.crossings import find_crossings
from knotgym.topology.reference_labeller import pyknotid_code
from knotgym.topology.symmetry import Symmetry


class _Trip(NamedTuple):
    """Some walks to be made again, and the rows that come from them: (where, place among the walks,
    source, points).
    """

    states: Array
    beads: np.ndarray
    forces: np.ndarray
    rows: list[tuple[str, int, dict[str, Any], Array]]
    relaxation: RelaxationConfig


def image_faults(path: str | Path, workers: int = 0) -> Iterator[str]:
    """Faults of a table: manifest and checksums first, then the rows, then the splits, then the
    walks.

    Args:
        path: a folder that `knotgym images` made, or a shard, of which only the rows can be
            checked.
        workers: processes, 0 for one a core.
    """
    folder, config = Path(path), None
    arrow()
    if folder.is_dir():
        try:
            manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
            listed, config = manifest["files"], manifest["config"]
        except (OSError, ValueError, KeyError) as error:
            yield f"manifest.json can't be read: {error}"
            listed = {}
        for name, digest in listed.items():
            if not (folder / name).is_file():
                yield f"{name} is missing"
            elif sha256(folder / name) != digest:
                yield f"{name} is not the file the manifest lists (SHA-256 differs)"
        if config is not None:
            yield from (
                f"{one.name} is not in the manifest"
                for one in shards(folder)
                if f"data/{one.name}" not in listed
            )
    with executor(workers) as pool:
        whole = True
        for found in pool.map(shard_faults, shards(path)):
            yield from found
            whole &= not any("Parquet shard" in fault or "format" in fault for fault in found)
        if whole:
            yield from _split_faults(
                read_table(path, columns=["gauss_code", "nx", "split", "points", "source"])
            )
            if folder.is_dir():
                trips, found = _trips(folder)
                yield from found
                for found in pool.map(_trip_faults, trips):
                    yield from found


def shard_faults(path: Path) -> list[str]:
    """Faults of the rows of a shard, each by itself."""
    try:
        return [
            f"{path.name} row {number}: {fault}"
            for number, row in enumerate(read_rows(path))
            for fault in row_faults(row)
        ]
    except InvalidImages as error:
        return [str(error)]


def row_faults(row: dict[str, Any]) -> Iterator[str]:
    """Faults of one row, as `read_rows` gives it."""
    points = np.array(row["points"], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        yield "coordinates are not finite"
        return
    found, look = (
        find_crossings(points),
        Appearance(
            **{**row["appearance"], **{name: tuple(row["appearance"][name]) for name in _RGB}}
        ),
    )
    right = {**labels(points, found, look), **measures(points, found, row["source"])}
    for name in ("gauss_code", "gauss_code_chiral", "nx", "knot", "crossings", "accepted", "grade"):
        if row[name] != right[name]:
            yield f"{name} is {row[name]!s}, recomputed {right[name]!s}"
    for name, value in right["quality"].items():
        if row["quality"][name] != value:
            yield f"quality.{name} is {row['quality'][name]!s}, recomputed {value!s}"
    second = pyknotid_code(points)
    if second != found.code:
        yield f"pyknotid reads {second.chiral} where ours is {found.code.chiral}"
    if row["split"] not in SPLITS or row["grade"] not in GRADES:
        yield f"split is {row['split']!r} and grade {row['grade']!r}"
    if (
        visits_too_close(found, len(points))
        or at_base(found, len(points))
        or pressed_together(right["quality"]["clearance"])
    ):
        yield (
            "the label is in doubt: crossings too close along the rope, at the base bead, or"
            " pressed together"
        )
    if row["image"] != encode(render(points, look)):
        yield "image is not the picture of points with this appearance"


def show_images(path: str, console: Console) -> None:
    """Print what a perception table holds."""
    facts, size = summary(path), sum(one.stat().st_size for one in shards(path))
    console.print(
        f"{path}: {facts['pictures']} pictures, {size / facts['pictures']:.0f} bytes each",
        highlight=False,
        soft_wrap=True,
    )
    for by in ("nx", "splits"):
        table = Table()
        for column in (by, "pictures", "codes", "chiral", "of a code", "accepted", *GRADES):
            table.add_column(column, justify="right")
        for name, one in facts[by].items():
            own = [
                one["pictures"],
                one["codes"],
                one["codes_with_chirality"],
                "/".join(map(str, one["of_a_code"])),
            ]
            table.add_row(name, *map(str, [*own, one["accepted"], *one["grade"].values()]))
        console.print(table)
    console.print(
        "chiral: codes with chirality; of a code: fewest/most pictures; accepted: as good as"
        " curated states",
        highlight=False,
    )
    for name, spread in facts["quality"].items():
        console.print(
            f"{name:24} 5 % {spread[0]:<9.3g} median {spread[1]:<9.3g} 95 % {spread[2]:.3g}",
            highlight=False,
        )
    console.print(
        f"sizes {facts['sizes']}, colours {facts['colours']}", highlight=False, markup=False
    )


_RGB = ("first", "last", "background")


def _split_faults(table: Any) -> Iterator[str]:
    """Near-duplicates and shared families between splits; codes and crossings where they don't
    belong.
    """
    split, codes, nx = (np.array(table[name].to_pylist()) for name in ("split", "gauss_code", "nx"))
    points, sources = points_of(table), table["source"].to_pylist()
    family, row = np.array([one["family"] for one in sources]), [one["row"] for one in sources]
    size = np.sqrt(
        ((points - points.mean(axis=1, keepdims=True)) ** 2).sum(axis=(1, 2)) / points.shape[1]
    )
    order = np.argsort(size, kind="stable")
    for place, one in enumerate(order):  # only configurations of like size can be near
        near = order[place + 1 : np.searchsorted(size[order], size[one] + NEAR, side="right")]
        near = near[split[near] != split[one]]
        if len(near):
            for other in near[distances(points[one], points[near]) < NEAR]:
                yield (
                    f"rows {row[one]} ({split[one]}) and {row[other]} ({split[other]}) are"
                    " near-duplicates"
                )
    for number in np.unique(family):
        shared = sorted(set(split[family == number].tolist()))
        if len(shared) > 1:
            yield f"family {number} is in splits {' and '.join(shared)}"
    taught = set(codes[(split == "train") | (split == "test")].tolist())
    for code in sorted(set(codes[split == "test-code"].tolist()) & taught):
        yield f"code {code or 'loop'} is in test-code and in train or test"
    if (
        (split == "test-nx").any()
        and (split == "train").any()
        and nx[split == "test-nx"].min() <= nx[split == "train"].max()
    ):
        yield "test-nx has pictures with no more crossings than train"
    if len(set(row)) != len(row):
        yield "two rows have the same number"


def _trips(folder: Path) -> tuple[list[_Trip], list[str]]:
    """The walks of a folder in parts of WALKS, with their rows; and faults met on the way."""
    table = read_table(folder, columns=["points", "source"])
    points, sources = points_of(table), table["source"].to_pylist()
    try:
        with h5py.File(folder / "walks.h5", "r") as file:
            found = (
                file.attrs.get("format"),
                file.attrs.get("format_version"),
                file.attrs.get("rope"),
            )
            if found != (WALKS_FORMAT, WALKS_VERSION, RopeConfig().fingerprint):
                return [], [
                    f"walks.h5 has format, version and rope {found}; this version's are"
                    f" {(WALKS_FORMAT, WALKS_VERSION, RopeConfig().fingerprint)}"
                ]
            states, beads, forces = (
                file["state"][()][file["start"][()]],
                file["beads"][()],
                file["forces"][()],
            )
            place = {number: row for row, number in enumerate(file["number"][()].tolist())}
    except (OSError, KeyError) as error:
        return [], [f"walks.h5 can't be read: {' '.join(str(error).split())}"]
    faults: list[str] = []
    rows: dict[int, list[tuple[str, int, dict[str, Any], Array]]] = {}
    for source, own in zip(sources, points, strict=True):
        at = place.get(source["walk"])
        if at is None:
            faults.append(f"row {source['row']}: walk {source['walk']} is not in walks.h5")
        else:
            rows.setdefault(at // WALKS, []).append(
                (f"row {source['row']}", at % WALKS, source, own)
            )
    relaxation = _relaxation(folder)
    parts = [slice(part * WALKS, (part + 1) * WALKS) for part in sorted(rows)]
    return [
        _Trip(states[part], beads[part], forces[part], rows[part.start // WALKS], relaxation)
        for part in parts
    ], faults


def _relaxation(folder: Path) -> RelaxationConfig:
    """How the configurations of a folder were relaxed; as by default if its manifest can't say."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        return from_json(RelaxationConfig, manifest["config"]["walk"]["relaxation"])
    except (OSError, ValueError, KeyError, TypeError):
        return RelaxationConfig()


def _trip_faults(trip: _Trip) -> list[str]:
    rope, out = Rope(), []
    traces = retrace(trip.states, trip.beads, trip.forces)
    for where, place, source, stored in trip.rows:
        frame = traces[place, source["pulls"]]
        rounds = source["rounds"]
        points = relaxed(frame, rounds, rope, trip.relaxation) if rounds else frame
        moved = {name: source[name] for name in ("reflect", "switch", "reverse")}
        symmetry = Symmetry(**moved, base_shift=source["roll"])
        if points is None or not np.array_equal(symmetry.configuration(points), stored):
            out.append(f"{where}: its walk, made again, does not end in its points bit for bit")
    return out
