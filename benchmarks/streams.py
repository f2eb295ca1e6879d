"""What a stream is for: learners on sets of fixed size and on a stream, at equal updates.

    python benchmarks/streams.py ROOM SET...
    python benchmarks/streams.py ROOM --photos 10240,102400

Attention is cloned on each SET, a dataset's folder, all of one configuration but for their size,
such as two sizes of a cell of the suite; the stream plays what that of the last one says. Writes a
policy of each into ROOM and prints its success rate on new states, and the CPU seconds of training.

With --photos a convolutional network counts the crossings of photos, 0 to 4: it learns from the
first so many photos of a stream, which ROOM keeps in 8 GB, and from all 153,600, which two cores
make in 50 minutes. Prints how often it is right on 1,280 photos of another seed.
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run

from knotgym.common import from_json
from knotgym.datasets import open_episodes
from knotgym.generate import CollectConfig, ImagesConfig
from knotgym.loaders import arrays, stream
from knotgym.rendering import AppearanceConfig
from knotgym.rope import CHAIN

WIDTH, PATCHES, PULLS = 96, 10, 40  # of the network; numbers of a decision after its bead
UPDATES, BATCH = 400, 128
REPEATS = 8  # batches of a block of 64 episodes
PHOTO_UPDATES, NEW_PHOTOS, PHOTO_BATCH = 2400, 20, 64  # the first two in batches
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
            layer = torch.nn.TransformerEncoderLayer(WIDTH, 4, 3 * WIDTH, 0.1, batch_first=True)
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


def count_crossings(room: Path, sizes: list[int]) -> None:
    """Print how often a network counts crossings right that saw sets of photos, or all."""
    import torch
    from torch import nn
    from torch.nn.functional import avg_pool2d, cross_entropy

    look = AppearanceConfig(name="photo", sizes=(128,))  # in smaller ones few knots are legible
    config = ImagesConfig(nx=(0, 1, 2, 3, 4), test_nx=None, engine=CHAIN, appearance=look)
    path = str(room / "photos-{}-{}.npz").format  # of a seed and a batch
    for seed, count in enumerate((PHOTO_UPDATES, NEW_PHOTOS)):
        own = stream(config, seed, batch=PHOTO_BATCH, block=640, shuffled=1, repeats=10)
        for number in range(count):
            if not Path(path(seed, number)).exists():
                own.load_state_dict({**own.state_dict(), "number": number})
                drawn = next(iter(own))
                np.savez(path(seed, number), image=drawn["image"], nx=drawn["nx"])

    def batch(seed: int, number: int) -> tuple[Any, Any]:
        with np.load(path(seed, number)) as kept:
            halved = avg_pool2d(torch.from_numpy(kept["image"]).float(), 2) / 255
            return halved, torch.from_numpy(kept["nx"])

    for size in (*sizes, PHOTO_BATCH * PHOTO_UPDATES):
        torch.manual_seed(0)
        layers: list[nn.Module] = []
        for inner, outer in pairwise((3, 24, 48, 96, 128)):
            for seen, stride in ((inner, 2), (outer, 1)):
                layers += [nn.Conv2d(seen, outer, 3, stride, 1), nn.BatchNorm2d(outer), nn.ReLU()]
        network = nn.Sequential(*layers, nn.Flatten(), nn.Linear(128 * 16, 5))
        optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=0.02)
        rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, PHOTO_UPDATES)
        for number in range(PHOTO_UPDATES):
            image, nx = batch(0, number % (size // PHOTO_BATCH))
            optimizer.zero_grad()
            cross_entropy(network(image), nx).backward()
            optimizer.step()
            rate.step()
        network.eval()
        new = map(batch, repeat(1), range(NEW_PHOTOS))
        right = [network(image).argmax(1) == nx for image, nx in new]
        print(f"{size} photos: {100 * torch.cat(right).float().mean():.1f} %", flush=True)


def main(room: Path, *sets: Path, photos: str = "") -> None:
    """Train on sets and on a stream, and print what each brings.

    Args:
        room: folder for what is written.
        sets: folders of datasets.
        photos: numbers of photos, such as 10240,102400, instead of sets.
    """
    import torch

    torch.set_num_threads(1)
    if photos:
        return count_crossings(room, [int(size) for size in photos.split(",")])
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
    run(main)
