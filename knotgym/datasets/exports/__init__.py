"""Formats that datasets can be exported to: one record each, from which help and docs follow.

A new format is a function `(source, target, replay) -> summary` and a record in EXPORTS.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Literal, NamedTuple

from knotgym.common import Counts, InvalidInput, atomic_write, require_output

if TYPE_CHECKING:
    from knotgym.datasets.episode_verification import Replay
    from knotgym.datasets.located import Located

_HERE = "knotgym.datasets.exports"


class Export(NamedTuple):
    """A format.

    Attributes:
        says: what it is, for the help.
        function: its function, or "module:name" of it, which is imported on use. It gets the
            datasets, the target and a way to play recordings again, and returns a one-line summary.
        needs: "episodes" or "pictures" if it takes no others.
        output: "file" for one dataset a file, else a folder; "folder", which exists when the
            function is called; or "beside" if it adds files to a folder by itself, which it does in
            one go, and is also told whether to replace any.
        extra: the extra of the package that it needs.
    """

    says: str
    function: Callable[..., str] | str
    needs: Literal["episodes", "pictures", ""] = "episodes"
    output: Literal["file", "folder", "beside"] = "folder"
    extra: str = ""


def _write_files(
    source: "Located", target: Path, replay: "Replay", *, whole: bool = True, pack: bool = True
) -> str:
    """Write a file of episodes, or several into a folder.

    Args:
        source: the datasets.
        target: the file or folder.
        replay: plays recordings again.
        whole: with all columns; otherwise starts and pulls alone.
        pack: compressed.
    """
    from knotgym.datasets.episode_dataset import open_episodes, write_episodes
    from knotgym.datasets.episode_verification import expanded

    datasets, size = [open_episodes(path) for path in source.episodes], 0
    ends = [path.with_suffix("") if path.is_file() else path for path in source.episodes]
    # by the ends of their ids, such as tie-nx3-demonstrations-v0
    pairs = zip(_names_apart(ends), datasets, strict=True)
    for name, dataset in Counts.over(pairs, "writing datasets", len(datasets)):
        kept = {n: dataset.attributes[n] for n in {"expansion"} & dataset.attributes.keys()}
        if not whole:
            dataset = replace(dataset, episodes=dataset.episodes.recording())
        elif dataset.episodes.is_recording:
            dataset = expanded(dataset, replay)
        file = target / f"{name}.h5" if target.is_dir() else target
        write_episodes(file, [dataset.episodes], dataset.task, {**dataset.facts, **kept}, pack=pack)
        size += file.stat().st_size
    episodes = sum(map(len, datasets))
    files = f" in {len(datasets)} files" if target.is_dir() else ""
    return f"{episodes} episodes{files}, {size / 1e6:.1f} MB"


def _names_apart(paths: Sequence[Path]) -> list[str]:
    """Name paths by the fewest of their last parts that tell them apart, also where case doesn't.

    >>> _names_apart([Path("alice/tie/x-v0"), Path("bob/tie/x-v0")])
    ['alice-tie-x-v0', 'bob-tie-x-v0']
    """
    parts = [path.absolute().parts for path in paths]
    for count in range(2, max(map(len, parts)) + 1):
        names = ["-".join(path_parts[-count:]) for path_parts in parts]
        if len({name.casefold() for name in names}) == len(names):
            return names
    raise InvalidInput(f"names can't tell {', '.join(map(str, paths))} apart; rename one")


_PLAYED, _PICTURES = f"{_HERE}.episode_exports", f"{_HERE}.picture_exports"
_HUB, _PARQUET = f"{_HERE}.huggingface_export:to_huggingface", "huggingface"  # the extra
_of_pictures = partial(Export, needs="pictures", extra=_PARQUET)
_of_file = partial(Export, output="file")
EXPORTS = {
    "compact": _of_file("one compressed file without pictures", _write_files),
    "columns": _of_file(
        "the same uncompressed, for loaders to map", partial(_write_files, pack=False)
    ),
    "recording": _of_file("starts and pulls alone", partial(_write_files, whole=False)),
    "ogbench": Export("data files for OGBench's agents", f"{_PLAYED}:to_ogbench", output="beside"),
    "worldmodel": _of_file(
        "HDF5 that stable-worldmodel reads, pictures included", f"{_PLAYED}:to_worldmodel"
    ),
    "minari": Export("a Minari root, ready to upload", f"{_PLAYED}:to_minari"),
    "huggingface": Export("Parquet files with a card, ready to upload", _HUB, "", extra=_PARQUET),
    "coco": _of_pictures("photos with boxes, masks and keypoints", f"{_PICTURES}:to_coco"),
    "webdataset": _of_pictures("pictures as tar files", f"{_PICTURES}:to_webdataset"),
}


def export_help() -> str:
    """Return the formats in words, for the help of `knotgym dataset export`."""

    says = (
        f"{name} ({record.says}{f'; extra {record.extra}' if record.extra else ''})"
        for name, record in EXPORTS.items()
    )
    return f"Format: {', '.join(says)}."


def export(named: str, out: Path, form: str, replay: "Replay", *, overwrite: bool = False) -> str:
    """Export a dataset to another format; return a one-line summary.

    Args:
        named: a path or an id.
        out: a file for one dataset if the format's output is one; otherwise a folder.
        form: the format, one of EXPORTS.
        replay: plays recordings again, `control.replay`.
        overwrite: replace what is there.

    Raises:
        InvalidInput: there is no such format, or it has no place for this kind of dataset.
        Occupied: the output exists, and `overwrite` is False.
    """
    from knotgym.datasets.located import locate, require_file

    if form not in EXPORTS:
        raise InvalidInput(f"no format {form!r}; formats are {', '.join(EXPORTS)}")
    chosen, given = EXPORTS[form], locate(named)
    is_file = chosen.output == "file" and len(given.episodes) < 2
    if chosen.output == "file":
        require_file(out, [given.root], overwrite, folder=not is_file)
    elif chosen.output == "folder":
        require_output(out, folder=True, overwrite=overwrite, reads=[given.root])
    if chosen.needs and not getattr(given, chosen.needs):
        raise InvalidInput(f"{given.title} contains no {chosen.needs}")
    write = chosen.function
    if isinstance(write, str):
        write = resolve_name(write)
    if chosen.output == "beside":
        return write(given, out, replay, overwrite)
    with atomic_write(out, overwrite=overwrite) as target:
        if not is_file:
            target.mkdir()
        return write(given, target, replay)
