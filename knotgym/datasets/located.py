"""Find the datasets that a path or an id names.

It may name a run's folder, a `minari` folder, a file, a folder of pictures, a Minari dataset or an
included set of states.
"""

from pathlib import Path
from typing import NamedTuple

from knotgym.common import InvalidInput, format_of, require_no_links
from knotgym.datasets.episode_dataset import FILE, FORMAT, episode_file, open_episodes
from knotgym.datasets.image_table import is_images, shards
from knotgym.datasets.minari_form import dataset_files
from knotgym.states import minari_root, resolve, resolve_states


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
        for one in self.episodes:
            data = episode_file(one)
            files += dataset_files(data.parent) if one.is_dir() else [data]
        return files

    def only(self, *kinds: str) -> "Located":
        """Return this if it is one dataset, of one of these kinds if there are any.

        Raises:
            InvalidInput: it is several datasets, or of another kind.
        """
        if kinds and self.kind not in kinds:
            raise InvalidInput(
                f"{self.root} contains {self.kind}, but this command takes {' or '.join(kinds)}"
            )
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
    found = _located(root)
    if found is None:
        raise InvalidInput(
            f"{named} contains no states.h5, no pictures and no Minari dataset: give the output of"
            " a knotgym command"
        )
    require_no_links(root, found.files)
    return found


def _located(root: Path) -> Located | None:
    if is_images(root):
        return Located(root, pictures=root)
    if root.is_file():
        is_episodes = format_of(root) == FORMAT
        return Located(root, episodes=(root,)) if is_episodes else Located(root, states=root)
    if any((root / name).is_file() for name in ("states.h5", "manifest.json")):
        return Located(root, resolve_states(root), _datasets_below(root / "minari"))
    found = _datasets_below(root)
    return Located(root, episodes=found) if found else None


def refuse_minaris_folder(out: Path) -> None:
    """Raise InvalidInput if a plain file would be written into Minari's folder."""
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise InvalidInput(
            f"{out} is in Minari's folder, where Minari can't read a plain file: merge with --id"
            " knotgym/name-v0, or give another --out"
        )


def _datasets_below(folder: Path) -> tuple[Path, ...]:
    if (folder / FILE).is_file() or (folder / "data" / FILE).is_file():
        return (folder,)
    return tuple(file.parents[1] for file in sorted(folder.glob(f"**/data/{FILE}")))
