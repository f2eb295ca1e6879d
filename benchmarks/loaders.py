"""How fast single frames come out of a dataset of 100,000, and how many bytes a frame takes.

    python benchmarks/loaders.py [--out loaders.json] [--frames 100000] [--reads 2000] [--workers 2]
    [--room FOLDER]

50 ropes are pulled about for 50 steps; copies of these episodes, compressed chunks and all, make up
the dataset, so that it reads as one of as many different frames would. Needs torch.
"""

import argparse
import json
import os
import platform
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from pulled import EPISODES, STEPS, pulled_about
from rich.console import Console
from rich.table import Table

import knotgym
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import torch_dataset

STORED = ("pixels", "state", "both", "none")


def random_access(
    path: Path, reads: int, rng: np.random.Generator, **chosen: Any
) -> dict[str, float]:
    """Milliseconds a frame, read in random order by one process: median, 95th percentile, and the
    seconds it took to open.
    """
    begun = time.perf_counter()
    data = torch_dataset(path, kind="frames", **chosen)
    opened = time.perf_counter() - begun
    taken = []
    for index in rng.integers(len(data), size=reads).tolist():
        begun = time.perf_counter()
        data[index]
        taken.append(1000 * (time.perf_counter() - begun))
    return {
        "median_ms": statistics.median(taken),
        "p95_ms": float(np.quantile(taken, 0.95)),
        "open_s": opened,
    }


def rate(path: Path, workers: int, batches: int, **chosen: Any) -> float:
    """Frames a second from a shuffling DataLoader, batches of 64, the first eight not counted."""
    loader = torch.utils.data.DataLoader(
        torch_dataset(path, kind="frames", **chosen),
        batch_size=64,
        shuffle=True,
        num_workers=workers,
    )
    begun = 0.0
    for number, _ in enumerate(loader):
        if number == 7:
            begun = time.perf_counter()
        if number == 7 + batches:
            break
    return 64 * batches / (time.perf_counter() - begun)


def stored_bytes(path: Path) -> dict[str, float]:
    """Bytes a frame, of the file and of the observations in it."""
    reader = EpisodeReader(path)
    frames = int(reader.lengths.sum()) + len(reader)
    sizes: dict[str, int] = {}
    for index in range(len(reader)):
        reader.group(index).visititems(
            lambda name, item: (
                sizes.__setitem__(name, sizes.get(name, 0) + item.id.get_storage_size())
                if isinstance(item, h5py.Dataset)
                else None
            )
        )
    reader.close()
    seen = sum(size for name, size in sizes.items() if name.startswith("observations"))
    return {
        "file": path.stat().st_size / frames,
        "observations": seen / frames,
        "rope": sizes["infos/points"] / frames,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("loaders.json"))
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--reads", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--room",
        type=Path,
        default=None,
        help="where the data is made, about 1 GB; a temporary folder by default",
    )
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory(dir=arguments.room) as folder:
        room = Path(folder)
        with EpisodeWriter(room / "few.h5", TaskConfig(task="tie", observation="both")) as writer:
            for episode in pulled_about(rng):
                writer.add(episode)
        sizes = {}
        for stored in STORED:
            merge_episodes([room / "few.h5"], room / f"{stored}.h5", store=stored)
            sizes[stored] = stored_bytes(room / f"{stored}.h5")
        copies = -(-arguments.frames // (EPISODES * (STEPS + 1)))
        results: dict[str, Any] = {}
        for name, stored, observation in (
            ("pixels", "pixels", "pixels"),
            ("pixels drawn when read", "none", "pixels"),
            ("state", "state", "state"),
        ):
            many = room / "many.h5"
            merge_episodes([room / f"{stored}.h5"] * copies, many, concatenate=True)
            results[name] = {
                **random_access(many, arguments.reads, rng, observation=observation),
                "frames_per_s": rate(many, arguments.workers, 60, observation=observation),
                "frames": copies * EPISODES * (STEPS + 1),
            }
    about = {
        "knotgym": knotgym.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "workers": arguments.workers,
    }
    arguments.out.write_text(
        json.dumps({"about": about, "reading": results, "bytes_per_frame": sizes}, indent=2) + "\n",
        encoding="utf-8",
    )
    reading = Table(
        "frame",
        "frames",
        "median ms",
        "95 % ms",
        f"frames/s, {arguments.workers} workers",
        "opening s",
        title="Random access",
    )
    for name, figures in results.items():
        row = [figures[key] for key in ("median_ms", "p95_ms", "frames_per_s", "open_s")]
        reading.add_row(name, str(figures["frames"]), *(f"{value:.3g}" for value in row))
    taking = Table("stored", "file", "observations", "rope", title="Bytes a frame")
    for stored, size in sizes.items():
        taking.add_row(stored, *(f"{size[name]:.0f}" for name in ("file", "observations", "rope")))
    console = Console()
    console.print(reading)
    console.print(taking)


if __name__ == "__main__":
    main()
