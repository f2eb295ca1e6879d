"""How fast random batches of pictures come out of a dataset of 100,000 frames, by every way there
is: picture, next picture and goal of 256 transitions at once, on one core.

    python benchmarks/batches.py [--out batches.json] [--frames 100000] [--seconds 20]
    [--room FOLDER]

50 ropes are pulled about for 50 steps; copies of these episodes make up the dataset, so that it
reads as one of as many different frames would. Rates are by CPU seconds, the system's included, so
that they hold on a machine that others use; by the clock they stand beside. `HDF5` rows read the
two pictures of each transition from files that hold nothing else, with another filter: what the
dataset's could be at best. The memory map is a plain NumPy one of the same pictures, from which
picture, next picture and goal are gathered as three arrays, as from the cache with goals apart;
without, the cache puts goals beside both pictures, as the environment shows them, and writes four.
Rows after a `+` give what a `Window` adds, beside the same batches without one; vertices are read
from the dataset. The column of pictures counts three a transition.
"""

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from pulled import EPISODES, STEPS, pulled_about
from rich.console import Console
from rich.table import Table

import knotgym
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import GoalSampling, Transitions, Window

BATCH = 256
FILTERS = {"gzip 1": {"compression": "gzip", "compression_opts": 1, "shuffle": True}}
FILTERS |= {"lzf": {"compression": "lzf"}, "none": {}}
WINDOWS = {
    "5 steps": Window(n_step=5),
    "chunks of 8, history of 4": Window(chunk=8, history=4),
    "goals": Window(goals=GoalSampling()),
    "goals, 5 steps, chunks of 5": Window(n_step=5, chunk=5, goals=GoalSampling()),
    "stacks of 3": Window(stack=3),
}
_IN_FILE = 2000  # pictures of a file of the rows HDF5


def rate(batch: Callable[[NDArray[np.int64]], Any], count: int, seconds: float) -> dict[str, float]:
    """Transitions a CPU second and a second, of random batches, the first not counted."""
    rng = np.random.default_rng(0)
    batch(rng.integers(count, size=BATCH))
    began, spent, batches = time.perf_counter(), time.process_time(), 0
    while not batches or time.process_time() - spent < seconds:
        batch(rng.integers(count, size=BATCH))
        batches += 1
    return {
        "transitions_per_cpu_s": BATCH * batches / (time.process_time() - spent),
        "transitions_per_s": BATCH * batches / (time.perf_counter() - began),
        "batches": batches,
    }


def filtered(path: Path, pictures: NDArray[np.uint8], seconds: float, **how: Any) -> dict[str, Any]:
    """The rate of a file of pictures, a chunk each, read two by two; and its bytes a picture."""
    with h5py.File(path, "w") as file:
        data = file.create_dataset(
            "pictures", data=pictures, chunks=(1, *pictures.shape[1:]), **how
        )
        size = data.id.get_storage_size() / len(pictures)
    with h5py.File(path, "r") as file:
        data = file["pictures"]
        found = rate(lambda rows: [data[row : row + 2] for row in rows], len(pictures) - 1, seconds)
    return {**found, "bytes_per_picture": size}


def gathered(read: Transitions) -> Callable[[NDArray[np.int64]], Any]:
    """A function that gathers a batch from a plain memory map of the cache's file."""
    kept = read._frames
    assert kept is not None
    mapped = np.memmap(kept.path, np.uint8, "r", shape=kept.frames.shape)
    segments = np.repeat(np.arange(read.segments), np.diff(read.starts))
    frames = np.arange(len(read)) + 2 * segments  # an episode of T actions has T + 2 frames
    goals = kept.offsets[segments + 1] - 1
    return lambda rows: (mapped[frames[rows]], mapped[frames[rows] + 1], mapped[goals[rows]])


def windowed(
    path: Path, observation: str, seconds: float, **how: Any
) -> dict[str, dict[str, float]]:
    """The rates of batches without a window and with each of WINDOWS, by name."""
    rates = {}
    for name, window in {"": None, **WINDOWS}.items():
        read, rng = Transitions(path, observation, window=window, **how), np.random.default_rng(0)
        rates[f" + {name}" if name else ""] = rate(partial(read.batch, rng=rng), len(read), seconds)
    return rates


def made(cache: Path, path: Path) -> dict[str, float]:
    """What it takes to make the cache, and its bytes."""
    began, spent = time.perf_counter(), time.process_time()
    Transitions(path, observation="pixels", cache=cache)
    return {
        "cpu_s": time.process_time() - spent,
        "s": time.perf_counter() - began,
        "bytes": sum(file.stat().st_size for file in cache.rglob("*") if file.is_file()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("batches.json"))
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=20.0, help="CPU seconds for each way")
    parser.add_argument(
        "--room",
        type=Path,
        default=None,
        help="where the data is made, about 6 GB; a temporary folder by default",
    )
    arguments = parser.parse_args()
    copies = -(-arguments.frames // (EPISODES * (STEPS + 1)))
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(dir=arguments.room) as folder:
        room = Path(folder)
        task = TaskConfig(task="tie", observation="pixels")
        with EpisodeWriter(room / "few.h5", task) as writer:
            for episode in pulled_about(np.random.default_rng(0)):
                writer.add(episode)
        few = Transitions(room / "few.h5")
        seen = np.concatenate([few.observations(k) for k in range(EPISODES)])[:_IN_FILE]
        for name, how in FILTERS.items():
            results[f"HDF5, {name}"] = filtered(
                room / "filtered.h5", seen, arguments.seconds / 4, **how
            )
        merge_episodes([room / "few.h5"] * copies, room / "pixels.h5", concatenate=True)
        merge_episodes([room / "few.h5"], room / "less.h5", store="none")
        merge_episodes([room / "less.h5"] * copies, room / "none.h5", concatenate=True)
        for name, file in (("read", "pixels"), ("drawn", "none")):
            plain = Transitions(room / f"{file}.h5", observation="pixels")
            results[f"dataset, {name}"] = rate(plain.batch, len(plain), arguments.seconds)
        making = made(room / "cache", room / "pixels.h5")
        cached = Transitions(room / "pixels.h5", cache=room / "cache")
        mapping = gathered(cached)
        for _ in range(2):  # the first time for the system's own cache
            results["memory map"] = rate(mapping, len(cached), arguments.seconds)
            results["cache, goals apart"] = rate(
                lambda rows: cached.batch(rows, apart=True), len(cached), arguments.seconds
            )
            results["cache"] = rate(cached.batch, len(cached), arguments.seconds)
        for name, found in windowed(
            room / "pixels.h5", "pixels", arguments.seconds, cache=room / "cache"
        ).items():
            results[f"cache{name}"] = found
        for name, found in windowed(room / "none.h5", "state", arguments.seconds).items():
            results[f"vertices{name}"] = found
    about = {
        "knotgym": knotgym.__version__,
        "python": platform.python_version(),
        "cores": os.cpu_count(),
        "frames": copies * EPISODES * (STEPS + 1),
        "batch": BATCH,
    }
    arguments.out.write_text(
        json.dumps({"about": about, "batches": results, "making the cache": making}, indent=2)
        + "\n",
        encoding="utf-8",
    )
    table = Table(
        "way", "trans./CPU s", "pictures/CPU s", "trans./s", title="Random batches of transitions"
    )
    for name, figures in results.items():
        cpu = figures["transitions_per_cpu_s"]
        table.add_row(name, f"{cpu:.0f}", f"{3 * cpu:.0f}", f"{figures['transitions_per_s']:.0f}")
    console = Console()
    console.print(table)
    console.print(
        f"making the cache: {making['cpu_s']:.0f} CPU s, {making['bytes'] / 1e9:.2f} GB, of"
        f" {about['frames']} frames",
        highlight=False,
    )


if __name__ == "__main__":
    main()
