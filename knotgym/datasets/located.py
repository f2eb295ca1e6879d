"""Resolve a path or an id to the datasets that it names.

It may name a run's folder, a `minari` folder, a file, a folder of pictures, or a Minari dataset.
"""

from pathlib import Path
from typing import NamedTuple

from knotgym.common.errors import InvalidInput, MissingFile
from knotgym.common.hdf5_files import hdf5_format
from knotgym.datasets.image_table import is_images
from knotgym.states.schema import FORMAT as STATES_FORMAT
from knotgym.states.state_file import SHIPPED, minari_root, shipped


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
        kind = "states" if hdf5_format(given) in (STATES_FORMAT, None) else "episodes"
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
    given = Path(named) if Path(named).exists() else minari_root() / named
    return given if given.is_dir() else given.parent


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


def name_of(dataset: Path) -> str:
    """Return a file name for a dataset: the end of its id.

    >>> name_of(Path("minari/knotgym/tie-nx3/demonstrations-v0"))
    'tie-nx3-demonstrations-v0'
    """
    return "-".join(dataset.with_suffix("").parts[-2:])


def _datasets_below(folder: Path) -> list[Dataset]:
    if (folder / "main_data.hdf5").is_file() or (folder / "data" / "main_data.hdf5").is_file():
        return [Dataset("episodes", folder)]
    files = sorted(folder.glob("**/data/main_data.hdf5"))
    return [Dataset("episodes", file.parents[1]) for file in files]
