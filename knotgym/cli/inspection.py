"""The work of the `knotgym dataset` commands on a dataset named by a path or an id."""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.cli.summaries import print_episodes, print_images, print_states, print_transcripts
from knotgym.common import Failed, InvalidInput, atomic_write, require_output
from knotgym.control import dataset_faults, replay
from knotgym.datasets import (
    Located,
    differences,
    expanded,
    locate,
    open_episodes,
    read_manifest,
    read_table,
    try_files,
    write_page,
    write_sheet,
)
from knotgym.generate import Result, is_entry, read_entry, replayed, result_of
from knotgym.generate import film as film_of
from knotgym.generate import show as show_results
from knotgym.rendering import film_frames, require_film, write_film
from knotgym.rope import rope_of, simulation_of
from knotgym.runs import Progress, executor
from knotgym.states import read_states, resolve

Image: TypeAlias = NDArray[np.uint8]
_LARGE = 4_000_000  # bytes; larger tables are checked faster by several processes than by one


def show(named: str, console: Console) -> None:
    """Print a summary of a dataset or of transcripts."""
    if print_transcripts(named, console):
        return
    found = locate(named)
    if found.pictures:
        print_images(found.pictures, console)
    elif found.states:
        print_states(named, found.states, console)
    else:
        for one in found.episodes:
            print_episodes(one, console)


def faults(named: str, progress: Progress) -> Iterator[str]:
    """Check the datasets that a path or an id names; yield their faults.

    Raises:
        InvalidFile: the HDF5 library crashes on one of the files.
    """
    root = resolve(named)
    with executor(2) as pool:
        try_files([root, *sorted(root.glob("**/*.h*5"))], pool)
    tables = [file for file in (root, *root.glob("**/*.parquet")) if file.is_file()]
    large = sum(file.stat().st_size for file in tables) > _LARGE
    progress.stage(f"checking {root}")
    if is_entry(root):
        results = list[Result]()
        with executor(0) as pool:
            entry = read_entry(root)
            setups = zip(entry.config.setups(), replayed(entry, pool.map), strict=True)
            for number, ((policy, _), (task, episodes, wrong)) in enumerate(setups):
                yield from (f"{root}: {fault}" for fault in wrong)
                action = str(entry.claimed[number].get("action", ""))
                results.append(result_of(policy.policy, action, task, episodes.episodes))
        show_results(results, progress.console, entry.config.task.engine)
        for number, said in enumerate(entry.claimed, 1):
            progress.say(f"setup {number}, claimed: {json.dumps(said, sort_keys=True)}")
        return
    with executor(0 if large else 1) as pool:
        yield from dataset_faults(named, pool.map, progress.stage)


def checked(named: str) -> str:
    """Describe what `faults` has checked, as counts."""
    if is_entry(resolve(named)):
        entry = read_entry(resolve(named))
        return f"{entry.rows.rows} episodes of {len(entry.pulls['bead'])} pulls, all replayed"
    found, counts = locate(named), Counter[str]()
    if found.pictures:
        counts["pictures"] = len(read_table(found.pictures, columns=["nx"]))
    if found.states:
        counts["Gauss codes"] = len(read_states(found.states, images=False))
    for one in found.episodes:
        own = open_episodes(one).episodes.episodes
        counts["demonstrations" if found.states else "episodes"] += own.rows
        counts["steps replayed"] += int(own["length"].sum())
    counts["checksums"] = len(read_manifest(found.root)[0].get("files", {}))
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def gallery(named: str, out: Path, overwrite: bool) -> str:
    """Write a contact sheet; return a one-line summary."""
    found = locate(named)
    _require_picture_or_page(out, ".png", overwrite, found)
    with atomic_write(out, overwrite=overwrite) as temporary:
        return write_sheet(temporary, found)


def page(named: str, out: Path, overwrite: bool) -> str:
    """Write an HTML page for browsing a dataset; return a one-line summary."""
    found = locate(named)
    _require_picture_or_page(out, ".html", overwrite, found)
    with atomic_write(out, overwrite=overwrite) as temporary:
        return write_page(temporary, found)


def _require_picture_or_page(out: Path, suffix: str, overwrite: bool, found: Located) -> None:
    """Raise if the output can't be written, or might be a file of the dataset beside it."""
    if out.suffix.lower() != suffix:
        raise InvalidInput(f"the output must end in {suffix}, got {out}")
    require_output(out, folder=False, overwrite=overwrite, reads=found.files)


def film(named: str, row: int, out: Path, overwrite: bool, progress: Progress) -> str:
    """Replay a state or an episode and write it as a video; return a one-line summary.

    Raises:
        InvalidInput: there is no such row, or it has no recorded actions.
        Failed: the replay ended in another state; nothing is written.
    """
    require_film(out)
    found = locate(named).only("states", "episodes")
    require_output(out, folder=False, overwrite=overwrite, reads=found.files)
    made = _state_film(found.states, row) if found.states else _episode_film(found.episodes[0], row)
    frames, steps, difference = made
    if difference:
        raise Failed(f"row {row} of {named} ends in another state when replayed: {difference}")
    progress.stage("writing")
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_film(temporary, frames)
    return f"bit for bit the same, {steps} steps"


def _state_film(path: Path, row: int) -> tuple[list[Image], int, str]:
    """Replay a state; return frames, their number of steps, and how the end differs."""
    states = read_states(path, images=False)
    _require_row(row, len(states))
    if not {"start_qpos", "actions", "steps"} <= states.source.keys():
        raise InvalidInput(
            f"{path} has no recorded actions for its states, so they can't be replayed"
        )
    end, rope = states.points[row], rope_of(states.points.shape[1])
    simulation = simulation_of(1, rope, states.engine)
    simulation.lay(states.source["start_qpos"][row][None])
    ropes, pulls = [simulation.points[0].copy()], []
    for action in states.source["actions"][row, : states.source["steps"][row]]:
        beads, forces = simulation.read_actions(action[None])
        pulls.append((int(beads[0]), forces[0] / rope.max_force))
        simulation.act(action[None])
        ropes.append(simulation.points[0].copy())
    # where a reset lays the rope; the chain engine's own vertices differ by rounding
    steps, off = len(pulls), np.abs(simulation.rope.points(simulation.qpos())[0] - end).max()
    headings = [f"step {step} of {steps}" for step in range(steps + 1)]
    frames = film_frames(ropes, end, headings, pulls, np.arange(steps + 1) == steps)
    return frames, steps, f"beads differ by up to {off:.3g} m per coordinate" if off else ""


def _episode_film(path: Path, row: int) -> tuple[list[Image], int, str]:
    """Replay an episode; see `_state_film`."""
    dataset = open_episodes(path)
    _require_row(row, dataset.episodes.episodes.rows)
    stored = dataset.select([row])
    made = expanded(stored, replay).episodes
    steps, difference = int(made.episodes["length"][0]), differences(made, stored.episodes)
    return film_of(made, dataset.task), steps, "; ".join(difference[:3])


def _require_row(row: int, count: int) -> None:
    if row >= count:
        raise InvalidInput(f"there is no row {row}; the dataset has {count} rows, counted from 0")
