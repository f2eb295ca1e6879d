"""Pixels for learners: windows of pictures a second, drawn, from our cache, from HDF5 and Lance.

    python benchmarks/pixels.py DATASET ROOM

A sample is a window of 4 consecutive pictures of the rope, 128 pixels large; batches of 64 come in
random order. Of DATASET, episodes of any kind, the same windows are read in one run: drawn from the
columns; from a mapped file of the pictures, as a loader's cache is; and from HDF5 and, where lance
is installed, Lance tables of the same pictures, with the settings that those libraries have by
default. Files are written to ROOM.
Prints windows a CPU second and a second, and both relative to HDF5.
"""

import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from cyclopts import run
from numpy.typing import NDArray

from knotgym.loaders import Sequences
from knotgym.rendering import draw

WINDOW, BATCH, BATCHES = 4, 64, 50
Pictures = NDArray[np.uint8]


def sources(windows: Sequences, room: Path) -> dict[str, Callable[[Any], Pictures]]:
    """Return what reads windows that begin in rows, (n,), of the pictures, by its name."""
    steps = windows.dataset.episodes.steps
    points = np.asarray(steps["observation"]).reshape(steps.rows, -1, 3)
    pictures = np.concatenate([draw(points[k : k + 256]) for k in range(0, len(points), 256)])
    np.save(room / "pictures.npy", pictures)
    mapped = np.load(room / "pictures.npy", mmap_mode="r").view(np.ndarray)
    with h5py.File(room / "pictures.h5", "w") as new:
        new.create_dataset("pixels", data=pictures, chunks=(1, *pictures.shape[1:]))
    file = h5py.File(room / "pictures.h5")["pixels"]

    def _rows(starts: Any) -> Any:
        return starts[:, None] + np.arange(WINDOW)

    found: dict[str, Callable[[Any], Pictures]] = {
        "drawn": lambda starts: draw(points[_rows(starts).ravel()]),
        "mapped": lambda starts: mapped[_rows(starts)],
        "HDF5": lambda starts: np.stack([file[one : one + WINDOW] for one in starts.tolist()]),
    }
    try:
        lance = import_module("lance")
        import pyarrow as pa
    except ImportError:
        return found
    flat = pa.array(pictures.reshape(-1))
    column = pa.FixedSizeListArray.from_arrays(flat, pictures[0].size)
    lance.write_dataset(
        pa.table({"pixels": column}), str(room / "pictures.lance"), mode="overwrite"
    )
    table = lance.dataset(str(room / "pictures.lance"))
    found["Lance"] = lambda starts: (
        table.take(_rows(starts).ravel().tolist())["pixels"].combine_chunks().flatten().to_numpy()
    )
    return found


def main(dataset: str, room: Path) -> None:
    """Read windows of pictures from each source, and print how many a second.

    Args:
        dataset: episodes: an id, a folder or a file.
        room: folder for the files.
    """
    room.mkdir(parents=True, exist_ok=True)
    windows, rates = Sequences(dataset, WINDOW), dict[str, tuple[float, float]]()
    batches = np.random.default_rng(0).choice(windows.starts, (BATCHES, BATCH))
    for name, read in sources(windows, room).items():
        right = read(batches[0])  # what is opened or compiled at first isn't measured
        cpu, wall = time.process_time(), time.perf_counter()
        for starts in batches:
            right = read(starts)
        spent = time.process_time() - cpu, time.perf_counter() - wall
        assert right.size == BATCH * WINDOW * 128 * 128 * 3, right.shape
        rates[name] = BATCHES * BATCH / spent[0], BATCHES * BATCH / spent[1]
    for name, (cpu, wall) in rates.items():
        ratios = cpu / rates["HDF5"][0], wall / rates["HDF5"][1]
        print(f"{name:8} {cpu:9.0f} {wall:9.0f} windows a CPU second and a second", end="")
        print(f"   {ratios[0]:5.2f} and {ratios[1]:5.2f} times HDF5")


if __name__ == "__main__":
    run(main)
