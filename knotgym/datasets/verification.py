"""Whether a dataset of any kind tells the truth: one function that finds out what a path or an id
holds and asks the check that is for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from knotgym.configuration import read_json
from knotgym.datasets.episode_reader import Count, uncounted
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.datasets.image_table import is_images
from knotgym.datasets.machine import others
from knotgym.datasets.state_schema import FORMAT
from knotgym.datasets.state_verification import folder_faults, overlap_faults, state_faults
from knotgym.datasets.states import read_states, shipped
from knotgym.hdf5_files import hdf5_format

# what the faults of replays say, which another machine's rounding may be behind
_REPLAYED = ("bit for bit", "acted out again")
OVERLAPS = "overlaps.json"  # beside the sets that ship: file -> nx -> `splits.overlap`
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # as the built-in `map`


def verify(source: str | os.PathLike[str]) -> list[str]:
    """Check everything that a dataset says: checksums, schema, labels by two labellers, replays bit
    for bit, pictures, splits.

    Args:
        source: a folder or a file that knotgym wrote, or the id of a Minari dataset.

    Returns:
        Faults, each naming the file and where it can the row or step; empty when all is well.

    Raises:
        FileNotFoundError: there is nothing at `source`.
        MissingExtra: it is a perception table and pyarrow isn't installed.
    """
    return list(faults(source))


def faults(
    source: str | os.PathLike[str], each: Map = map, count: Count = uncounted
) -> Iterator[str]:
    """As `verify`, each fault as soon as it is found; `each` as of `image_faults`, and `count` told
    what is looked at, how many were, and of how many.

    Where nothing is wrong but that replays end elsewhere, and the run names another machine than
    this, the last line says so.
    """
    elsewhere, wrong = False, False
    for fault in _faults(source, each, count):
        replayed = any(phrase in fault for phrase in _REPLAYED)
        elsewhere, wrong = elsewhere or replayed, wrong or not replayed
        yield fault
    given = Path(source)
    unlike = others(given) if elsewhere and not wrong and given.is_dir() else ""
    if unlike:
        yield (
            f"{given}: made on another machine, {unlike}, which may round otherwise; all but the"
            " replays is as it was written"
        )


def _faults(source: str | os.PathLike[str], each: Map, count: Count) -> Iterator[str]:
    given = Path(source)
    if is_images(given):
        # here, because it alone needs pyarrow and the walks' simulation
        from knotgym.datasets.image_verification import image_faults

        yield from image_faults(given, each, count)
    elif given.is_dir() and any((given / n).is_file() for n in ("manifest.json", "states.h5")):
        yield from folder_faults(given, count)
    elif given.is_file() and hdf5_format(given) in (FORMAT, None):
        states = read_states(given)
        yield from state_faults(states, count)
        said = read_json(given.with_name(OVERLAPS)) if given.parent == shipped().parent else {}
        yield from overlap_faults(states, said.get(given.name, {}), OVERLAPS)
    else:
        yield from verify_episodes(str(source), act_out=True, threads=0, count=count)
