"""A training: optimizer steps, with one checkpoint that the next one replaces.

Each step draws from its own random stream, so a resumed training draws what an uninterrupted one
would have drawn, and ends with the same bits.

After a change run `pytest tests/learn/test_training.py`: an interrupted training must end with the
same weights.
"""

import csv
import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from knotgym.common import Array, InvalidFile, atomic_write, one_line, require_regular
from knotgym.runs import Progress, checkpoint_of

# chosen without comparison; learners that exist don't depend on them, their scores in
# docs/benchmark.md are of these
_WARM_UP, _LEAST_RATE = 50, 0.02  # steps over which the rate rises; share of the peak at the end
_CURVE_ROWS = 100  # of a learning curve, at most


Log = Callable[[int, dict[str, float]], None]  # takes a step, and values by name


class Trained(NamedTuple):
    """What a training ends with.

    Attributes:
        network: on the CPU.
        facts: of the training, for the card.
        summary: in a line.
        kept: the step whose weights it has; None for the last.
        others: tensors that belong to the learner beside the network's.
    """

    network: nn.Module
    facts: dict[str, Any]
    summary: str
    kept: int | None = None
    others: dict[str, Tensor] | None = None


class Training(ABC):
    """A network in training.

    Attributes:
        LEARNER, NAME: what the network is part of, as a folder has it, and what it is called.
        LOSSES: names of the two losses.
        network: as trained so far.
        step: steps done.
        losses: of each row of the learning curve the step, two losses, and the success rate of the
            episodes that the learner played then, NaN if it played none.
    """

    LEARNER: ClassVar[str]
    NAME: ClassVar[str]
    LOSSES: ClassVar[tuple[str, str]]

    def __init__(self, network: nn.Module, rate: float, decay: float, steps: int) -> None:
        """Train `network` for `steps` steps; `decay` is that of the weights."""
        # more threads would sum in another order and round otherwise
        torch.set_num_threads(1)
        self.network, self.steps, self._rate = network, steps, rate
        self._optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=decay)
        self.step, self.losses = 0, list[tuple[float, float, float, float]]()

    @abstractmethod
    def _advance(self) -> None:
        """Take one step or several."""

    @abstractmethod
    def _ended(self) -> Trained:
        """Return what all steps led to."""

    def _minimize(self, loss: Tensor) -> None:
        """Take one optimizer step; the rate rises linearly, then falls by a cosine."""
        # from 1 to 0 by half a cosine over the whole training, down to _LEAST_RATE of the peak
        falling = 0.5 + 0.5 * math.cos(math.pi * self.step / self.steps)
        rate = self._rate * min(1.0, (self.step + 1) / _WARM_UP)
        for group in self._optimizer.param_groups:
            group["lr"] = rate * (_LEAST_RATE + (1 - _LEAST_RATE) * falling)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        # one odd batch may not undo what many have learned
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        self.step += 1

    def _parts(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors to keep beside the optimizer's, which are changed in place."""
        return {"network": self.network.state_dict()}

    def _save(self, path: Path) -> None:
        """Write the checkpoint, with a digest; it replaces the one before at once."""
        # AdamW's two means and its count for each parameter: without them a resumed training would
        # take other steps
        moments = self._optimizer.state_dict()["state"]
        parts = {**self._parts(), **{f"optimizer {number}": own for number, own in moments.items()}}
        kept = {f"{part}/{k}": one for part, own in parts.items() for k, one in own.items()}
        kept["losses"] = torch.tensor(self.losses, dtype=torch.float64).reshape(-1, 4)
        kept["step"] = torch.tensor([self.step])
        kept = {name: own.detach().cpu().contiguous() for name, own in kept.items()}
        content = save(kept)
        with atomic_write(path) as part:
            part.write_bytes(hashlib.sha256(content).digest() + content)

    def _restore(self, path: Path) -> None:
        """Continue from a checkpoint.

        Raises:
            InvalidFile: it is corrupted, a link, or of another training.
        """
        require_regular(path, "training", InvalidFile)
        try:
            digest, content = (whole := path.read_bytes())[:32], whole[32:]
            if hashlib.sha256(content).digest() != digest:
                raise ValueError("its checksum differs")
            kept = load(content)
            self.step, self.losses = int(kept.pop("step")), kept.pop("losses").tolist()
            parts: dict[str, dict[str, Tensor]] = {}
            for name, own in kept.items():
                part, _, rest = name.partition("/")
                parts.setdefault(part, {})[rest] = own
            for part, tensors in self._parts().items():
                if tensors.keys() != parts[part].keys():
                    raise ValueError(f"its {part} is another one")
                for name, own in tensors.items():
                    # in place: the optimizer holds these very tensors
                    own.copy_(parts[part][name])
            moments = {
                int(part.split()[1]): own for part, own in parts.items() if part[:9] == "optimizer"
            }
            self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": moments})
        except (SafetensorError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise InvalidFile(
                f"{path} can't be continued from: {one_line(error)}; --restart starts over"
            ) from error


def fit(
    training: Training, place: Path, save_every: int, progress: Progress, log: Log | None = None
) -> Trained:
    """Run a training to its end, continuing from its checkpoint if there is one.

    Args:
        training: that hasn't begun.
        place: where the output is made, see `checkpoint_of`.
        save_every: steps between checkpoints.
        progress: where to show it.
        log: called for each row of the learning curve, those before a resume included.
    """
    if (path := checkpoint_of(place)).exists():
        training._restore(path)
    logged = 0
    while training.step < training.steps:
        facts = {"loss": f"{training.losses[-1][1]:.3f}"} if training.losses else {}
        if played := [row[3] for row in training.losses if not math.isnan(row[3])]:
            facts["success"] = f"{100 * played[-1]:.0f} %"
        progress.stage(f"training the {training.NAME}", training.step, training.steps, facts)
        training._advance()
        for step, *values in training.losses[logged:]:
            if log is not None:
                log(int(step), dict(zip((*training.LOSSES, "success"), values, strict=True)))
        logged = len(training.losses)
        if training.step % save_every == 0 or training.step == training.steps:
            training._save(path)
    return training._ended()


def draw_curve(
    out: Path, names: tuple[str, str], curve: Sequence[Iterable[float]], kept: int | None = None
) -> None:
    """Write two losses and success rates to `training.csv`, and plot them in `curve.png`.

    Args:
        out: folder.
        names: of the losses.
        curve: step, both losses and success rate, at least one row; many are averaged in groups.
        kept: the step whose weights are kept.
    """
    rows = np.array(curve, dtype=np.float64)
    # at most _CURVE_ROWS groups of neighbouring rows, each shown by its mean
    groups = np.array_split(rows, range(0, len(rows), -(-len(rows) // _CURVE_ROWS))[1:])
    rows = np.array([[own[-1, 0], *own[:, 1:3].mean(axis=0), _mean(own[:, 3])] for own in groups])
    with atomic_write(out / "training.csv") as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("step", *names, "success"))
        writer.writerows([int(row[0]), *row[1:].round(5).tolist()] for row in rows)
    with atomic_write(out / "curve.png") as part:
        _plot(names, rows, kept).save(part, "PNG")


def _mean(values: Array) -> float:
    """Return the mean of the values that are known, NaN if none is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


def _plot(names: tuple[str, str], rows: Array, kept: int | None) -> Image.Image:
    """Plot two losses and success rates against steps, with axes, ticks and a legend."""
    width, height, left, right, top, bottom = 720, 420, 64, 656, 48, 368
    image = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(image)
    steps, most = float(rows[-1, 0]), max(float(rows[:, 1:3].max()), 1e-9)

    def _at(step: float, loss: float) -> tuple[float, float]:
        return left + step / steps * (right - left), bottom - loss / most * (bottom - top)

    def _write(text: str, x: float, y: float, anchor: str) -> None:
        draw.text((x, y), text, "black", anchor=anchor, font_size=13)

    for tick in _ticks(most):
        draw.line([_at(0, tick), _at(steps, tick)], "#e1e1e1")
        _write(f"{tick:g}", left - 8, _at(0, tick)[1], "rm")
    for tick in _ticks(steps):
        draw.line([_at(tick, 0), (_at(tick, 0)[0], bottom + 5)], "black")
        _write(f"{tick:g}", _at(tick, 0)[0], bottom + 8, "mt")
    draw.line([(left, top), (left, bottom), (right, bottom)], "black")
    _write("loss", left, top - 8, "mb")
    _write("optimizer step", (left + right) / 2, height - 8, "mb")
    legend = [(names[0], "#1f77b4"), (names[1], "#ff7f0e")]
    if len(played := rows[~np.isnan(rows[:, 3])]):
        points = [_at(step, rate * most) for step, rate in played[:, [0, 3]].tolist()]
        draw.line(points, "#2ca02c", 2)
        for x, y in points:
            draw.ellipse((x - 3, y - 3, x + 3, y + 3), "#2ca02c")
        for share in (0, 0.5, 1):  # the axis on the right
            _write(f"{100 * share:.0f} %", right + 8, _at(0, share * most)[1], "lm")
    for column, (_, ink) in enumerate(legend, 1):
        draw.line([_at(*point) for point in rows[:, [0, column]].tolist()], ink, 2)
    if len(played):
        legend.append(("success", "#2ca02c"))
    if kept is not None:
        draw.line([_at(kept, 0), (_at(kept, 0)[0], top)], "#787878")
        legend.append((f"kept weights: step {kept}", "#787878"))
    for number, (name, ink) in enumerate(legend):
        x = left + 50 + 140 * number
        draw.line([(x, top - 15), (x + 24, top - 15)], ink, 2)
        _write(name.replace("_", "-"), x + 32, top - 15, "lm")
    return image


def _ticks(most: float) -> list[float]:
    """Return round numbers from 0 to `most`, at most six and at least three of them.

    >>> _ticks(3000), _ticks(0.7)
    ([0.0, 1000.0, 2000.0, 3000.0], [0.0, 0.2, 0.4, 0.6])
    """
    power = 10.0 ** math.floor(math.log10(max(most, 1e-9)))
    step = next(one * power for one in (0.2, 0.5, 1, 2) if most < 6 * one * power)
    return [round(k * step, 12) for k in range(int(most / step + 1e-9) + 1)]
