"""What a name stands for: a path, a Minari dataset by its id, or an included set of states.

Users give names in commands, keywords and settings, and files hold them. All are resolved here.
"""

import os
from importlib.resources import files
from pathlib import Path

from knotgym.common import InvalidFile, MissingFile, require_no_links

SETS = {"readable": "states.h5"}  # name -> file
SETS |= {name: f"{name}.h5" for name in ("random-walk", "hard-unknots", "bench")}


def shipped(name: str = "readable") -> Path:
    """Return the path of a set of states that the package includes.

    Args:
        name: "readable", curated so that the code can be read off the picture, or "random-walk", as
            random play reaches them without over-twisted ones, each with 17 loops and 40 states for
            each nx from 1 to 4; or "hard-unknots", unknots with 7, 10 and 11 crossings, of which
            those with 10 and 11 have neither kinks nor bigons; or "bench", 256 train and 256 test
            states of each nx from 0 to 5, legible as the readable ones, of ropes that the splits
            don't share.

    Raises:
        InvalidFile: there is no set of that name.
    """
    if name not in SETS:
        raise InvalidFile(f"no shipped set of states {name!r}; there are {', '.join(SETS)}")
    return Path(str(files("knotgym.states") / "curated" / SETS[name]))


def is_bundled(named: str | os.PathLike[str] | None) -> bool:
    """Whether a task's `states` names an included set; None means "readable"."""
    return named is None or named in SETS


def minari_root() -> Path:
    """Return the root folder of Minari datasets: MINARI_DATASETS_PATH, else Minari's default."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def resolve(named: str | os.PathLike[str] | None, *files: str) -> Path:
    """Return the file or folder that a name stands for, or a file in it.

    Args:
        named: the name of an included set (None for "readable"), which a file of that name doesn't
            hide, because stored tasks name sets, too; else a path that exists; else the id of a
            Minari dataset. A `Path` is a path, whether there is a file or not.
        files: names of the file that is wanted of a folder or of the folder `data` in it. The first
            that is there is returned; if none is, the path where the first should be.

    Raises:
        MissingFile: there is no such file, folder, id or set.
        InvalidFile: the folder's file is a link, which could lead to a private file of the user.
    """
    if named is None or named in SETS:
        return shipped(str(named or "readable"))
    path, minari = Path(named), minari_root() / named
    if not isinstance(named, Path) and not path.exists():
        outside = path.is_absolute() or ".." in path.parts
        if outside or not minari.is_dir():
            raise MissingFile(
                f"no such file: {path}, nor a Minari dataset of this id under {minari_root()},"
                f" nor an included set ({', '.join(SETS)})"
            )
        path = minari
    if not files or not path.is_dir():
        return path
    places = [folder / name for name in files for folder in (path, path / "data")]
    found = next((one for one in places if one.exists()), places[0])
    require_no_links(path, [found])
    return found


def resolve_states(named: str | os.PathLike[str] | None) -> Path:
    """Return the state file that a name stands for, as `resolve` takes it."""
    return resolve(named, "states.h5")
