"""Clone demonstrations from pictures alone, in torch.

    python examples/learners/pictures_torch.py knotgym/tie-nx2/varied-bench-v0 --out seen.pt

Writes seen.pt, a state_dict, and seen.py, a policy: `knotgym evaluate --policy seen:act`, in the
same folder. It sees the published picture of rope and goal, and chooses macro-actions: which bead
to lead past which other, over or under. These don't change when a picture is turned, so
rope and goal are turned by quarters at random while it trains.
"""

import inspect
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit("pictures_torch.py needs torch: pip install '.[torch]'") from error
from cards import card_of
from cyclopts import run
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, interpolate

from knotgym.loaders import Transitions

MODULE = """import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate
from knotgym.loaders import as_policy

FILES = [__file__[:-3] + ".pt"]
CARD = {card}  # what an entry claims of the training
torch.set_num_threads(1)


{network}

network = Pictures()
network.load_state_dict(torch.load(FILES[0], weights_only=True))
act = as_policy(network, action="macro", frame="world", observation="pixels")
"""
BATCH, RATE, DECAY = 128, 1e-3, 0.02


class Pictures(nn.Module):
    """Scores of beads; given the bead, of what it is led past, on either side."""

    def __init__(self) -> None:
        super().__init__()
        parts: list[nn.Module] = []
        for inputs, outputs, size, stride in ((3, 32, 8, 4), (32, 64, 4, 2), (64, 64, 3, 1)):
            parts += [nn.Conv2d(inputs, outputs, size, stride), nn.ReLU()]
        self.eye = nn.Sequential(*parts, nn.Flatten(), nn.Linear(64 * 4 * 4, 256), nn.ReLU())
        self.body = nn.Sequential(nn.Dropout(0.1), nn.Linear(512, 256), nn.ReLU())
        self.scores, self.which, self.rest = (
            nn.Linear(*sizes) for sizes in ((256, 100), (100, 256), (256, 200))
        )

    def hidden(self, pictures: Tensor) -> Tensor:
        """Features of pictures, uint8 (n, size, 2 size, 3), of rope and goal by one network."""
        small = interpolate(pictures.movedim(3, 1).float() / 255, (64, 128), mode="area")
        return self.body(torch.cat([self.eye(half) for half in small.chunk(2, dim=3)], 1))

    def led(self, hidden: Tensor, beads: Tensor) -> Tensor:
        return self.rest((hidden + self.which(torch.eye(100)[beads])).relu())

    def forward(self, pictures: Tensor) -> Tensor:
        hidden = self.hidden(pictures)
        beads = self.scores(hidden).argmax(1)
        best = self.led(hidden, beads).argmax(1)
        return torch.stack([beads, best % 100, best // 100], 1)


def turned(pictures: Tensor) -> Tensor:
    """Turn rope and goal by quarters at random, the same for all of a batch."""
    turns = torch.randint(4, (2,)).tolist()
    halves = zip(pictures.chunk(2, dim=2), turns, strict=True)
    return torch.cat([torch.rot90(half, turn, (1, 2)) for half, turn in halves], 2)


def trained(datasets: Sequence[str], updates: int, seed: int) -> Pictures:
    """Train a network on the macro-actions of datasets."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    sets = [Transitions(one, observation="pixels", action="macro") for one in datasets]
    sizes = np.array([len(one) for one in sets], np.float64)
    network = Pictures()
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    for _ in range(updates):
        one = sets[rng.choice(len(sets), p=sizes / sizes.sum())]
        batch = one.batch(rng.integers(len(one), size=BATCH))
        pictures, actions = (torch.from_numpy(batch[k]) for k in ("observations", "actions"))
        beads, targets, sides = actions.long().unbind(1)
        hidden = network.hidden(turned(pictures))
        past = cross_entropy(network.led(hidden, beads), targets + 100 * sides)
        optimizer.zero_grad()
        (cross_entropy(network.scores(hidden), beads, label_smoothing=0.1) + past).backward()
        optimizer.step()
    return network


def main(*datasets: str, updates: int = 2400, seed: int = 0, out: Path) -> None:
    """Train a network, and write its weights and the module that plays them.

    Args:
        datasets: Minari ids or folders, of the train split.
        updates: of the network.
        seed: of all draws.
        out: file of weights.
    """
    torch.set_num_threads(1)
    began = time.process_time()
    network = trained(datasets, updates, seed)
    torch.save(network.state_dict(), out)
    settings = {"updates": updates, "seed": seed}
    options = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    words, seconds = (__file__, *datasets, *options), time.process_time() - began
    settings["parameters"] = sum(one.numel() for one in network.parameters())
    more = settings | {"action": "macro"}
    card = card_of("BC from pictures", datasets, seconds, words, **more)
    module = MODULE.format(card=card, network=inspect.getsource(Pictures))
    out.with_suffix(".py").write_text(module)


if __name__ == "__main__":
    run(main)
