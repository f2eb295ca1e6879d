"""Merge the shards of one run, made by `--shard i/n` in n folders.

Merged episodes have the same bytes as a run without shards. Pictures differ from that run's, but
have the same distribution: of near-duplicates in two shards the later one is dropped.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, require_no_links, require_output, sha256
from knotgym.common.configuration import from_json, read_json
from knotgym.common.errors import InvalidInput, one_line
from knotgym.datasets.finished_folders import finish_images
from knotgym.datasets.image_table import points_of, read_table, shards, write_shards
from knotgym.datasets.machine import distinct
from knotgym.datasets.walks_file import joined_walks, read_walks, write_walks
from knotgym.generate.episodes.old_collect import REPORT, CollectConfig, Tally, write_whole
from knotgym.generate.images.images_config import ImagesConfig
from knotgym.runs.engine import LISTED
from knotgym.runs.shards import Shard
from knotgym.states.near_duplicates import apart
from knotgym.states.state_file import (
    leads_out,
)

_KINDS: dict[str, tuple[str, type[Any]]] = {  # format of a manifest -> kind, configuration
    "knotgym-collection": ("episodes", CollectConfig),
    "knotgym-images-manifest": ("images", ImagesConfig),
}
_NEAR = "near_duplicates_between_shards"  # in the report of the whole


@dataclass(frozen=True)
class ShardFolder:
    """The output folder of a shard."""

    folder: Path
    kind: str  # "episodes" or "images"
    shard: Shard
    request: dict[str, Any]  # request of the run without the shard; equal for all shards of a run
    manifest: dict[str, Any]  # the folder's manifest; for episodes, collection.json


def shard_folder_of(source: str) -> ShardFolder | None:
    """Read a shard's folder; return None if the folder isn't one."""
    folder = Path(source)
    for name in ("manifest.json", REPORT):
        try:
            manifest = read_json(folder / name)
            request = {key: manifest[key] for key in LISTED}
            shard = Shard(**request.pop("shard"))
            kind, _ = _KINDS[manifest["format"]]
        except (OSError, ValueError, KeyError, TypeError):
            continue
        return None if shard.is_whole else ShardFolder(folder, kind, shard, request, manifest)
    return None


def merge_shards(folders: Sequence[ShardFolder], out: Path, *, overwrite: bool = False) -> Path:
    """Merge all shards of a run, in any order, and return the new folder.

    For episodes `out` is the Minari root, as in `knotgym collect`.

    Raises:
        InvalidInput: shards are missing, given twice, corrupted, of different runs, or have an
            invalid report.
        Occupied: the output exists.
    """
    ordered = sorted(folders, key=lambda folder: folder.shard.number)
    _require_whole_run(ordered)
    report = _reported(ordered)
    first, folder = ordered[0], out
    if first.kind == "episodes":
        named = str(first.request["config"]["dataset_id"])
        if leads_out(named):
            raise InvalidInput(f"{first.folder} says that its id is {named!r}, which leads out")
        folder = out / named
    require_output(folder, folder=True, overwrite=overwrite)
    whole = _Whole(
        ordered,
        report,
        {**first.request, "shard": asdict(Shard())},
        distinct(shard.manifest for shard in ordered),
    )
    with atomic_write(folder, overwrite=overwrite) as part:
        merge = {"episodes": _episodes, "images": _images}[first.kind]
        merge(whole, part.with_name("whole")).rename(part)
    return folder


@dataclass(frozen=True)
class _Whole:
    """The shards of a run in order, and what its manifest says."""

    shards: Sequence[ShardFolder]
    report: dict[str, Any]
    request: dict[str, Any]
    machines: list[dict[str, str]]

    def files(self, name: str) -> list[Path]:
        return [shard.folder / name for shard in self.shards]


def _require_whole_run(ordered: Sequence[ShardFolder]) -> None:
    """Require all intact shards of one run, sorted by number."""
    first, *others = ordered
    for other in others:
        if _run(other) != _run(first):
            raise InvalidInput(
                f"{first.folder} and {other.folder} are not shards of one run: they were asked for"
                " different things"
            )
    numbers = [folder.shard.number for folder in ordered]
    missing = sorted(set(range(1, first.shard.of + 1)) - set(numbers))
    if missing:
        raise InvalidInput(
            f"of {first.shard.of} shards {', '.join(map(str, missing))}"
            f" {'is' if len(missing) == 1 else 'are'} missing"
        )
    if len(numbers) > first.shard.of:
        raise InvalidInput(f"a shard is named twice: {', '.join(map(str, numbers))}")
    for folder in ordered:
        files = folder.manifest.get("files")
        if not isinstance(files, dict):
            raise InvalidInput(f"{folder.folder} doesn't say which files it has")
        require_no_links(folder.folder, [folder.folder / name for name in files])
        for name, digest in files.items():
            path = folder.folder / name
            if not path.is_file() or sha256(path) != digest:
                raise InvalidInput(
                    f"{path} is missing or spoilt (SHA-256 differs); make shard {folder.shard}"
                    " again"
                )


def _run(shard: ShardFolder) -> tuple[Any, ...]:
    return shard.kind, shard.shard.of, shard.request


def _reported(ordered: Sequence[ShardFolder]) -> dict[str, Any]:
    """Return the sum of the shards' reports; raise InvalidInput if one or the configuration is
    invalid.
    """
    first = ordered[0]
    try:
        from_json(dict(_KINDS.values())[first.kind], first.request["config"])
        if first.kind == "episodes":
            return asdict(sum((Tally(**shard.manifest["tally"]) for shard in ordered), Tally()))
        reports = [shard.manifest["report"] for shard in ordered]
        return _report_of_images(reports)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InvalidInput(
            f"{first.folder} and the others say what no shard of ours says: {one_line(error)}"
        ) from error


def _report_of_images(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    totals = {name: sum(report[name] for report in reports) for name in ("walks", "frames")}
    for name in ("dropped", "refused"):
        counts = sum((Counter(report[name]) for report in reports), Counter[str]())
        totals[name] = dict(sorted(counts.items()))
    return totals


def _episodes(whole: _Whole, folder: Path) -> Path:
    config = from_json(CollectConfig, whole.request["config"])
    return write_whole(
        config,
        whole.files("main_data.hdf5"),
        Tally(**whole.report),
        folder,
        whole.request,
        concatenate=True,
        machines=whole.machines,
    )


def _images(whole: _Whole, folder: Path) -> Path:
    kept = _kept_rows([path for shard in whole.shards for path in shards(shard.folder)])
    written = write_shards(folder, kept, whole.request["config"]["rows_per_file"])
    walks = [read_walks(file) for file in whole.files("walks.h5")]
    write_walks(folder / "walks.h5", joined_walks(walks))
    report = {**whole.report, _NEAR: sum(int((~rows).sum()) for rows in kept.values())}
    finish_images(folder, written, report, whole.request, whole.machines)
    return folder


def _kept_rows(tables: Sequence[Path]) -> dict[Path, NDArray[np.bool_]]:
    """Return a mask of rows to keep for each file: those without an earlier near-duplicate."""
    points = [points_of(read_table(path, columns=["points"])) for path in tables]
    ends = np.cumsum([len(own) for own in points])
    kept = np.split(apart(np.concatenate(points)), ends[:-1])
    return dict(zip(tables, kept, strict=True))
