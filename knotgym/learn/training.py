"""A training: optimizer steps, with one checkpoint that the next one replaces.

Each step draws from its own random stream, so a resumed training draws what an uninterrupted one
would have drawn, and ends with the same bits.

After a change run `pytest tests/learn/test_training.py`: an interrupted training must end with the
same weights.
"""

import csv
import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from knotgym.common import InvalidFile, atomic_write, one_line, require_regular
from knotgym.runs import Progress

_SEAL = "seal"  # name of the array that holds the digest of the others
# set by hand; no record says what others would score
_WARM_UP, _LEAST_RATE = 50, 0.02  # steps over which the rate rises; share of the peak at the end
_CURVE_ROWS = 100  # of a learning curve, at most


class Training(ABC):
    """A network in training.

    Attributes:
        network: as trained so far.
        step: steps done.
        losses: two numbers for each row of the learning curve, with the step before them.
    """

    def __init__(self, network: nn.Module, rate: float, decay: float, steps: int) -> None:
        """Train `network` for `steps` steps; `decay` is that of the weights."""
        # more threads would sum in another order and round otherwise
        torch.set_num_threads(1)
        self.network, self.steps, self._rate = network, steps, rate
        self._optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=decay)
        self.step, self.losses = 0, list[tuple[float, float, float]]()

    @abstractmethod
    def advance(self) -> None:
        """Take one step or several."""

    def minimize(self, loss: Tensor) -> None:
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

    def parts(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors to keep beside the optimizer's, which are changed in place."""
        return {"network": self.network.state_dict()}

    def save(self, path: Path) -> None:
        """Write the checkpoint, with a digest; it replaces the one before at once."""
        # AdamW's two means and its count for each parameter: without them a resumed training would
        # take other steps
        moments = self._optimizer.state_dict()["state"]
        parts = {**self.parts(), **{f"optimizer {number}": own for number, own in moments.items()}}
        kept = {f"{part}/{k}": one for part, own in parts.items() for k, one in own.items()}
        kept["losses"] = torch.tensor(self.losses, dtype=torch.float64).reshape(-1, 3)
        kept["step"] = torch.tensor([self.step])
        kept = {name: own.detach().cpu().contiguous() for name, own in kept.items()}
        seal = torch.tensor(list(_digest(kept)), dtype=torch.uint8)
        with atomic_write(path) as part:
            part.write_bytes(save({**kept, _SEAL: seal}))

    def restore(self, path: Path) -> None:
        """Continue from a checkpoint.

        Raises:
            InvalidFile: it is corrupted, a link, or of another training.
        """
        require_regular(path, "training", InvalidFile)
        try:
            kept = load(path.read_bytes())
            if bytes(kept.pop(_SEAL).to(torch.uint8).tolist()) != _digest(kept):
                raise ValueError("its checksum differs")
            self.step, self.losses = int(kept.pop("step")), kept.pop("losses").tolist()
            parts: dict[str, dict[str, Tensor]] = {}
            for name, own in kept.items():
                part, _, rest = name.partition("/")
                parts.setdefault(part, {})[rest] = own
            for part, tensors in self.parts().items():
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


def fit(training: Training, path: Path, save_every: int, what: str, progress: Progress) -> None:
    """Run a training to its end, continuing from its checkpoint if there is one.

    Args:
        training: that hasn't begun.
        path: of the checkpoint.
        save_every: steps between checkpoints.
        what: is trained, for the progress.
        progress: where to show it.
    """
    if path.exists():
        training.restore(path)

    while training.step < training.steps:
        facts = {"loss": f"{training.losses[-1][1]:.3f}"} if training.losses else {}
        progress.stage(f"training the {what}", training.step, training.steps, facts)
        training.advance()
        if training.step % save_every == 0 or training.step == training.steps:
            training.save(path)


def _digest(kept: dict[str, Tensor]) -> bytes:
    """Return the SHA-256 of all tensors with their names, dtypes and shapes."""
    whole = hashlib.sha256()
    for name, own in sorted(kept.items()):
        whole.update(json.dumps([name, str(own.dtype), [*own.shape]]).encode())
        whole.update(own.numpy().tobytes())
    return whole.digest()


def draw_curve(
    out: Path, names: tuple[str, str], curve: Sequence[Iterable[float]], kept: int | None = None
) -> None:
    """Write `curve.csv` and `curve.png`: two losses, the first blue and the second orange.

    Args:
        out: folder.
        names: of the losses.
        curve: step and both losses, at least one row; many are averaged in groups.
        kept: the step whose weights are kept, marked by a grey line.
    """
    rows = np.array(curve, dtype=np.float64)
    # at most _CURVE_ROWS groups of neighbouring rows, each shown by its mean
    groups = np.array_split(rows, range(0, len(rows), -(-len(rows) // _CURVE_ROWS))[1:])
    rows = np.array([[group[-1, 0], *group[:, 1:].mean(axis=0)] for group in groups])
    with atomic_write(out / "curve.csv") as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("step", *names))
        writer.writerows([int(row[0]), *row[1:].round(5).tolist()] for row in rows)
    width, height, edge = 640, 360, 40
    image = np.full((height, width, 3), 255, dtype=np.uint8)
    top = rows[:, 1:].max()
    black, grey, blue, orange = (0, 0, 0), (150, 150, 150), (31, 119, 180), (255, 127, 14)
    texts: list[tuple[str, tuple[int, int], tuple[int, ...]]] = [
        (f"loss, 0 to {top:.2f}", (edge, 24), black),
        (names[0].replace("_", "-"), (width // 2, 24), blue),
        (names[1].replace("_", "-"), (width // 2 + 120, 24), orange),
        (f"{int(rows[-1, 0])} steps", (width - 140, height - 12), black),
    ]
    if kept is not None:
        at = edge + round(kept / rows[-1, 0] * (width - 2 * edge))
        cv2.line(image, (at, edge), (at, height - edge), grey, 1)
        texts.append((f"kept: step {kept}", (edge, height - 12), grey))
    for column, colour in ((1, blue), (2, orange)):
        x = edge + rows[:, 0] / rows[-1, 0] * (width - 2 * edge)
        y = height - edge - rows[:, column] / top * (height - 2 * edge)
        line = np.rint(np.stack([x, y], axis=1)).astype(np.int32)
        cv2.polylines(image, [line], False, colour, 2, cv2.LINE_AA)
    for text, place, ink in texts:
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, 1, cv2.LINE_AA)
    with atomic_write(out / "curve.png") as part:
        part.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
