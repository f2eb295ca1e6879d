"""Where states come from: how they were made, the names of their splits, and the files that hold
them.

`knotgym generate` makes states by the record of their source in SOURCES, cards describe it, and
`verify` checks by it what led to a row. Commands and files may name no other source.

Users give names in commands, keywords and settings, and files hold them: a path, a Minari dataset
by its id, or an included set of states. `resolve` says what a name stands for.
"""

import os
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from knotgym.common import InvalidFile, Kinds, MissingFile, Stream, require_no_links, sha256
from knotgym.rope import CHAIN, MUJOCO, EngineName
from knotgym.topology import GaussCode, Symmetry, canonical


class Split(NamedTuple):
    """Everything in which one split differs from the others.

    Attributes:
        base: the split of states whose rows it has.
        by_code: whether it has only those of its base whose diagram is held out, or isn't, see
            `States.rows`.
        of_states: whether rows of states are in it; splits by code are parts of others.
        is_made: whether recipes divide states between it and the other such split.
        trains: whether learners may see its rows.
        of_pictures: whether a table of pictures may have it.
        tested_on: the split of states on which its episodes' learners are tested.
    """

    base: str
    by_code: bool = False
    of_states: bool = False
    is_made: bool = False
    trains: bool = False
    of_pictures: bool = False
    tested_on: str = "test"


SPLITS = Kinds(
    "split",
    {
        "train": Split("train", of_states=True, is_made=True, trains=True, of_pictures=True),
        "test": Split("test", of_states=True, is_made=True, of_pictures=True),
        # parts of "train" and "test" without a common diagram
        "train-code": Split("train", by_code=True, trains=True, tested_on="test-code"),
        "test-code": Split("test", by_code=True, of_pictures=True, tested_on="test-code"),
    },
)
STATE_SPLITS = tuple(name for name, split in SPLITS.items() if split.is_made)
# of pictures: test-code has held-out codes, test-nx a held-out crossing number
IMAGE_SPLITS = (*(name for name, split in SPLITS.items() if split.of_pictures), "test-nx")

SETS = {"readable": "states.h5"}  # included sets: name -> file
SETS |= {name: f"{name}.h5" for name in ("random-walk", "hard-unknots", "bench")}


class Source(NamedTuple):
    """A source of states.

    Attributes:
        doc: what states of it are; a sentence or more for cards, in Markdown.
        stream: of the keys that its rows have as seeds; None if their seeds are no keys.
        rows: recipe that makes its rows, or "module:function" of it: (GenerateConfig, report to
            fill, points of states that none may be near) -> Recipe[Table]; None if
            `knotgym generate` doesn't make them.
        splits: rule that assigns rows to splits, or "module:function" of it: (GenerateConfig,
            Table) -> str (n,).
        engine: that moves the ropes unless another is asked for.
        from_ropes: whether its states are frames of pulled ropes, so that no code, knot or length
            of the rope can be asked for.
        draws_actions: whether the actions that lead to a row are `rope.drawn_actions` of its seed,
            and so aren't stored.
    """

    doc: str
    stream: Stream | None = None
    rows: Callable[..., Any] | str | None = None
    splits: Callable[..., Any] | str | None = None
    engine: EngineName = MUJOCO
    from_ropes: bool = False
    draws_actions: bool = False

    def function(self, which: str) -> Callable[..., Any]:
        """Return `rows` or `splits`, imported if it is named."""
        function: Any = getattr(self, which)
        assert function is not None  # GenerateConfig refuses sources that have none
        return resolve_name(function) if isinstance(function, str) else function


_ROPES = "All frames of a rope are in one split."
_PLAYED = "knotgym.generate.play_source:"
_DRAWN = "knotgym.generate.drawing_source:"


SOURCES = Kinds(  # by the value of `source/policy`
    "source",
    {
        "drawing": Source(
            "drawn from its code. The drawing is made again from the row's seed, laid in the"
            " simulator, stirred and left to rest by the row's actions.",
            Stream.DRAWING,
            f"{_DRAWN}drawn_rows",
            f"{_DRAWN}splits_of",
        ),
        "play": Source(
            "a frame of a rope that random and scripted policies pulled, if it is readable, not"
            f" over-twisted and new. The row's actions lead from its start to its state. {_ROPES}",
            Stream.PLAYED_ROPE,
            f"{_PLAYED}rows_of_ropes",
            f"{_PLAYED}splits_of",
            engine=CHAIN,
            from_ropes=True,
        ),
        "random-walk": Source(
            "a state as uniform random actions reach it, not selected to be easier to read; only"
            " over-twisted ones are left out. The actions of a row are drawn from its random"
            f" stream. {_ROPES}",
            Stream.RANDOM_WALK,
            f"{_PLAYED}rows_of_ropes",
            f"{_PLAYED}splits_of",
            from_ropes=True,
            draws_actions=True,
        ),
        "import": Source("a curve of a file, laid and left to rest.", Stream.IMPORT),
        # of sets that the package includes
        "demonstrations": Source(
            "met in play; the row's actions lead from a plain loop to its state."
        ),
        "bench-play": Source("met in play, laid from its vertices."),
        "bench-drawing": Source("drawn from its code, laid from its vertices."),
    },
)


def held_form(code: str, *, marked: bool) -> str:
    """Return what a split of pictures by code compares, in place of a Gauss code.

    Args:
        code: without chirality.
        marked: whether all pictures mark base and direction. If not, a picture fits every code of
            its diagram, so these are one: `topology.canonical`, which also takes mirror images
            and switched crossings for the same.
    """
    return code if marked else str(canonical(GaussCode.parse(code), Symmetry.DIAGRAM))


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
    wanted = next((place for place in places if place.exists()), places[0])
    require_no_links(path, [wanted])
    return wanted


def states_mark(named: str | os.PathLike[str] | None) -> str:
    """Return what an id says of states: "" for "readable", a set's name, or a file's digest."""
    if is_bundled(named):
        return "" if named in (None, "readable") else str(named)
    return f"states{sha256(resolve_states(named))[:8]}"


def resolve_states(named: str | os.PathLike[str] | None) -> Path:
    """Return the state file that a name stands for, as `resolve` takes it."""
    return resolve(named, "states.h5")
