"""What `knotgym dataset ...` does: finds out what a path or an id holds and asks the right room."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import show_episodes, verify_episodes
from knotgym.datasets.episode_writer import merge as merge_episodes
from knotgym.datasets.image_table import is_images
from knotgym.datasets.image_verification import image_faults, show_images
from knotgym.datasets.state_card import growth, most_first, summary
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.datasets.states import merge_states, read_states, write_states
from knotgym.datasets.video import FRAMES_PER_SECOND, captioned, write_film
from knotgym.errors import KnotgymError
from knotgym.generate.merge_shards import merge_shards, shard_folder_of
from knotgym.rendering.picture import draw
from knotgym.rope import Array, Rope
from knotgym.simulation import Simulation
from knotgym.topology.crossings import label


class UnknownDataset(KnotgymError, ValueError):
    """Nothing of ours is at this path."""


class Occupied(KnotgymError, ValueError):
    """A file is there already."""


class Untrue(KnotgymError, RuntimeError):
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
    return given.is_file() and _format(given) == "knotgym-states"


def states_path(path: str) -> Path:
    """The state file that a folder or a path means."""
    given = Path(path)
    found = given / "states.h5" if given.is_dir() else given
    if not found.is_file():
        raise UnknownDataset(
            f"no states at {path}: give a folder that knotgym generate made, or a states.h5"
        )
    return found


def show(path: str, console: Console) -> None:
    """Print what a dataset holds."""
    if is_images(path):
        show_images(path, console)
        return
    if not is_states(path):
        for name, value in show_episodes(path).items():
            console.print(
                f"{name:20} {json.dumps(value) if isinstance(value, dict) else value}",
                highlight=False,
                markup=False,
                soft_wrap=True,
            )
        return
    states = read_states(states_path(path), images=False)
    manifest = _manifest(states_path(path).parent)
    existing = manifest.get("report", {}).get("existing_codes", {})
    facts = summary(states)
    table = Table(title=f"{path}: {len(states)} states", title_justify="left")
    for column in (
        "nx",
        "states",
        "codes",
        "of",
        "chiral",
        "train",
        "test",
        "both",
        "c / a",
        "actions",
    ):
        table.add_column(column, justify="right", no_wrap=True)
    for nx, one in facts["nx"].items():
        numbers = [
            one["states"],
            one["codes"],
            existing.get(nx, "?"),
            one["codes_with_chirality"],
            one["train"],
            one["test"],
            one["codes_in_both_splits"],
        ]
        letters = f"{one['positive_crossings']}/{one['negative_crossings']}"
        table.add_row(nx, *map(str, numbers), letters, "/".join(map(str, one["actions_to_reach"])))
    console.print(table)
    console.print(
        "of: codes there are; chiral: codes with chirality; both: codes in both splits; actions:"
        " fewest/median/most to reach",
        highlight=False,
    )
    quality = Table(title="quality", title_justify="left")
    for column in ("measure", "unit", "min", "median", "max"):
        quality.add_column(column, justify="left" if column in ("measure", "unit") else "right")
    for name, one in facts["quality"].items():
        quality.add_row(name, one["unit"], *(f"{one[key]:.3g}" for key in ("min", "median", "max")))
    console.print(quality)
    found = growth(manifest.get("report", {}))
    if found:
        grown = Table(
            title="growth: codes known to the search / states accepted", title_justify="left"
        )
        for column in ("steps", *(f"nx {nx}" for nx in found[-1]["known"])):
            grown.add_column(column, justify="right")
        for one in found:
            grown.add_row(
                str(one["steps"]),
                *(f"{one['known'][nx]} / {one['accepted'][nx]}" for nx in one["known"]),
            )
        console.print(grown)
    rejected = manifest.get("report", {}).get("rejected", {})
    if rejected:
        console.print(
            f"{manifest['report']['attempts']} candidates made; rejected, by reason (a candidate"
            " can have several):",
            highlight=False,
        )
        for nx, reasons in rejected.items():
            console.print(
                f"  nx {nx}: "
                + ", ".join(f"{reason} {count}" for reason, count in most_first(reasons)),
                highlight=False,
                soft_wrap=True,
            )


def faults(path: str, console: Console | None) -> Iterator[str]:
    """Check a dataset; yield its faults."""
    given = Path(path)
    if console:
        console.print(f"verifying {path}", highlight=False, soft_wrap=True)
    if is_images(given):
        yield from image_faults(given)
    elif given.is_dir() and (
        (given / "manifest.json").is_file() or (given / "states.h5").is_file()
    ):
        yield from folder_faults(given)
    elif given.is_file() and _format(given) in ("knotgym-states", None):
        yield from state_faults(read_states(given))
    else:
        yield from verify_episodes(path, act_out=True, threads=0)


def merge(sources: Sequence[str], out: Path) -> None:
    """Put datasets of one kind together, or the shards of one run."""
    found = [shard for source in sources if (shard := shard_folder_of(source))]
    if found:
        if len(found) < len(sources):
            raise UnknownDataset(
                f"shards of a run are merged with each other alone; {len(sources) - len(found)} of"
                f" these {len(sources)} are none"
            )
        merge_shards(found, out)
        return
    refuse_existing(out)
    if any(is_images(source) for source in sources):
        raise UnknownDataset(
            "perception tables are merged only if they are shards of one run (knotgym images"
            " --shard)"
        )
    if all(is_states(source) for source in sources):
        write_states(out, merge_states([read_states(states_path(source)) for source in sources]))
    elif any(is_states(source) for source in sources):
        raise UnknownDataset(
            f"states and trajectories don't go into one file: {', '.join(sources)}"
        )
    else:
        merge_episodes(sources, out, concatenate=True)


def film(path: str, row: int, out: Path) -> None:
    """Act out a state's provenance or an episode and write it as a video.

    Raises:
        UnknownDataset: there is no such row, or nothing is known of how it came to be.
        Untrue: it ended elsewhere; nothing is written.
    """
    refuse_existing(out)
    if is_states(path):
        states = read_states(states_path(path), images=False)
        _in_range(row, len(states))
        if not {"start_qpos", "actions", "steps"} <= states.source.keys():
            raise UnknownDataset(
                f"{path} doesn't say how its states were made, so they can't be acted out"
            )
        rope, start, goal = Rope(), states.source["start_qpos"][row], states.points[row]
        actions, last = (
            states.source["actions"][row, : states.source["steps"][row]],
            states.points[row],
        )
    else:
        reader = EpisodeReader(path)
        _in_range(row, len(reader))
        episode = reader.episode(row)
        reader.close()
        rope = Rope(reader.task.rope)
        start, goal, actions, last = (
            episode.start_qpos,
            episode.goal_points,
            episode.actions,
            episode.points[-1],
        )
    simulation = Simulation(1, rope)
    simulation.lay(start[None])
    frames = [_frame(simulation.points[0], goal, 0)]
    for step, action in enumerate(actions, 1):
        simulation.act(action[None])
        frames.append(_frame(simulation.points[0], goal, step))
    if not np.array_equal(simulation.points[0], last):
        raise Untrue(
            f"row {row} of {path} acted out again ends elsewhere, first bead"
            f" {np.abs(simulation.points[0] - last).max():.3g} m away at most"
        )
    write_film(out, frames + frames[-1:] * FRAMES_PER_SECOND)


def _in_range(row: int, count: int) -> None:
    if row >= count:
        raise UnknownDataset(f"row {row} is not there; there are {count}, from 0")


def _frame(points: Array, goal: Array, step: int) -> NDArray[np.uint8]:
    both = np.concatenate([draw(points), draw(goal)], axis=1)
    return captioned(
        both,
        [
            f"step {step}   code {label(points).chiral or 'loop'}",
            f"goal {label(goal)!s}" if label(goal).nx else "goal loop",
        ],
    )


def _format(path: Path) -> str | None:
    """What an HDF5 file says it is; None if it says nothing or isn't one."""
    try:
        with h5py.File(path, "r") as file:
            return None if "format" not in file.attrs else str(file.attrs["format"])
    except OSError:
        return None


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        return found if isinstance(found, dict) else {}
    except (OSError, ValueError):
        return {}
