"""What `knotgym dataset ...` does: find out what a path or an id holds, and call what fits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.cli.summaries import print_episodes, print_images, print_states
from knotgym.datasets import verification
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_writer import merge_episodes
from knotgym.datasets.image_table import is_images
from knotgym.datasets.minari_dataset import merge_datasets
from knotgym.datasets.states import merge_states, minari_root, read_states, write_states
from knotgym.errors import KnotgymError
from knotgym.generate.merge_shards import merge_shards, shard_folder_of
from knotgym.hdf5_files import hdf5_format
from knotgym.rendering.picture import draw
from knotgym.rendering.video import FRAMES_PER_SECOND, captioned, write_film
from knotgym.rope import Array, Rope
from knotgym.runs.executors import executor
from knotgym.runs.staging import Occupied
from knotgym.simulation import Simulation
from knotgym.topology.crossings import label


class UnknownDataset(KnotgymError, ValueError):
    """Nothing of ours is at this path."""


class UntrueReplay(KnotgymError, RuntimeError):
    """A replay ended elsewhere than the dataset says."""


def refuse_existing(path: Path) -> None:
    """Raise Occupied if there is something at `path`."""
    if path.exists():
        raise Occupied(f"{path} is there already; choose another --out, or remove it")


def is_states(path: str) -> bool:
    """Whether a path means a state file, by itself or in its folder."""
    given = Path(path)
    if given.is_dir():
        return (given / "states.h5").is_file()
    return given.is_file() and hdf5_format(given) == "knotgym-states"


def states_path(path: str) -> Path:
    """The state file that a folder or a path means."""
    given = Path(path)
    file = given / "states.h5" if given.is_dir() else given
    if not file.is_file():
        raise UnknownDataset(
            f"no states at {path}: give a folder that knotgym generate made, or a states.h5"
        )
    return file


def show(path: str, console: Console) -> None:
    """Print what a dataset holds."""
    if is_images(path):
        print_images(path, console)
    elif is_states(path):
        print_states(path, states_path(path), console)
    else:
        print_episodes(path, console)


def faults(path: str, console: Console | None) -> Iterator[str]:
    """Check a dataset; yield its faults."""
    if console:
        console.print(f"verifying {path}", highlight=False, soft_wrap=True)
    with executor(0) as pool:
        yield from verification.faults(path, pool.map)


def refuse_minaris_folder(out: Path) -> None:
    """Raise UnknownDataset where a plain file would lie among Minari's datasets."""
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise UnknownDataset(
            f"{out} is in Minari's folder, where a plain file is no dataset: give --id"
            " knotgym/name-v0 to merge, or another --out"
        )


def merge_to_minari(sources: Sequence[str], dataset_id: str, root: Path | None) -> Path:
    """Make a Minari dataset of several; its folder."""
    foreign = [source for source in sources if is_states(source) or is_images(source)]
    if foreign:
        raise UnknownDataset(f"--id is for trajectories; {', '.join(foreign)} holds none")
    return merge_datasets(sources, dataset_id, root)


def merge(sources: Sequence[str], out: Path) -> None:
    """Put datasets of one kind together, or the shards of one run."""
    run_shards = [shard for source in sources if (shard := shard_folder_of(source))]
    if run_shards:
        others = len(sources) - len(run_shards)
        if others:
            raise UnknownDataset(
                f"shards of a run are merged with each other alone; {others} of these"
                f" {len(sources)} are none"
            )
        merge_shards(run_shards, out)
        return
    refuse_existing(out)
    refuse_minaris_folder(out)
    if any(is_images(source) for source in sources):
        raise UnknownDataset(
            "perception tables are merged only if they are shards of one run (knotgym images"
            " --shard)"
        )
    if all(is_states(source) for source in sources):
        parts = [read_states(states_path(source)) for source in sources]
        write_states(out, merge_states(parts, distinct=True))
    elif any(is_states(source) for source in sources):
        raise UnknownDataset(
            f"states and trajectories don't go into one file: {', '.join(sources)}"
        )
    else:
        merge_episodes(sources, out, concatenate=True, distinct=True)


def film(path: str, row: int, out: Path) -> None:
    """Act out a state's provenance or an episode and write it as a video.

    Raises:
        UnknownDataset: there is no such row, or nothing is known of how it came to be.
        UntrueReplay: it ended elsewhere; nothing is written.
    """
    refuse_existing(out)
    scene = _state_scene(path, row) if is_states(path) else _episode_scene(path, row)
    simulation = Simulation(1, scene.rope)
    simulation.lay(scene.start_qpos[None])
    frames = [_frame(simulation.points[0], scene.goal, 0)]
    for step, action in enumerate(scene.actions, 1):
        simulation.act(action[None])
        frames.append(_frame(simulation.points[0], scene.goal, step))
    if not np.array_equal(simulation.points[0], scene.end):
        raise UntrueReplay(
            f"row {row} of {path} acted out again ends elsewhere, first bead"
            f" {np.abs(simulation.points[0] - scene.end).max():.3g} m away at most"
        )
    write_film(out, frames + frames[-1:] * FRAMES_PER_SECOND)


class _Scene(NamedTuple):
    """What is acted out: from a start, by actions, to an end; beside a goal."""

    rope: Rope
    start_qpos: Array
    actions: NDArray[np.float32]
    end: Array
    goal: Array


def _state_scene(path: str, row: int) -> _Scene:
    states = read_states(states_path(path), images=False)
    _require_row(row, len(states))
    if not {"start_qpos", "actions", "steps"} <= states.source.keys():
        raise UnknownDataset(
            f"{path} doesn't say how its states were made, so they can't be acted out"
        )
    actions = states.source["actions"][row, : states.source["steps"][row]]
    end = states.points[row]
    return _Scene(Rope(), states.source["start_qpos"][row], actions, end, goal=end)


def _episode_scene(path: str, row: int) -> _Scene:
    reader = EpisodeReader(path)
    _require_row(row, len(reader))
    episode = reader.episode(row)
    reader.close()
    return _Scene(
        Rope(reader.task.rope),
        episode.start_qpos,
        episode.actions,
        episode.points[-1],
        episode.goal_points,
    )


def _require_row(row: int, count: int) -> None:
    if row >= count:
        raise UnknownDataset(f"row {row} is not there; there are {count}, from 0")


def _frame(points: Array, goal: Array, step: int) -> NDArray[np.uint8]:
    lines = [
        f"step {step}   code {label(points).chiral or 'loop'}",
        f"goal {str(label(goal)) or 'loop'}",
    ]
    return captioned(np.concatenate([draw(points), draw(goal)], axis=1), lines)
