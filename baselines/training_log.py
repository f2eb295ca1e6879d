"""A callback for Stable-Baselines3 that records the learning curve and saves checkpoints.

Requires stable-baselines3, so import this module only once that is known to be installed.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from knotgym.common.atomic_files import atomic_write
from knotgym.runs.intervals import wilson

CURVE, PICTURE, CHECKPOINTS = "curve.json", "curve.png", "checkpoints"
ROW = 8192  # steps from which a row of the curve is closed
WIDTH, HEIGHT, EDGE = 720, 400, 56
BLUE, PALE, BLACK, GREY = (31, 119, 180), (205, 224, 238), (0, 0, 0), (210, 210, 210)


@dataclass(frozen=True, kw_only=True)
class Row:
    """Statistics of the training episodes that ended within one interval of steps.

    Attributes:
        steps: environment steps from the start of the training to the end of the interval.
        episodes, successes: numbers of episodes.
        mean_return, mean_length: None if no episode ended.
        seconds, cpu_seconds: time spent since the start, including runs before a --resume up to
            their last checkpoint.
    """

    steps: int
    episodes: int
    successes: int
    mean_return: float | None
    mean_length: float | None
    seconds: float
    cpu_seconds: float


def read_rows(folder: Path, steps: int) -> tuple[list[Row], list[int]]:
    """Read the rows of a training up to `steps`, and the steps at which it was resumed.

    Raises:
        OSError, ValueError, KeyError, TypeError: the file is missing or corrupted, or has no row
            that ends at `steps`.
    """
    fields = json.loads((folder / CURVE).read_text(encoding="utf-8"))
    rows = [row for row in (Row(**one) for one in fields["rows"]) if row.steps <= steps]
    if not rows or rows[-1].steps != steps:
        raise ValueError(f"{CURVE} has no row that ends at {steps} steps")
    return rows, [int(one) for one in fields["resumed_at"]]


def write_rows(folder: Path, rows: list[Row], resumed_at: list[int]) -> None:
    """Write `curve.json` and `curve.png`."""
    fields = {"resumed_at": resumed_at, "rows": [asdict(row) for row in rows]}
    with atomic_write(folder / CURVE) as part:
        part.write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")
    if rows:
        _, encoded = cv2.imencode(".png", plot(rows)[..., ::-1])
        with atomic_write(folder / PICTURE) as part:
            part.write_bytes(encoded.tobytes())


def plot(rows: list[Row]) -> NDArray[np.uint8]:
    """Plot the success rate over steps with Wilson's 95 % interval: uint8 (HEIGHT, WIDTH, 3)."""
    image = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    filled = [row for row in rows if row.episodes]
    rates = [row.successes / row.episodes for row in filled]
    ends = [wilson(row.successes, row.episodes) for row in filled]
    most = max((high for _, high in ends), default=1.0)
    top = next(one for one in (0.1, 0.2, 0.5, 1.0) if one >= most)
    across = [EDGE + row.steps / rows[-1].steps * (WIDTH - 2 * EDGE) for row in filled]

    def line(values: list[float]) -> NDArray[np.int32]:
        down = [HEIGHT - EDGE - value / top * (HEIGHT - 2 * EDGE) for value in values]
        return np.rint(np.array([across, down]).T).reshape(-1, 2).astype(np.int32)

    low, high = line([low for low, _ in ends]), line([high for _, high in ends])
    if filled:
        cv2.fillPoly(image, [np.concatenate([low, high[::-1]])], PALE, cv2.LINE_AA)
    for part in range(6):
        y = HEIGHT - EDGE - round(part / 5 * (HEIGHT - 2 * EDGE))
        cv2.line(image, (EDGE, y), (WIDTH - EDGE, y), GREY)
        _write(image, f"{100 * top * part / 5:.0f}", (EDGE - 34, y + 5))
    if filled:
        cv2.polylines(image, [line(rates)], False, BLUE, 2, cv2.LINE_AA)
    title = f"success rate per {ROW:,} steps, %, with 95 % interval"
    _write(image, title, (EDGE, 30))
    _write(image, "0", (EDGE, HEIGHT - EDGE + 24))
    _write(image, f"{rows[-1].steps:,} steps", (WIDTH - EDGE - 120, HEIGHT - EDGE + 24))
    return image


def _write(image: NDArray[np.uint8], text: str, place: tuple[int, int]) -> None:
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, BLACK, 1, cv2.LINE_AA)


class TrainingLog(BaseCallback):
    """Record the learning curve; save a checkpoint between rollouts every `every` steps.

    Attributes:
        rows: rows of the curve so far.
        resumed_at: steps at which the training was resumed.
    """

    def __init__(
        self, folder: Path, every: int, rows: list[Row], resumed_at: list[int], console: Console
    ) -> None:
        super().__init__()
        self.folder, self.rows, self.resumed_at = folder, rows, resumed_at
        self._every, self._console = every, console
        self._ended: list[tuple[bool, float, float]] = []
        last = rows[-1] if rows else None
        self._began = time.perf_counter() - (last.seconds if last else 0.0)
        self._spent = time.process_time() - (last.cpu_seconds if last else 0.0)
        self._row_began = self._saved = last.steps if last else 0

    def save(self) -> None:
        """Write a checkpoint and the curve up to it."""
        self._saved = self.num_timesteps
        write_rows(self.folder, self.rows, self.resumed_at)
        with atomic_write(checkpoint(self.folder, self.num_timesteps)) as part:
            self.model.save(part)

    def _on_rollout_start(self) -> None:
        if self.num_timesteps // self._every > self._saved // self._every:
            self.save()

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], self.locals["dones"]
        for info in (info for info, done in zip(infos, dones, strict=True) if done):
            one: dict[str, Any] = info["episode"]
            self._ended.append((info["is_success"], float(one["r"]), float(one["l"])))
        if self.num_timesteps - self._row_began >= ROW:
            self._end_row()
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps > self._row_began:
            self._end_row()
        row = self.rows[-1]
        self._console.print(
            f"{row.steps:,} steps: {row.successes} of the last {row.episodes} episodes succeeded,"
            f" {row.steps / row.seconds:.0f} steps per second",
            highlight=False,
        )

    def _end_row(self) -> None:
        wins, returns, lengths = zip(*self._ended, strict=True) if self._ended else ((), (), ())
        self.rows.append(
            Row(
                steps=self.num_timesteps,
                episodes=len(wins),
                successes=sum(wins),
                mean_return=round(float(np.mean(returns)), 4) if wins else None,
                mean_length=round(float(np.mean(lengths)), 2) if wins else None,
                seconds=round(time.perf_counter() - self._began, 2),
                cpu_seconds=round(time.process_time() - self._spent, 2),
            )
        )
        self._ended, self._row_began = [], self.num_timesteps


def checkpoint(folder: Path, steps: int) -> Path:
    """Return the path of the checkpoint after `steps` steps."""
    return folder / CHECKPOINTS / f"{steps:09d}.zip"


def checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints of a folder, oldest first."""
    found = [path for path in (folder / CHECKPOINTS).glob("*.zip") if path.stem.isdecimal()]
    return sorted(found, key=lambda path: int(path.stem))
