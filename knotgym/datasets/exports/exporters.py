"""Formats that datasets can be exported to, by name."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from knotgym.common.atomic_files import (
    atomic_write,
    require_no_links,
    require_output,
    require_writable,
)
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_dataset import (
    EpisodeDataset,
    episode_file,
    open_episodes,
    write_episodes,
)
from knotgym.datasets.image_table import shards
from knotgym.datasets.located import Dataset, episodes_at, name_of, resolve_datasets
from knotgym.datasets.minari_form import dataset_files, metadata_of
from knotgym.states.state_file import minari_root, read_states, states_at


class Sources(NamedTuple):
    """The datasets that a path or an id names, see `sources`.

    Attributes:
        title: of a card or a page.
        states: a state file.
        episodes: files of episodes.
        pictures: the folder of a perception table.
    """

    title: str
    states: Path | None = None
    episodes: Sequence[Path] = ()
    pictures: Path | None = None


def sources(named: str) -> Sources:
    """Return the datasets that a path or an id names, and check that no file of them is a link.

    Raises:
        MissingFile, InvalidInput: as in `resolve_datasets`.
        InvalidFile: a file is a link, which could lead to a private file of the user.
    """
    found = resolve_datasets(named)
    kind, path = found[0]
    root = Path(named) if Path(named).exists() else minari_root() / named
    title, episodes = path.resolve().name, list(found)
    if kind == "images":
        require_no_links(root, shards(path))
        return Sources(title, pictures=path)
    if kind == "states":
        require_no_links(root, [states_at(path)])
        episodes = demonstrations(path)
    for one in episodes:
        data = episode_file(one.path)
        require_no_links(root, dataset_files(data.parent) if one.path.is_dir() else [data])
    files = [one.path for one in episodes]
    if kind == "states":
        return Sources(title, states=states_at(path), episodes=files)
    return Sources(named if len(found) > 1 else open_episodes(path).name, episodes=files)


def demonstrations(path: Path) -> list[Dataset]:
    """Return the datasets of episodes in the folder of a run."""
    return episodes_at(str(path)) if (path / "minari").is_dir() else []


def export(named: str, out: Path, form: str = "compact", overwrite: bool = False) -> str:
    """Export a dataset to another format; return a one-line summary.

    Args:
        named: a path or an id.
        out: a file for one dataset in format compact or recording, and for curves; otherwise a
            folder.
        form: the format, one of EXPORTERS.
        overwrite: replace what is there.

    Raises:
        InvalidInput: there is no such format, or it has no place for this kind of dataset.
        Occupied: the output exists, and `overwrite` is False.
    """
    if form not in EXPORTERS:
        raise InvalidInput(f"no format {form!r}; formats are {', '.join(EXPORTERS)}")
    require_writable(out)
    return EXPORTERS[form](sources(named), out, overwrite)


def _files(given: Sources, out: Path, overwrite: bool, recordings: bool) -> str:
    """Write packed files of episodes, without pictures; a folder of them for several datasets."""
    datasets = [open_episodes(path) for path in given.episodes]
    if not datasets:
        raise InvalidInput(f"{given.title} contains no trajectories")
    refuse_minaris_folder(out)
    several = len(datasets) > 1
    require_output(out, folder=several, overwrite=overwrite)
    with atomic_write(out, overwrite=overwrite) as target:
        if several:
            target.mkdir()
        for one in datasets:
            _pack(one, target / f"{name_of(one.path)}.h5" if several else target, recordings)
        files = sorted(target.iterdir()) if several else [target]
        size = sum(file.stat().st_size for file in files)
    episodes = sum(one.episodes.episodes.rows for one in datasets)
    return f"{episodes} episodes{f' in {len(datasets)} files' * several}, {size / 1e6:.1f} MB"


def _pack(dataset: EpisodeDataset, path: Path, recordings: bool) -> None:
    from knotgym.datasets.episode_verification import expanded

    metadata = metadata_of(dataset)
    facts = {**dataset.facts, **({} if metadata is None else {"metadata": asdict(metadata)})}
    if recordings:
        episodes = dataset.episodes.recording()
    else:
        episodes = (expanded(dataset) if dataset.episodes.is_recording else dataset).episodes
    write_episodes(path, [episodes], dataset.task, facts, pack=True)


def _compact(given: Sources, out: Path, overwrite: bool) -> str:
    return _files(given, out, overwrite, recordings=False)


def _recording(given: Sources, out: Path, overwrite: bool) -> str:
    return _files(given, out, overwrite, recordings=True)


def _ogbench(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.datasets.exports.ogbench_export import to_ogbench

    if len(given.episodes) != 1:
        raise InvalidInput(
            f"{given.title} has {len(given.episodes)} datasets; export them to ogbench one by one"
        )
    to_ogbench(given.episodes[0], out, overwrite=overwrite)
    return f"{open_episodes(given.episodes[0]).episodes.episodes.rows} episodes for ogbench"


def _huggingface(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.datasets.exports.huggingface_export import to_huggingface

    to_huggingface(given, out, overwrite=overwrite)
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    return f"{size / 1e6:.1f} MB to upload"


def _minari(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.datasets.exports.minari_export import to_minari

    if not given.episodes:
        raise InvalidInput(f"{given.title} contains no trajectories")
    to_minari(given.episodes, out, overwrite=overwrite)
    return f"a Minari root with {len(given.episodes)} datasets; upload the folder in it"


def _curves(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.generate.states.imported_curves import write_curves

    if given.states is None:
        raise InvalidInput(f"{given.title} holds no states, whose curves could be exported")
    points = read_states(given.states, images=False).points
    require_output(out, folder=False, overwrite=overwrite)
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_curves(temporary, [f"state{row}" for row in range(len(points))], points)
    return f"{len(points)} curves"


def refuse_minaris_folder(out: Path) -> None:
    """Raise InvalidInput if a plain file would be written into Minari's folder."""
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise InvalidInput(
            f"{out} is in Minari's folder, where Minari can't read a plain file: merge with --id"
            " knotgym/name-v0, or give another --out"
        )


EXPORTERS: dict[str, Callable[[Sources, Path, bool], str]] = {
    "compact": _compact,
    "recording": _recording,
    "ogbench": _ogbench,
    "huggingface": _huggingface,
    "minari": _minari,
    "curves": _curves,
}
