"""Find the datasets that a path or an id names.

It may name a run's folder, a `minari` folder, a file, a folder of pictures, a Minari dataset or an
included set of states. Some corrupted files make the HDF5 library crash or loop forever, which no
check in Python can prevent: `try_files` reads them in another process first.
"""

import os
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import BrokenExecutor, Executor
from pathlib import Path
from typing import NamedTuple

import h5py

from knotgym.common import (
    InvalidFile,
    InvalidInput,
    Threads,
    format_of,
    require_no_links,
    require_output,
    require_stored,
)
from knotgym.datasets.episode_dataset import FORMAT, datasets_below, episode_file, open_episodes
from knotgym.datasets.image_table import read_table, shards
from knotgym.datasets.manifest import read_manifest
from knotgym.datasets.minari_form import data_files
from knotgym.states import minari_root, read_states, resolve, resolve_states

_LIMIT = 60.0  # seconds
_SLOWEST = 5_000_000  # bytes per second; a file adds the time that reading it at this rate takes


class Located(NamedTuple):
    """The datasets that a path or an id names.

    Attributes:
        root: the file or folder.
        states: a state file.
        episodes: files or folders of episodes; beside states, the demonstrations of the run.
        pictures: a perception table, file or folder.
    """

    root: Path
    states: Path | None = None
    episodes: tuple[Path, ...] = ()
    pictures: Path | None = None

    @property
    def kind(self) -> str:
        """What was named: "states", "episodes" or "images"."""
        return "images" if self.pictures else "states" if self.states else "episodes"

    @property
    def title(self) -> str:
        """The title of a card or a page."""
        alone = self.kind == "episodes" and len(self.episodes) == 1
        return open_episodes(self.episodes[0]).name if alone else self.root.resolve().name

    @property
    def folder(self) -> Path:
        """The folder; for a file, its parent."""
        return self.root if self.root.is_dir() else self.root.parent

    @property
    def files(self) -> list[Path]:
        """The files that hold the data."""
        files = shards(self.pictures) if self.pictures else []
        files += [self.states] if self.states else []
        for dataset in self.episodes:
            data = episode_file(dataset)
            files += data_files(data.parent) if dataset.is_dir() else [data]
        return files

    @property
    def listed(self) -> list[Path]:
        """The folders with a manifest; that of states or pictures lists what lies below, too."""
        folders = {self.root} if self.states or self.pictures else {self.root, *self.episodes}
        return sorted(folder for folder in folders if (folder / "manifest.json").is_file())

    def counts(self, sample: int = 0) -> Counter[str]:
        """Count what verification checks, if it plays so many drawn episodes; 0 for all."""
        counts = Counter[str]()
        if self.pictures:
            counts["pictures"] = len(read_table(self.pictures, columns=["nx"]))
        if self.states:
            states = read_states(self.states, images=False)
            counts["Gauss codes"] = len(states)
            counts["ropes of their points alone, not of a run"] = len(states) * (not states.source)
        for source in self.episodes:
            dataset = open_episodes(source)
            drawn = dataset.drawn(sample)
            counts["demonstrations" if self.states else "episodes"] += len(drawn)
            if len(drawn) < len(dataset):
                # no fault in n: with 95 % confidence at most 3 / n are wrong, the rule of three
                said = f"drawn of {len(dataset)} (95 % sure: under {300 / len(drawn):.2g} % wrong)"
                counts[said] = len(drawn)
            counts["steps replayed"] += int(drawn.episodes.episodes["length"].sum())
        lists = (read_manifest(folder)[0].get("files", {}) for folder in self.listed)
        counts["checksums"] = sum(map(len, lists))
        return counts

    def only(self, *kinds: str) -> "Located":
        """Return this if it is one dataset, of one of these kinds if there are any.

        Raises:
            InvalidInput: it is several datasets, or of another kind.
        """
        if kinds and self.kind not in kinds:
            raise InvalidInput(f"{self.root} contains {self.kind}, not {' or '.join(kinds)}")
        if self.kind == "episodes" and len(self.episodes) > 1:
            listed = ", ".join(map(str, self.episodes))
            raise InvalidInput(f"{self.root} contains several datasets, give one of them: {listed}")
        return self


def locate(named: str) -> Located:
    """Find the datasets that a path, a Minari id or the name of an included set stands for.

    Raises:
        MissingFile: there is no such file, folder or id.
        InvalidInput: the folder holds no knotgym dataset.
        InvalidFile: a file is a link, which could lead to a private file of the user.
    """
    root = resolve(named)
    located = _located(root)
    if located is None:
        by_minari = any((root / name).is_file() for name in ("metadata.json", "data/metadata.json"))
        theirs = " that knotgym wrote; what Minari recorded can be loaded, but not checked"
        raise InvalidInput(
            f"{named} contains no states.h5, no pictures and no Minari dataset{theirs * by_minari}"
        )
    require_no_links(root, located.files)
    return located


def _located(root: Path) -> Located | None:
    inside = any(root.glob("*.parquet")) or any(root.glob("data/*.parquet"))
    if inside or (root.is_file() and root.suffix == ".parquet"):
        return Located(root, pictures=root)
    if root.is_file():
        is_episodes = format_of(root) == FORMAT
        return Located(root, episodes=(root,)) if is_episodes else Located(root, states=root)
    listed = read_manifest(root)[0].get("files", {}) if root.is_dir() else {}
    if (root / "states.h5").is_file() or "states.h5" in listed:
        return Located(root, resolve_states(root), datasets_below(root / "minari"))
    datasets = datasets_below(root)
    return Located(root, episodes=datasets) if datasets else None


def require_file(
    out: Path,
    sources: Iterable[Path],
    overwrite: bool,
    *,
    folder: bool = False,
    pictures: bool = False,
) -> None:
    """Check that a plain file, or a folder of such, can be written.

    Args:
        out: its path.
        sources: what it is made from.
        overwrite: whether it may replace an older one.
        folder: whether it is a folder.
        pictures: whether it holds pictures, which are known by the suffix .parquet.

    Raises:
        InvalidInput: it is in Minari's folder, or has the suffix of another kind of file.
        Occupied: as of `require_output`.
    """
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise InvalidInput(
            f"{out} is in Minari's folder, where Minari can't read a plain file: merge with --id"
            " knotgym/name-v0, or give another --out"
        )
    if not folder and pictures != (out.suffix == ".parquet"):
        rule = "must end in .parquet, as files" if pictures else "must not end in .parquet, the end"
        raise InvalidInput(f"{out} {rule} of pictures")
    require_output(out, folder=folder, overwrite=overwrite, reads=sources)


def try_files(paths: Iterable[Path], pool: Executor) -> None:
    """Read files completely in a process of a pool; skip those that aren't HDF5.

    Raises:
        InvalidFile: a file makes the library crash or hang, or it can't read a column.
    """
    for path in paths:
        if not path.is_file() or not h5py.is_hdf5(path):
            continue
        busy = max(1.0, os.getloadavg()[0] / Threads.cores())  # others have their turn
        limit = busy * (_LIMIT + path.stat().st_size / _SLOWEST)
        try:
            if unread := pool.submit(_read_whole, path).result(limit):
                raise InvalidFile(f"{path} isn't whole: the HDF5 library can't read {unread}")
        except BrokenExecutor as error:
            raise InvalidFile(f"{path} makes the HDF5 library crash; don't open it") from error
        except TimeoutError:
            what = f"makes the HDF5 library hang: not read in {limit:.0f} s"
            raise InvalidFile(f"{path} {what}; don't open it") from None


def _read_whole(path: Path) -> str:
    """Read everything stored in a file but its links; return the first column that can't be.

    Our own readers map columns, and so read some whose description is damaged.
    """
    unread: list[str] = []

    def _look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        try:
            dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                require_stored(item, name)
                for part in item.iter_chunks() if item.chunks else ((),):
                    item[part]
        except OSError as error:
            unread.append(f"{name}: {error}")
        except Exception:  # the file's reader reports these
            return

    try:
        with h5py.File(path, "r", locking=False) as file:
            dict(file.attrs)
            file.visititems(_look)
    except Exception:  # as above
        pass
    return unread[0] if unread else ""
