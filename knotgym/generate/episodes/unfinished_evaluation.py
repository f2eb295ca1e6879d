"""Checkpoints of an evaluation, kept in a staging folder beside its output file."""

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from knotgym.common.atomic_files import atomic_write
from knotgym.runs.engine import REQUEST, require_startable
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing, InvalidRun
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.runs.staging import staging

_PLAYED = "played.json"
_PAUSE = 2.0  # minimum seconds between two checkpoints


class PlayedEpisode(NamedTuple):
    """Outcome of one episode; `start` and `goal` are rows of the state file."""

    start: int
    goal: int
    success: bool
    steps: int
    total: float
    planned_actions: int
    planning_seconds: float
    failed: bool


class Unfinished:
    """The finished pieces of an evaluation by number, saved to a file if there is one."""

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
        """Add a finished piece, and save if the last checkpoint is old enough."""
        self.pieces[number] = list(piece)
        if time.monotonic() > self._saved + _PAUSE:
            self.save()

    def save(self) -> None:
        """Write the checkpoint atomically."""
        if self._path is not None:
            write_sealed(self._path, {str(number): piece for number, piece in self.pieces.items()})
            self._saved = time.monotonic()


@contextmanager
def kept_beside(
    out: Path | None, asked: dict[str, Any], existing: Existing, progress: Progress
) -> Iterator[Unfinished]:
    """Hold the checkpoint of an evaluation that will write `out`.

    It is removed when the block ends normally, or if nothing was played.

    Raises:
        InvalidRun: the checkpoint belongs to another evaluation or is corrupted.
        Occupied: another process holds it, or an interrupted evaluation left work.
    """
    if out is None:
        yield Unfinished()
        return
    require_startable(out, asked, existing, (), progress)
    with staging(out, existing) as folder:
        try:
            unfinished = Unfinished(folder / _PLAYED)
        except (TypeError, ValueError) as error:
            raise InvalidRun(f"{folder / _PLAYED} is corrupted; --restart starts again") from error
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
