"""Behaviour cloning of an expert on state observations, in torch; takes some CPU minutes.

    python examples/learners/clone.py --data knotgym/tie-nx2/expert-v0 --out cloned.pt

The policy chooses the bead by classification and the force by regression. In each epoch every
sample is shown in another of its symmetric images. Beside the network it writes a module with its
policy: `knotgym evaluate --policy cloned:act`, in the same folder.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import nn

from knotgym.loaders import Symmetries, arrays

# the policy of the file that is written, as module:name
MODULE = '''"""The policy of {model}: knotgym evaluate --policy {name}:act, in this folder."""

import torch

FILES = [__file__[:-3] + ".pt"]
torch.set_num_threads(1)
network = torch.jit.load(FILES[0]).eval()


@torch.no_grad()
def act(observation):
    return network(torch.from_numpy(observation)[None])[0].numpy()
'''


class Policy(nn.Module):
    """A network from the vertices of rope and goal to an action: a bead and its force."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(600, 512), nn.ReLU(), nn.Linear(512, 512), nn.ReLU())
        self.bead, self.force = nn.Linear(512, 100), nn.Linear(512, 3)

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        hidden = self.body(5 * state)  # vertices lie within 0.2 m of the middle
        bead = self.bead(hidden).argmax(1)
        # an action's position is in units of 2 m
        position = state.reshape(-1, 200, 3)[torch.arange(len(state)), bead] / 2
        return torch.cat([position, self.force(hidden).tanh()], 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="knotgym/tie-nx2/expert-v0", help="Minari id or folder")
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("cloned.pt"), help="TorchScript file")
    options = parser.parse_args()
    data = arrays(options.data, observation="state")
    data = {name: data[name] for name in ("observations", "actions")}
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    policy = Policy()
    optimizer = torch.optim.AdamW(policy.parameters(), 3e-4)
    for _ in range(options.epochs):
        images = Symmetries.drawn(len(data["actions"]), rng).applied(data)
        states, actions = map(torch.from_numpy, (images["observations"], images["actions"]))
        # the bead that the expert pulled is the one nearest to the action's position
        offsets = states.reshape(-1, 200, 3)[:, :100] - 2 * actions[:, None, :3]
        beads = (offsets**2).sum(2).argmin(1)
        for rows in torch.randperm(len(states)).split(128):
            hidden = policy.body(5 * states[rows])
            loss = nn.functional.cross_entropy(policy.bead(hidden), beads[rows])
            loss = loss + nn.functional.mse_loss(policy.force(hidden).tanh(), actions[rows, 3:])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    torch.jit.script(policy).save(str(options.out))
    names = {"model": options.out.name, "name": options.out.stem}
    options.out.with_suffix(".py").write_text(MODULE.format(**names))


if __name__ == "__main__":
    main()
