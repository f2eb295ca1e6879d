"""A training: optimizer steps, with one checkpoint that the next one replaces.

Each step draws from its own random stream, so a resumed training draws what an uninterrupted one
would have drawn, and ends with the same bits.

After a change run `pytest tests/learn/test_training.py`: an interrupted training must end with the
same weights.
"""

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from knotgym.common import InvalidFile, atomic_write, one_line, require_regular
from knotgym.datasets import EpisodeDataset
from knotgym.learn.trials import Trials
from knotgym.runs import Progress, Recipe, checkpoint_of

# chosen without comparison; learners that exist don't depend on them, their scores in
# docs/benchmark.md are of these
_WARM_UP, _LEAST_RATE = 50, 0.02  # steps over which the rate rises; share of the peak at the end

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
        NAME: what the network is called.
        LOSSES: names of the two losses.
        network: as trained so far.
        step: steps done.
        losses: of each row of the learning curve the step, two losses, and the success rate of the
            episodes that the learner played then, NaN if it played none.
    """

    NAME: ClassVar[str]
    LOSSES: ClassVar[tuple[str, str]]

    def __init__(self, network: nn.Module, rate: float, decay: float, steps: int) -> None:
        """Train `network` for `steps` steps; `decay` is that of the weights."""
        # more threads would sum in another order and round otherwise
        torch.set_num_threads(1)
        self.network, self.steps, self._rate = network, steps, rate
        self._optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=decay)
        self.step, self.losses = 0, list[tuple[float, float, float, float]]()

    @classmethod
    @abstractmethod
    def begun(cls, datasets: Sequence[EpisodeDataset], config: Any, trials: Trials) -> Recipe[Self]:
        """Begin a training on datasets, and on what the calls of a run make.

        Raises:
            InvalidInput: they have nothing to learn from.
        """

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
        parts = {**self._parts(), **{f"optimizer {k}": moment for k, moment in moments.items()}}
        kept = {f"{part}/{k}": x for part, tensors in parts.items() for k, x in tensors.items()}
        kept["losses"] = torch.tensor(self.losses, dtype=torch.float64).reshape(-1, 4)
        kept["step"] = torch.tensor([self.step])
        kept = {name: tensor.detach().cpu().contiguous() for name, tensor in kept.items()}
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
            for name, tensor in kept.items():
                part, _, rest = name.partition("/")
                parts.setdefault(part, {})[rest] = tensor
            for part, tensors in self._parts().items():
                if tensors.keys() != parts[part].keys():
                    raise ValueError(f"its {part} is another one")
                for name, tensor in tensors.items():
                    # in place: the optimizer holds these very tensors
                    tensor.copy_(parts[part][name])
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
        progress.stage(
            f"training the {training.NAME}", lambda: training.step, training.steps, facts
        )
        training._advance()
        for step, *values in training.losses[logged:]:
            if log is not None:
                log(int(step), dict(zip((*training.LOSSES, "success"), values, strict=True)))
        logged = len(training.losses)
        if training.step % save_every == 0 or training.step == training.steps:
            training._save(path)
    return training._ended()
