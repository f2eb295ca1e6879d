"""What a stream is for: attention, cloned on sets of fixed size and on a stream, at equal updates.

    python benchmarks/streams.py ROOM SET...

Each SET is a dataset's folder, all of one configuration but for their size, such as two sizes of a
cell of the suite; the stream plays what that of the last one says. Writes a policy of each into
ROOM and prints its success rate on new states, and the CPU seconds of training.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import from_json
from knotgym.datasets import open_episodes
from knotgym.generate import CollectConfig
from knotgym.loaders import arrays, stream

WIDTH, PATCHES, PULLS = 96, 10, 40  # of the network; numbers of a decision after its bead
UPDATES, BATCH = 400, 128
REPEATS = 8  # batches of a block of 64 episodes
VIEW: Any = {"observation": "marked", "action": "decision", "frame": "canonical"}
MODULE = """import torch
from knotgym.loaders import as_policy
torch.set_num_threads(1)
act = as_policy(torch.jit.load(__file__[:-3] + ".pt"))
"""


def attention() -> Any:
    """Attention over patches of ten beads and the codes; a score of each bead, and the pulls."""
    import torch  # here, as --help needs none

    class Attention(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.patch, self.codes = torch.nn.Linear(50, WIDTH), torch.nn.Linear(96, WIDTH)
            self.place = torch.nn.Parameter(0.1 * torch.randn(PATCHES, WIDTH))
            layer = torch.nn.TransformerEncoderLayer(
                WIDTH, 4, 3 * WIDTH, 0.1, "relu", batch_first=True
            )
            self.body = torch.nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
            self.beads, self.pulls = torch.nn.Linear(WIDTH, 10), torch.nn.Linear(WIDTH, 10 * PULLS)

        def forward(self, seen: Any) -> Any:
            points, marks, codes, _ = seen.split([300, 200, 96, 13], 1)
            beads = torch.cat([6 * points.reshape(-1, 100, 3), marks.reshape(-1, 100, 2)], 2)
            patches = self.patch(beads.reshape(-1, PATCHES, 50)) + self.place
            tokens = self.body(torch.cat([self.codes(codes / 6)[:, None], patches], 1))[:, 1:]
            scores = self.beads(tokens).reshape(-1, 100, 1)
            return torch.cat([scores, self.pulls(tokens).reshape(-1, 100, PULLS)], 2)

    return Attention()


def rows_of(path: Path, seed: int = 0) -> Iterator[dict[str, Any]]:
    """Yield batches of a set, drawn with replacement."""
    rows, rng = arrays(path, **VIEW), np.random.default_rng(seed)
    while True:
        drawn = rng.integers(len(rows["beads"]), size=BATCH)
        yield {name: column[drawn] for name, column in rows.items()}


def trained(batches: Iterator[dict[str, Any]]) -> Any:
    import torch
    from torch.nn.functional import cross_entropy

    torch.manual_seed(0)
    network = attention()
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=0.02)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, UPDATES)
    for batch, _ in zip(batches, range(UPDATES), strict=False):
        beads = torch.from_numpy(batch["beads"]).long()
        found = network(torch.from_numpy(batch["observations"]))
        pulls = found[torch.arange(len(beads)), beads, 1:]
        error = (pulls - torch.from_numpy(batch["actions"][:, 3:])).square().mean()
        optimizer.zero_grad()
        (cross_entropy(found[..., 0], beads, label_smoothing=0.05) + 4 * error).backward()
        optimizer.step()
        rate.step()
    return network.eval()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("room", type=Path)
    parser.add_argument("sets", type=Path, nargs="+")
    given = parser.parse_args()
    import torch

    room, sets = given.room, given.sets
    torch.set_num_threads(1)
    torch.backends.mha.set_fastpath_enabled(False)  # it can't be traced
    config: Any = from_json(CollectConfig, open_episodes(sets[-1]).attributes["run"]["config"])
    endless = stream(config, config.seed, batch=BATCH, repeats=REPEATS, **VIEW)
    sources = {**{one.name: rows_of(one) for one in sets}, "stream": iter(endless)}
    for number, (name, batches) in enumerate(sources.items()):
        began = time.process_time()
        network = torch.jit.trace(trained(batches), torch.zeros(32, 609))
        network.save(room / f"cloned{number}.pt")
        (room / f"cloned{number}.py").write_text(MODULE)
        print(f"{name}: {time.process_time() - began:.0f} CPU s of training", flush=True)
        cell = config.task
        words = f"evaluate --policy cloned{number}:act --states {cell.states} --split test"
        words += f" --engine {cell.engine} --task {cell.tasks[0]} --nx {cell.crossings[0]}"
        subprocess.run([sys.executable, "-m", "knotgym", *words.split()], cwd=room)


if __name__ == "__main__":
    main()
