"""How much of an expert's actions can be told from the vertices of rope and goal.

    python benchmarks/imitation.py benchmark/knotgym/{tie,convert}-nx{2,3}/expert-v0 \
        [--out imitation.json] [--steps 5000] [--seed 0]

A network with two layers of 256, as behaviour cloning has, is fitted to the actions of most
episodes, and tried on a tenth of them held out. R2 is the part of the variance of one of an
action's six numbers that it explains (below 0: worse than their mean); `beads off` how far round
the loop the bead that it pulls lies from the expert's, where any two of 100 are 25 apart in the
middle. Needs torch.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from torch import nn

from knotgym.loaders import arrays
from knotgym.rope.actions import decode_actions
from knotgym.rope.model import RopeConfig

HELD_OUT = 0.1  # of the episodes
NUMBERS = ("x", "y", "z", "fx", "fy", "fz")
Array = NDArray[np.float32]


def split(datasets: list[str], rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Observations (n, 6 beads) and actions (n, 6), to fit to and held out."""
    parts: list[list[tuple[Array, Array]]] = [[], []]
    for dataset in datasets:
        read = arrays(dataset, observation="state")
        ends = read["terminals"] | read["timeouts"]
        episode = np.cumsum(ends) - ends
        apart = rng.permutation(int(ends.sum())) < HELD_OUT * ends.sum()
        for part, rows in zip(parts, (~apart[episode], apart[episode]), strict=True):
            part.append((read["observations"][rows], read["actions"][rows]))
    return [
        (np.concatenate([seen for seen, _ in part]), np.concatenate([done for _, done in part]))
        for part in parts
    ]


def fitted(seen: Array, done: Array, steps: int, seed: int) -> Any:
    """A function from observations to actions (n, 6)."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    (middle, spread), (mean, scale) = ((a.mean(0), a.std(0) + 1e-6) for a in (seen, done))
    inputs = torch.from_numpy((seen - middle) / spread)
    wanted = torch.from_numpy((done - mean) / scale)
    layers = [nn.Linear(seen.shape[1], 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Linear(256, done.shape[1]))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(steps):
        rows = torch.randint(len(inputs), (128,))
        loss = nn.functional.mse_loss(network(inputs[rows]), wanted[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def act(asked: Array) -> Array:
        with torch.no_grad():
            out: Array = network(torch.from_numpy((asked - middle) / spread)).numpy()
        return out * scale + mean

    return act


def explained(act: Any, seen: Array, done: Array) -> dict[str, float]:
    """R2 of each number, and the median of the beads off."""
    guess, rope = act(seen), RopeConfig()
    r2 = 1 - ((guess - done) ** 2).mean(0) / done.var(0)
    points = seen.reshape(len(seen), 2, rope.beads, 3)[:, 0].astype(np.float64)
    pulled, wanted = (decode_actions(actions, points, rope)[0] for actions in (guess, done))
    off = np.abs(pulled - wanted)
    return {
        **dict(zip(NUMBERS, r2.tolist(), strict=True)),
        "beads off": float(np.median(np.minimum(off, rope.beads - off))),
        "rows": len(seen),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--steps", type=int, default=5000, help="of 128 transitions")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("imitation.json"))
    args = parser.parse_args()
    parts = split(args.datasets, np.random.default_rng(args.seed))
    act = fitted(*parts[0], args.steps, args.seed)
    found = {
        name: explained(act, *part)
        for name, part in zip(("fitted", "held out"), parts, strict=True)
    }
    args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    table = Table("episodes", *(f"R2 {name}" for name in NUMBERS), "beads off", "rows")
    for name, row in found.items():
        table.add_row(
            name, *(f"{value:,.2f}" for value in list(row.values())[:-1]), f"{row['rows']:,}"
        )
    Console().print(table)


if __name__ == "__main__":
    main()
