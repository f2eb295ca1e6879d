"""Verification of perception tables.

Every label, measure and picture is recomputed, every walk is repeated in the simulator, and splits
are checked for overlap. Each fault is reported as one line.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import from_json
from knotgym.common.errors import InvalidFile, KnotgymError, MissingFile, one_line
from knotgym.datasets.episode_verification import Count, uncounted
from knotgym.datasets.image_rows import appearance_of, labels, measures
from knotgym.datasets.image_table import (
    GRADES,
    arrow,
    encode,
    points_of,
    read_rows,
    read_table,
    row_line,
    shards,
    stored_digest,
)
from knotgym.datasets.manifest_check import listed_faults, read_manifest
from knotgym.datasets.walks_file import read_walks, retrace
from knotgym.quality.label_limits import at_base, pressed_together, visits_too_close
from knotgym.rendering.appearance import render
from knotgym.rendering.appearance_config import SIZES
from knotgym.rope.model import Array, Rope
from knotgym.rope.relaxation import RelaxationConfig, relaxed
from knotgym.states.near_duplicates import pairs_within
from knotgym.states.splits import IMAGE_SPLITS
from knotgym.states.state_measures import (
    measure_faults,
    recomputed_faults,
    second_labeller_faults,
    spread_faults,
)
from knotgym.topology.crossings import find_crossings
from knotgym.topology.symmetry import Symmetry

_HUGE = 1e3  # metres; coordinates beyond this are corrupted, a rope is 1.3 m long
_BATCH = 32  # walks simulated together
_MOST_ROUNDS = 10_000  # of relaxation; a larger number is corrupted and would run for hours
_COLOURS = ("published", "single", "gradient", "lines")
_RECOMPUTED = (
    *("gauss_code", "gauss_code_chiral", "pd_code", "dt_code", "nx", "knot"),
    *("crossings", "accepted", "grade"),
)
_DRAWN_WITH, _MOST_DRAWN = ("zoom", "width", "noise", "blur"), 1000.0

Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # `map`, or that of a pool


class _WalkRow(NamedTuple):
    """A row that comes from a walk: its number, and the index of the walk in its batch."""

    row: int
    walk: int
    source: dict[str, Any]
    points: Array


class _WalkBatch(NamedTuple):
    """Arguments of `walks_file.retrace` for some walks, and the rows that come from them."""

    walks: tuple[Array, NDArray[np.int16], NDArray[np.float32], str]
    rows: list[_WalkRow]
    relaxation: RelaxationConfig


def image_faults(path: str | Path, each: Map = map, count: Count = uncounted) -> Iterator[str]:
    """Yield the faults of a table: manifest and checksums, then rows, splits and walks.

    Args:
        path: a folder made by `knotgym images`, or a single shard, whose rows alone are checked.
        each: `map` or a pool's, for shards and batches of walks; results keep the order.
    """
    folder = Path(path)
    arrow()
    if folder.is_dir():
        yield from _folder_faults(folder)
    readable, files = True, shards(path)
    count("files of pictures", 0, len(files))
    for done, faults in enumerate(each(shard_faults, files), 1):
        count("files of pictures", done, len(files))
        yield from faults
        readable &= not any("Parquet shard" in fault or "format" in fault for fault in faults)
    if not readable:
        return
    table = read_table(path, columns=["gauss_code", "nx", "split", "points", "source"])
    if not len(table):
        yield f"{folder.name} has no rows"
        return
    yield from _split_faults(table)
    if not folder.is_dir():
        return
    batches, faults = _walk_batches(folder, table)
    yield from faults
    rows, done = sum(len(batch.rows) for batch in batches), 0
    count("walks repeated", done, rows)
    for batch, faults in zip(batches, each(_walk_faults, batches), strict=True):
        done += len(batch.rows)
        count("walks repeated", done, rows)
        yield from faults


def shard_faults(path: Path) -> list[str]:
    """List the faults of the rows of a shard, and compare the rows with its `content_sha256`."""
    faults, now = [], hashlib.sha256()
    try:
        for n, row in enumerate(read_rows(path)):
            faults += [f"{path.name} row {n}: {fault}" for fault in _all_faults(row)]
            now.update(row_line(row))
        digest = stored_digest(path)
    except (InvalidFile, MissingFile) as error:
        return [str(error)]
    if digest not in ("", now.hexdigest()):
        faults.append(f"{path.name}: its rows were changed after writing (SHA-256 differs)")
    return faults


def _all_faults(row: dict[str, Any]) -> list[str]:
    """List the faults of a row; failing to render or measure it is one."""
    try:
        return list(row_faults(row))
    except (KnotgymError, ValueError, TypeError, ArithmeticError, LookupError, cv2.error) as error:
        return [f"it can't be rendered or measured: {one_line(error)}"]


def row_faults(row: dict[str, Any]) -> Iterator[str]:
    """Yield the faults of one row, as `read_rows` gives it."""
    points = np.array(row["points"], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        yield "coordinates are not finite"
        return
    across = list(spread_faults(points, Rope()))
    if across:
        yield from across
        return
    crossings, look = find_crossings(points), appearance_of(row["appearance"])
    if not SIZES[0] <= look.size <= SIZES[1]:
        yield f"appearance.size is {look.size}, should be {SIZES[0]} to {SIZES[1]} pixels"
        return
    odd = [name for name in _DRAWN_WITH if not 0 <= getattr(look, name) <= _MOST_DRAWN]
    if odd:
        yield f"appearance.{odd[0]} is {getattr(look, odd[0])}, should be 0 to {_MOST_DRAWN:g}"
        return
    # the same functions that wrote the row
    right = {**labels(points, crossings, look), **measures(points, crossings, row["source"])}
    yield from recomputed_faults(row, {name: right[name] for name in _RECOMPUTED})
    yield from measure_faults(row["quality"], right["quality"])
    yield from second_labeller_faults(points, crossings.code)
    if look.colours not in _COLOURS:
        yield f"appearance.colours is {look.colours!r}, should be {' or '.join(_COLOURS)}"
    if row["split"] not in IMAGE_SPLITS or row["grade"] not in GRADES:
        yield f"split is {row['split']!r} and grade {row['grade']!r}"
    if (
        visits_too_close(crossings, len(points))
        or at_base(crossings, len(points))
        or pressed_together(right["quality"]["clearance"])
    ):
        yield (
            "the label is ambiguous: crossings too close along the rope, at the base bead, or with"
            " strands pressed together"
        )
    if row["image"] != encode(render(points, look)):
        yield "image is not the rendering of points with this appearance"


def _folder_faults(folder: Path) -> Iterator[str]:
    """Yield faults of the manifest and checksums, and Parquet files that it doesn't list."""
    manifest, faults = read_manifest(folder)
    yield from faults
    yield from listed_faults(folder, manifest)
    if manifest:
        for shard in shards(folder):
            if f"data/{shard.name}" not in manifest["files"]:
                yield f"{shard.name} is not in the manifest"


def _split_faults(table: Any) -> Iterator[str]:
    """Yield what splits share: near-duplicates and families; and codes or nx in the wrong split."""
    split, codes, nx = (np.array(table[name].to_pylist()) for name in ("split", "gauss_code", "nx"))
    sources = table["source"].to_pylist()
    numbers = [source["row"] for source in sources]
    for row, other in _near_across_splits(points_of(table), split):
        yield (
            f"rows {numbers[row]} ({split[row]}) and {numbers[other]} ({split[other]}) are"
            " near-duplicates"
        )
    family = np.array([source["family"] for source in sources])
    for shared in np.unique(family):
        sharing = sorted(set(split[family == shared].tolist()))
        if len(sharing) > 1:
            yield f"family {shared} is in splits {' and '.join(sharing)}"
    # codes of test-nx have more crossings than any other split's, so they aren't compared
    seen = set(codes[np.isin(split, ("train", "test"))].tolist())
    for code in sorted(set(codes[split == "test-code"].tolist()) & seen):
        yield f"code {code or 'loop'} is in test-code and in train or test"
    harder, trained = nx[split == "test-nx"], nx[split == "train"]
    if len(harder) and len(trained) and harder.min() <= trained.max():
        yield "test-nx has pictures with no more crossings than train"
    if len(set(numbers)) != len(numbers):
        yield "two rows have the same number"


def _near_across_splits(points: Array, split: NDArray[np.str_]) -> Iterator[tuple[int, int]]:
    """Yield pairs of rows of different splits that are near-duplicates."""
    # rows with non-finite or huge coordinates are reported elsewhere and have no distance
    sound = (np.abs(points) < _HUGE).all(axis=(1, 2))
    for one, other in combinations(sorted(set(split.tolist())), 2):
        rows, others = (np.flatnonzero(sound & (split == name)) for name in (one, other))
        for i, k, _ in pairs_within(points[rows], points[others]):
            yield int(rows[i]), int(others[k])


def _walk_batches(folder: Path, table: Any) -> tuple[list[_WalkBatch], list[str]]:
    """Group the walks of a folder and their rows into batches; return them with faults found."""
    try:
        walks = read_walks(folder / "walks.h5")
    except (InvalidFile, MissingFile) as error:
        return [], [str(error)]
    index = {number: row for row, number in enumerate(walks.number.tolist())}
    faults: list[str] = []
    rows: dict[int, list[_WalkRow]] = {}
    for source, points in zip(table["source"].to_pylist(), points_of(table), strict=True):
        at = index.get(source["walk"])
        if at is None:
            faults.append(f"row {source['row']}: walk {source['walk']} is not in walks.h5")
        else:
            row = _WalkRow(source["row"], at % _BATCH, source, points)
            rows.setdefault(at // _BATCH, []).append(row)
    try:
        manifest, _ = read_manifest(folder)
        relaxation = from_json(RelaxationConfig, manifest["config"]["walk"]["relaxation"])
    except (
        KeyError,
        TypeError,
        KnotgymError,
    ):  # a fault of the manifest, which _folder_faults reports
        relaxation = RelaxationConfig()
    states = walks.state[walks.start]
    batches = []
    for batch, own in sorted(rows.items()):
        part = slice(batch * _BATCH, (batch + 1) * _BATCH)
        arguments = states[part], walks.beads[part], walks.forces[part], walks.engine
        batches.append(_WalkBatch(arguments, own, relaxation))
    return batches, faults


def _walk_faults(batch: _WalkBatch) -> list[str]:
    """Repeat walks, relax, apply symmetries; list the rows whose points differ."""
    rope, faults = Rope(), []
    traces = retrace(*batch.walks)
    for row, walk, source, stored in batch.rows:
        steps, rounds = source["pulls"], source["rounds"]
        if not (0 <= steps < traces.shape[1] and 0 <= rounds <= _MOST_ROUNDS):
            faults.append(
                f"row {row}: its walk has {traces.shape[1] - 1} steps and at most {_MOST_ROUNDS}"
                f" rounds, its source says {steps} and {rounds}"
            )
            continue
        points: Array | None = traces[walk, steps]
        if rounds:
            points = relaxed(traces[walk, steps], rounds, rope, batch.relaxation)
        names = ("reflect", "switch", "reverse", "base_shift")
        symmetry = Symmetry(**{name: source[name] for name in names})
        if points is None or not np.array_equal(symmetry.configuration(points), stored):
            faults.append(f"row {row}: its walk, repeated, does not end in its points bit for bit")
    return faults
