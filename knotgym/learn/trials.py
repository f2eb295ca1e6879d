"""Whether a learner succeeds while it trains: episodes that it plays, and the learning curve.

It needs no torch, so that learners of any library are drawn as `knotgym train` draws its own.
"""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from knotgym.common import Array, Stream, atomic_write
from knotgym.control import make_policy, rollouts
from knotgym.envs import TaskConfig

_ROWS = 100  # of a learning curve, at most
_INKS = "#1f77b4", "#ff7f0e"  # of losses


@dataclass(frozen=True)
class Trials:
    """Episodes of the train split that no dataset has, for a learner to play while it trains.

    Attributes:
        tasks: which they are of, in turn.
        count: how many there are.
        seed: of the training.
    """

    tasks: Sequence[TaskConfig]
    count: int
    seed: int = 0

    def success(self, policy: Any) -> float:
        """Play the episodes; return the success rate of a policy, see `control.make_policy`."""
        policy, won = make_policy(policy), 0
        for k, task in enumerate(self.tasks):
            few = range(self.count)[k :: len(self.tasks)]
            seeds = [Stream.LEARN_TRIAL.derived_seed(self.seed, number) for number in few]
            task = replace(task, observation="state", endless=False)
            won += int(rollouts(policy, task, seeds, keep=None).episodes["success"].sum())
        return won / self.count

    def draw(
        self,
        out: Path,
        names: Sequence[str],
        curve: Sequence[Iterable[float]],
        kept: int | None = None,
    ) -> None:
        """Write losses and success rates to `training.csv`, and plot them in `curve.png`.

        Args:
            out: folder.
            names: of the losses, one or two.
            curve: step, losses and success rate, at least one row; many are averaged in groups.
            kept: the step whose weights are kept.
        """
        rows = np.array(curve, dtype=np.float64)
        # at most _ROWS groups of neighbouring rows, each shown by its mean
        groups = np.array_split(rows, range(0, len(rows), -(-len(rows) // _ROWS))[1:])
        rows = np.array([[group[-1, 0], *map(_mean, group[:, 1:].T)] for group in groups])
        with atomic_write(out / "training.csv") as part, part.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("step", *names, "success"))
            writer.writerows([int(row[0]), *row[1:].round(5).tolist()] for row in rows)
        with atomic_write(out / "curve.png") as part:
            self._plot(names, rows, kept).save(part, "PNG")

    def _plot(self, names: Sequence[str], rows: Array, kept: int | None) -> Image.Image:
        """Plot losses and success rates against steps, with axes, ticks and a legend."""
        width, height, left, right, top, bottom = 720, 420, 64, 656, 48, 368
        image = Image.new("RGB", (width, height), "white")
        draw = ImageDraw.Draw(image)
        steps, losses = float(rows[-1, 0]), rows[:, 1:-1]
        # those of actor and critic may be negative
        least, most = min(0.0, float(losses.min())), max(float(losses.max()), 1e-9)

        def _at(step: float, loss: float) -> tuple[float, float]:
            height = (loss - least) / (most - least)
            return left + step / steps * (right - left), bottom - height * (bottom - top)

        def _write(text: str, x: float, y: float, anchor: str) -> None:
            draw.text((x, y), text, "black", anchor=anchor, font_size=13)

        for tick in _ticks(most):
            draw.line([_at(0, tick), _at(steps, tick)], "#e1e1e1")
            _write(f"{tick:g}", left - 8, _at(0, tick)[1], "rm")
        for tick in _ticks(steps):
            x = _at(tick, 0)[0]
            draw.line([(x, bottom), (x, bottom + 5)], "black")
            _write(f"{tick:g}", x, bottom + 8, "mt")
        draw.line([(left, top), (left, bottom), (right, bottom)], "black")
        _write("loss", left, top - 8, "mb")
        legend = [*zip(names, _INKS, strict=False)]
        played = rows[~np.isnan(rows[:, -1])]
        says = f"; success in {self.count} episodes of the train split, in no dataset"
        _write(f"optimizer step{says * bool(len(played))}", (left + right) / 2, height - 8, "mb")
        if len(played):
            scale = most - least
            points = [_at(step, least + rate * scale) for step, rate in played[:, [0, -1]].tolist()]
            draw.line(points, "#2ca02c", 2)
            for x, y in points:
                draw.ellipse((x - 3, y - 3, x + 3, y + 3), "#2ca02c")
            for share in (0, 0.5, 1):  # the axis on the right
                _write(f"{100 * share:.0f} %", right + 8, _at(0, least + share * scale)[1], "lm")
        for column, (_, ink) in enumerate(legend, 1):
            draw.line([_at(*point) for point in rows[:, [0, column]].tolist()], ink, 2)
        if len(played):
            legend.append(("success", "#2ca02c"))
        if kept is not None:
            draw.line([_at(kept, least), _at(kept, most)], "#787878")
            legend.append((f"kept weights: step {kept}", "#787878"))
        for number, (name, ink) in enumerate(legend):
            x = left + 50 + 140 * number
            draw.line([(x, top - 15), (x + 24, top - 15)], ink, 2)
            _write(name.replace("_", "-"), x + 32, top - 15, "lm")
        return image


def _mean(values: Array) -> float:
    """Return the mean of the values that are known, NaN if none is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


def _ticks(most: float) -> list[float]:
    """Return round numbers from 0 to `most`, at most six and at least three of them.

    >>> _ticks(3000), _ticks(0.7)
    ([0.0, 1000.0, 2000.0, 3000.0], [0.0, 0.2, 0.4, 0.6])
    """
    power = 10.0 ** math.floor(math.log10(max(most, 1e-9)))
    step = next(digit * power for digit in (0.2, 0.5, 1, 2) if most < 6 * digit * power)
    return [round(k * step, 12) for k in range(int(most / step + 1e-9) + 1)]
