"""Train a flow policy over decisions in torch (flow matching, arXiv 2210.02747).

    python examples/learners/flow.py knotgym/tie-nx2/noisy-bench-v0 --out flow.pt

Writes flow.pt and flow.py, a policy: `knotgym evaluate --policy flow:act`, in the same folder.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor, nn

from knotgym.loaders import arrays

MODULE = """import torch
from knotgym.loaders import as_policy

FILES = [__file__[:-3] + ".pt"]
torch.set_num_threads(1)
act = as_policy(torch.jit.load(FILES[0]))
"""


class Flow(nn.Module):
    """A velocity field that carries noise to decisions (n, 43), from observations (n, 609)."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.BatchNorm1d(609)
        sizes, last = (609 + 43 + 1, 512, 512), nn.Linear(512, 43)
        layers = [nn.Sequential(nn.Linear(size, 512), nn.GELU()) for size in sizes]
        self.body = nn.Sequential(*layers, last)

    def velocity(self, seen: Tensor, decisions: Tensor, times: Tensor) -> Tensor:
        return self.body(torch.cat([self.scale(seen), decisions, times], 1))

    def forward(self, seen: Tensor) -> Tensor:
        decisions = torch.zeros(len(seen), 43)  # the middle of the noise
        for step in range(10):
            times = torch.full((len(seen), 1), step / 10)
            decisions = decisions + self.velocity(seen, decisions, times) / 10
        return decisions.clamp(-1, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", nargs="+", help="Minari ids or folders, of the train split")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--out", type=Path, required=True, help="TorchScript file")
    given = parser.parse_args()
    data = arrays(given.datasets, observation="marked", action="decision", frame="canonical")
    seen, actions = (torch.from_numpy(data[name]) for name in ("observations", "actions"))
    torch.manual_seed(0)
    flow = Flow()
    optimizer = torch.optim.AdamW(flow.parameters(), 1e-3, weight_decay=0.02)
    for _ in range(given.steps):
        rows = torch.randint(len(seen), (256,))
        noise, times = torch.randn(256, 43), torch.rand(256, 1)
        between = (1 - times) * noise + times * actions[rows]
        error = flow.velocity(seen[rows], between, times) - (actions[rows] - noise)
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()
    torch.jit.script(flow).save(str(given.out))
    given.out.with_suffix(".py").write_text(MODULE)


if __name__ == "__main__":
    main()
