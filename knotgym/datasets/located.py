"""Resolve a path or an id to the datasets that it names.

It may name a run's folder, a `minari` folder, a file, a folder of pictures, or a Minari dataset.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from knotgym.common.atomic_files import require_apart, require_no_links
from knotgym.common.errors import InvalidInput, MissingFile
from knotgym.common.tables import format_of
from knotgym.datasets.episode_dataset import FILE, FORMAT, episode_file, open_episodes
from knotgym.datasets.image_table import is_images, shards
from knotgym.datasets.minari_form import dataset_files
from knotgym.states.state_file import SHIPPED, minari_root, shipped, states_at


class Dataset(NamedTuple):
    """A dataset and its location.

    Attributes:
        kind: "states", "episodes" or "images".
        path: a folder or a file.
    """

    kind: str
    path: Path


def resolve_datasets(named: str) -> list[Dataset]:
    """Find the datasets that a path, a Minari id or the name of an included set stands for.

    A run's folder stands for its states, a folder of Minari datasets for each of them.

    Raises:
        MissingFile: there is no such file, folder or id.
        InvalidInput: the folder holds no knotgym dataset.
    """
    given = Path(named)
    if not given.exists() and named in SHIPPED:
        given = shipped(named)
    if not given.exists():
        given = minari_root() / named
        if not given.is_dir():
            raise MissingFile(
                f"no such file: {named}, nor a Minari dataset of this id under {minari_root()},"
                f" nor an included set ({', '.join(SHIPPED)})"
            )
    if is_images(given):
        return [Dataset("images", given)]
    if given.is_file():
        kind = "episodes" if format_of(given) == FORMAT else "states"
        return [Dataset(kind, given)]
    if any((given / name).is_file() for name in ("states.h5", "manifest.json")):
        return [Dataset("states", given)]
    found = _datasets_below(given)
    if not found:
        raise InvalidInput(
            f"{named} contains no states.h5, no pictures and no Minari dataset: give the output of"
            " a knotgym command"
        )
    return found


def folder_of(named: str) -> Path:
    """Return the folder that a path or an id names; for a file, its parent.

    Raises:
        MissingFile, InvalidInput: as in `resolve_datasets`.
    """
    resolve_datasets(named)
    given = _root(named)
    return given if given.is_dir() else given.parent


def require_apart_from(out: Path, *given: str) -> None:
    """Raise Occupied if an output is, contains or is in a dataset, by its path, id or name."""
    require_apart(out, [_root(named) for named in given])


def _root(named: str) -> Path:
    return Path(named) if Path(named).exists() else minari_root() / named


def resolve_dataset(named: str, *kinds: str) -> Dataset:
    """Return the only dataset that a path or an id names.

    Raises:
        MissingFile: there is none.
        InvalidInput: there are several, or it is of none of these kinds.
    """
    found = resolve_datasets(named)
    if len(found) > 1:
        listed = ", ".join(str(one.path) for one in found)
        raise InvalidInput(f"{named} contains several datasets, give one of them: {listed}")
    if kinds and found[0].kind not in kinds:
        raise InvalidInput(
            f"{named} contains {found[0].kind}, but this command takes {' or '.join(kinds)}"
        )
    return found[0]


def episodes_at(named: str) -> list[Dataset]:
    """Return the trajectory datasets that a path or an id names; for a run, its demonstrations.

    Raises:
        MissingFile: there is no such file, folder or id.
        InvalidInput: it contains no trajectories.
    """
    out: list[Dataset] = []
    for one in resolve_datasets(named):
        inside = one.path / "minari" if one.kind == "states" else one.path
        out += [one] if one.kind == "episodes" else _datasets_below(inside)
    if not out:
        raise InvalidInput(f"{named} contains no trajectories")
    return out


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
    root = _root(named)
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


def refuse_minaris_folder(out: Path) -> None:
    """Raise InvalidInput if a plain file would be written into Minari's folder."""
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise InvalidInput(
            f"{out} is in Minari's folder, where Minari can't read a plain file: merge with --id"
            " knotgym/name-v0, or give another --out"
        )


def name_of(dataset: Path) -> str:
    """Return a file name for a dataset: the end of its id.

    >>> name_of(Path("minari/knotgym/tie-nx3/demonstrations-v0"))
    'tie-nx3-demonstrations-v0'
    """
    return "-".join(dataset.with_suffix("").parts[-2:])


def _datasets_below(folder: Path) -> list[Dataset]:
    if (folder / FILE).is_file() or (folder / "data" / FILE).is_file():
        return [Dataset("episodes", folder)]
    files = sorted(folder.glob(f"**/data/{FILE}"))
    return [Dataset("episodes", file.parents[1]) for file in files]
