"""What a path or an id names: a run's folder, a `minari` folder, a file, a folder of pictures, or a
Minari dataset, all of them asked for in the same way.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from knotgym.datasets.image_table import is_images
from knotgym.datasets.state_schema import FORMAT as STATES_FORMAT
from knotgym.datasets.states import SHIPPED, minari_root, shipped
from knotgym.errors import KnotgymError, MissingFile
from knotgym.hdf5_files import hdf5_format


class UnknownDataset(KnotgymError, ValueError):
    """Nothing of ours is at this path."""


class Place(NamedTuple):
    """A dataset, and where it is.

    Attributes:
        kind: "states", "episodes" or "images".
        path: a folder or a file.
    """

    kind: str
    path: Path


def places(named: str) -> list[Place]:
    """What a path, an id or a set that ships holds: of a run the states, of a folder of Minari
    datasets each.

    Raises:
        MissingFile: there is no such file, folder or id.
        UnknownDataset: the folder holds nothing of ours.
    """
    given = Path(named)
    if not given.exists() and named in SHIPPED:
        given = shipped(named)
    if not given.exists():
        given = minari_root() / named
        if not given.is_dir():
            raise MissingFile(
                f"no such file: {named}, nor a Minari dataset of this id under {minari_root()},"
                f" nor a set that ships ({', '.join(SHIPPED)})"
            )
    if is_images(given):
        return [Place("images", given)]
    if given.is_file():
        kind = "states" if hdf5_format(given) in (STATES_FORMAT, None) else "episodes"
        return [Place(kind, given)]
    if any((given / name).is_file() for name in ("states.h5", "manifest.json")):
        return [Place("states", given)]
    found = _datasets_below(given)
    if not found:
        raise UnknownDataset(
            f"{named} holds no states.h5, no pictures and no Minari dataset: give what a knotgym"
            " command made"
        )
    return found


def folder_of(named: str) -> Path:
    """The folder that a path or an id names, of a file the one that it lies in.

    Raises:
        MissingFile, UnknownDataset: as `places`.
    """
    places(named)
    given = Path(named) if Path(named).exists() else minari_root() / named
    return given if given.is_dir() else given.parent


def place(named: str, *kinds: str) -> Place:
    """The one dataset that a path or an id names.

    Raises:
        MissingFile: there is nothing.
        UnknownDataset: there are several, or none of these kinds.
    """
    found = places(named)
    if len(found) > 1:
        listed = ", ".join(str(one.path) for one in found)
        raise UnknownDataset(f"{named} holds several datasets, name one of them: {listed}")
    if kinds and found[0].kind not in kinds:
        raise UnknownDataset(f"{named} holds {found[0].kind}, and this is for {' or '.join(kinds)}")
    return found[0]


def episodes_at(named: str) -> list[Place]:
    """The trajectory datasets that a path or an id names; of a run's folder its demonstrations.

    Raises:
        MissingFile: there is nothing.
        UnknownDataset: there are none.
    """
    out: list[Place] = []
    for one in places(named):
        inside = one.path / "minari" if one.kind == "states" else one.path
        out += [one] if one.kind == "episodes" else _datasets_below(inside)
    if not out:
        raise UnknownDataset(f"{named} holds no trajectories")
    return out


def name_of(dataset: Path) -> str:
    """A file name for a dataset: the end of its id.

    >>> name_of(Path("minari/knotgym/tie-nx3/demonstrations-v0"))
    'tie-nx3-demonstrations-v0'
    """
    return "-".join(dataset.with_suffix("").parts[-2:])


def _datasets_below(folder: Path) -> list[Place]:
    if (folder / "main_data.hdf5").is_file() or (folder / "data" / "main_data.hdf5").is_file():
        return [Place("episodes", folder)]
    files = sorted(folder.glob("**/data/main_data.hdf5"))
    return [Place("episodes", file.parents[1]) for file in files]
