"""Shards of one run put together: what `--shard i/n` made in n folders becomes what one run leaves
in one.

Episodes come out byte for byte as from a run without shards. States and pictures are another draw
than that run's, as true and as even; near-duplicates between shards go, the later one of two, and
states are split anew so that the shares hold.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.atomic_files import sha256
from knotgym.configuration import InvalidConfig, from_json
from knotgym.datasets import image_folder
from knotgym.datasets.episode_reader import Chosen
from knotgym.datasets.image_table import (
    SPLITS,
    arrow,
    points_of,
    read_table,
    shard_name,
    shards,
    write_table,
)
from knotgym.datasets.near_duplicates import apart
from knotgym.datasets.states import States, merge_states, read_states, write_states
from knotgym.errors import KnotgymError
from knotgym.generate.episodes.collect import REPORT, CollectConfig, Tally, write_whole
from knotgym.generate.states import state_folder as output
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.curation import split
from knotgym.generate.states.search import SearchSettings
from knotgym.runs.shards import Shard
from knotgym.runs.staging import Occupied, staging
from knotgym.streams import Stream, generator
from knotgym.topology.gauss import GaussCode

_FORMATS = {"knotgym-manifest": "states", "knotgym-images-manifest": "images"}


class InvalidMerge(KnotgymError, ValueError):
    """Shards that don't make a whole."""


@dataclass(frozen=True)
class ShardFolder:
    """A folder that a shard of a run made.

    Attributes:
        kind: "states", "episodes" or "images".
        shard: which.
        asked: the rest of the run's settings; shards of one run have the same.
        said: its manifest or report.
    """

    folder: Path
    kind: str
    shard: Shard
    asked: dict[str, Any]
    said: dict[str, Any]


def shard_folder_of(source: str) -> ShardFolder | None:
    """What a folder says it is a shard of; None of anything else."""
    folder = Path(source)
    for name in ("manifest.json", REPORT):
        try:
            said = json.loads((folder / name).read_text(encoding="utf-8"))
            config = dict(said["config"])
            shard = Shard(**config.pop("shard"))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        asked = {"config": config, "source": said.get("source"), "version": said.get("version")}
        return (
            None
            if shard.is_whole
            else ShardFolder(
                folder, _FORMATS.get(said.get("format"), "episodes"), shard, asked, said
            )
        )
    return None


def merge_shards(found: Sequence[ShardFolder], out: Path) -> Path:
    """Put all the shards of a run together.

    Args:
        found: in any order.
        out: the folder to make; for episodes the root of the dataset's id, as of `knotgym collect`.

    Returns:
        The folder made.

    Raises:
        InvalidMerge: some are missing, are there twice, are spoilt, or belong to different runs.
        Occupied: there is something in the way.
    """
    ordered = sorted(found, key=lambda one: one.shard.number)
    first = ordered[0]
    for other in ordered[1:]:
        if (other.kind, other.shard.of, other.asked) != (first.kind, first.shard.of, first.asked):
            raise InvalidMerge(
                f"{first.folder} and {other.folder} are not shards of one run: they were asked for"
                " different things"
            )
    numbers = [shard.shard.number for shard in ordered]
    missing = sorted(set(range(1, first.shard.of + 1)) - set(numbers))
    if missing:
        raise InvalidMerge(
            f"of {first.shard.of} shards {', '.join(map(str, missing))}"
            f" {'is' if len(missing) == 1 else 'are'} missing"
        )
    if len(numbers) > first.shard.of:
        raise InvalidMerge(f"a shard is named twice: {', '.join(map(str, numbers))}")
    for shard in ordered:
        for name, digest in shard.said["files"].items():
            path = shard.folder / name
            if not path.is_file() or sha256(path) != digest:
                raise InvalidMerge(
                    f"{path} is missing or spoilt (SHA-256 differs); make shard {shard.shard} again"
                )
    folder = out / first.asked["config"]["dataset_id"] if first.kind == "episodes" else out
    if folder.exists():
        raise Occupied(f"{folder} is there already; choose another --out, or remove it")
    with staging(folder, resume=False) as partial:
        made = {"states": _states, "episodes": _episodes, "images": _images}[first.kind](
            ordered, partial / "whole"
        )
        made.rename(folder)
        shutil.rmtree(partial)
    return folder


def _states(ordered: Sequence[ShardFolder], folder: Path) -> Path:
    read = [read_states(shard.folder / "states.h5") for shard in ordered]
    config = {**ordered[0].asked["config"], "shard": asdict(Shard())}
    merged = merge_states(read)
    order = np.argsort(np.concatenate([states.nx for states in read]), kind="stable")
    number = np.repeat(np.arange(len(read)), [len(states) for states in read])[order]
    kept = np.flatnonzero(apart(merged.points))
    merged, number = _rows(merged, kept), number[kept]
    splits = merged.split.copy()
    place = np.zeros(len(merged), dtype=np.int64)
    for nx in config["nx"]:
        mine = np.flatnonzero(merged.nx == nx)
        codes = [GaussCode.parse(text) for text in merged.gauss_code[mine]]
        splits[mine] = split(
            codes,
            config["split_by"],
            config["train_share"],
            generator(Stream.SPLIT, config["seed"], nx),
        )
        place[mine] = np.arange(len(mine))
    trajectories, attributes = (
        merged.source["trajectory"],
        {
            **merged.attributes,
            "config": json.dumps(config, sort_keys=True),
        },
    )
    merged = replace(
        merged, split=splits, source={**merged.source, "trajectory": place}, attributes=attributes
    )
    folder.mkdir(parents=True)
    write_states(folder / "states.h5", merged)
    for nx in sorted(set(merged.nx.tolist())):
        mine = np.flatnonzero(merged.nx == nx)
        sequences = [
            Chosen(
                output.demonstrations_folder(shard.folder / "minari", nx),
                trajectories[mine[number[mine] == k]].tolist(),
            )
            for k, shard in enumerate(ordered)
        ]
        output.publish_demonstrations(
            nx,
            [one for one in sequences if one.episode_indices],
            len(mine),
            folder / "minari",
            folder / "states.h5",
        )
    archives = [Archive.load(shard.folder / "archive.h5") for shard in ordered]
    search = from_json(SearchSettings, config.get("search", {}))
    _archive(archives, search).save(folder / "archive.h5")
    report = _report_of_states([shard.said["report"] for shard in ordered], len(order) - len(kept))
    output.finish(folder, merged, report, config)
    return folder


def _rows(states: States, rows: np.ndarray) -> States:
    """Some rows of a table."""
    columns: dict[str, Any] = {
        name: getattr(states, name)[rows]
        for name in (
            "qpos",
            "points",
            "image",
            "gauss_code",
            "gauss_code_chiral",
            "knot",
            "nx",
            "split",
        )
    }
    groups: dict[str, Any] = {
        name: {key: column[rows] for key, column in getattr(states, name).items()}
        for name in ("quality", "source")
    }
    return replace(states, **columns, **groups)


def _archive(archives: Sequence[Archive], search: SearchSettings) -> Archive:
    """What any of the searches found, their rounds one after another."""
    out = archives[0]
    for other in archives[1:]:
        for elites in other.niches.values():
            for elite in elites:
                out.offer(elite, search.archive)
        for niche, count in other.visits.items():
            out.visits[niche] = out.visits.get(niche, 0) + count
        out.transitions.add(other.transitions, search.most_templates)
        rounds, actions = len(out.growth), out.growth[-1]["actions"] if out.growth else 0
        out.growth += [
            {**row, "round": rounds + row["round"], "actions": actions + row["actions"]}
            for row in other.growth
        ]
    return out


def _report_of_states(reports: Sequence[dict[str, Any]], near: int) -> dict[str, Any]:
    rejected: dict[str, Counter[str]] = {}
    for report in reports:
        for nx, reasons in report["rejected"].items():
            rejected.setdefault(nx, Counter()).update(reasons)
    return {
        **reports[0],
        "attempts": sum(report["attempts"] for report in reports),
        "actions": sum(report["actions"] for report in reports),
        "rejected": {nx: dict(sorted(reasons.items())) for nx, reasons in rejected.items()},
        "growth": [],  # that of each shard is its own
        "near_duplicates_between_shards": near,
    }


def _episodes(ordered: Sequence[ShardFolder], folder: Path) -> Path:
    asked = ordered[0].asked["config"]
    try:
        config = from_json(CollectConfig, asked)
    except InvalidConfig:
        config = None
    if config is None or json.loads(json.dumps(asdict(config))) != asked:
        raise InvalidMerge(
            f"{ordered[0].folder} was collected by another version of knotgym, with other settings"
        )
    tally = sum((Tally(**shard.said["tally"]) for shard in ordered), Tally())
    return write_whole(
        config,
        [shard.folder / "main_data.hdf5" for shard in ordered],
        tally,
        folder,
        concatenate=True,
    )


def _images(ordered: Sequence[ShardFolder], folder: Path) -> Path:
    pa = arrow()
    tables = [path for shard in ordered for path in shards(shard.folder)]
    points = [points_of(read_table(path, columns=["points"])) for path in tables]
    kept = dict(
        zip(
            tables,
            np.split(apart(np.concatenate(points)), np.cumsum([*map(len, points)])[:-1]),
            strict=True,
        )
    )
    near = sum(int((~rows).sum()) for rows in kept.values())
    config = {**ordered[0].asked["config"], "shard": asdict(Shard())}
    written: list[Path] = []
    for name in SPLITS:
        mine = [
            path
            for path in tables
            if path.name.startswith(
                shard_name(name, 0, 1).removeprefix("data/").split("-")[0] + "-"
            )
        ]
        count = -(-sum(int(kept[path].sum()) for path in mine) // config["rows_per_file"])
        chosen = (read_table(path).filter(pa.array(kept[path])) for path in mine)
        for index, table in enumerate(_cut(chosen, config["rows_per_file"])):
            written.append(folder / shard_name(name, index, count))
            write_table(written[-1], table)
    image_folder.join_walks(folder / "walks.h5", [shard.folder / "walks.h5" for shard in ordered])
    reports = [shard.said["report"] for shard in ordered]
    report = {
        **{name: sum(one[name] for one in reports) for name in ("walks", "frames")},
        **{
            name: dict(sorted(sum((Counter(one[name]) for one in reports), Counter()).items()))
            for name in ("dropped", "refused")
        },
        "near_duplicates_between_shards": near,
    }
    image_folder.close(
        folder, written, {"config": config, "source": ordered[0].asked["source"]}, report
    )
    return folder


def _cut(tables: Iterable[Any], most: int) -> Iterator[Any]:
    """The rows of tables in tables of `most` rows; the last may have fewer."""
    rest: Any = None
    for table in tables:
        rest = table if rest is None else arrow().concat_tables([rest, table])
        while len(rest) >= most:
            yield rest.slice(0, most)
            rest = rest.slice(most)
    if rest is not None and len(rest):
        yield rest
