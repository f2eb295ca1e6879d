"""What an evaluation has played, kept beside the file it will write, so that it can be gone on with
when it was killed.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from knotgym.atomic_files import atomic_write
from knotgym.runs.engine import REQUEST, require_startable
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing, InvalidRun
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.runs.staging import staging

_PLAYED = "played.json"
_PAUSE = 2.0  # seconds between two savings, at least


class PlayedEpisode(NamedTuple):
    """What is counted of one episode; `start` and `goal` are rows of the state file."""

    start: int
    goal: int
    success: bool
    steps: int
    total: float
    planned_actions: int
    planning_seconds: float
    failed: bool


class Unfinished:
    """The pieces of an evaluation that were played, by their number; saved in a file if there is
    one.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.pieces: dict[int, list[PlayedEpisode]] = {}
        self._path, self._saved = path, time.monotonic()
        if path is not None and path.exists():
            said = read_sealed(path)
            self.pieces = {
                int(number): [PlayedEpisode(*one) for one in piece]
                for number, piece in said.items()
            }

    def keep(self, number: int, piece: Sequence[PlayedEpisode]) -> None:
        """Take in a piece just played."""
        self.pieces[number] = list(piece)
        if time.monotonic() > self._saved + _PAUSE:
            self.save()

    def save(self) -> None:
        """Write what was played, whole or not at all."""
        if self._path is not None:
            write_sealed(self._path, {str(number): piece for number, piece in self.pieces.items()})
            self._saved = time.monotonic()


@contextmanager
def kept_beside(
    out: Path | None, asked: dict[str, Any], existing: Existing, progress: Progress
) -> Iterator[Unfinished]:
    """What was played of an evaluation that will write `out`; gone when it is written,
    or when nothing was played.

    Raises:
        InvalidRun: what is there to resume is of another evaluation, or damaged.
        Occupied: another process is at it, or an interrupted evaluation left work unasked for.
    """
    if out is None:
        yield Unfinished()
        return
    require_startable(out, asked, existing, (), progress)
    with staging(out, existing) as folder:
        try:
            unfinished = Unfinished(folder / _PLAYED)
        except (TypeError, ValueError) as error:
            raise InvalidRun(f"{folder / _PLAYED} is damaged; --restart begins anew") from error
        with atomic_write(folder / REQUEST) as temporary:
            temporary.write_text(json.dumps(asked, indent=1, sort_keys=True), encoding="utf-8")
        try:
            yield unfinished
        except BaseException:
            if unfinished.pieces:
                unfinished.save()
            else:
                shutil.rmtree(folder)
            raise
    shutil.rmtree(folder)
