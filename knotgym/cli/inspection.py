"""The work of the `knotgym dataset` commands on a dataset named by a path or an id."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.cli.program import shown
from knotgym.common import Failed, InvalidFile, InvalidInput, atomic_write, one_line, require_output
from knotgym.control import replay
from knotgym.datasets import in_words, locate, open_episodes, summary, try_files
from knotgym.generate import claims, read_entry
from knotgym.generate import faults as dataset_faults
from knotgym.generate import film as film_of
from knotgym.rendering import Film
from knotgym.rope import RopeConfig, simulation_of
from knotgym.runs import Progress, executor, narrow_table
from knotgym.states import read_states, resolve

Image: TypeAlias = NDArray[np.uint8]
_LARGE = 4_000_000  # bytes; larger tables are checked faster by several processes than by one
_WIDTH, _GAP = 80, 3  # characters of a line, and between columns


def print_summary(named: str, console: Console) -> None:
    """Print a summary of a dataset, or of a folder that a package with commands shows."""
    if shown_by := shown(named):
        facts, rows = shown_by
        _print_facts(facts, console)
        if rows:
            _print_table(rows, rows[0][:1], None, console)
        return
    each, lines, tables = summary(locate(named))
    for facts in each:
        _print_facts(facts, console)
    for k, line in enumerate(lines):
        _say(console, line if k else f"{named}: {line}")
    for table in tables.values():
        if table.rows:
            _print_table([table.head, *table.rows], table.left, table.title, console)
            if table.says:
                _say(console, table.says)


def faults(named: str, progress: Progress, sample: int = 0) -> Iterator[str]:
    """Check the datasets that a path or an id names; yield their faults, or say what was checked.

    Raises:
        InvalidFile: the HDF5 library crashes on one of the files.
    """
    root = resolve(named)
    with executor(2) as pool:
        try_files([root, *sorted(root.glob("**/*.h*5"))], pool)
    tables = [file for file in (root, *root.glob("**/*.parquet")) if file.is_file()]
    large = sum(file.stat().st_size for file in tables) > _LARGE
    progress.stage(f"checking {root}")
    try:
        clean, entry = True, read_entry(root)
    except InvalidFile as error:
        yield str(error)
        return
    with executor(0 if large else 1) as pool:
        for fault in entry.faults(progress) if entry else dataset_faults(named, pool.map, sample):
            clean = False
            yield f"{root}: {fault}" if entry else fault
    if clean:
        counts = {} if entry else locate(named).counts(sample)
        said = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        progress.say(f"{named}: {entry or said}: no faults")
        opened = [] if entry else [*map(open_episodes, locate(named).episodes)]
        if claimed := {name for dataset in opened for name in claims(dataset)}:
            said = ", ".join(sorted(claimed))
            progress.say(f"claimed, as nothing can make them again: {said}")


def film(named: str, row: int, out: Path | None, overwrite: bool, progress: Progress) -> None:
    """Replay a state or an episode and write it as a video, by default beside the dataset.

    Raises:
        InvalidInput: there is no such row, or it has no recorded actions.
        Failed: the replay ended in another state; nothing is written.
    """
    located = locate(named)
    out = out or located.folder / "replay.gif"
    Film(out)
    located = located.only("states", "episodes")
    require_output(out, folder=False, overwrite=overwrite, reads=located.files)
    progress.stage("replaying and drawing")
    states, episodes = located.states, located.episodes
    made = _state_film(states, row) if states else _episode_film(episodes[0], row)
    frames, steps, difference = made
    if difference:
        raise Failed(f"row {row} of {named} ends in another state when replayed: {difference}")
    with atomic_write(out, overwrite=overwrite) as temporary:
        Film(temporary).write(frames)
    progress.say(f"{out}: bit for bit the same, {steps} steps")


def _state_film(path: Path, row: int) -> tuple[list[Image], int, str]:
    """Replay a state; return frames, their number of steps, and how the end differs."""
    states = read_states(path, images=False)
    _require_row(row, len(states))
    if not {"start_qpos", "actions", "steps"} <= states.source.keys():
        raise InvalidInput(f"{path} has no recorded actions, so its states can't be replayed")
    end, rope = states.points[row], RopeConfig.of(states.points.shape[1])
    simulation = simulation_of(1, rope, states.engine)
    simulation.set_qpos(states.source["start_qpos"][row][None])
    ropes, pulls = [simulation.points[0].copy()], []
    for action in states.source["actions"][row, : states.source["steps"][row]]:
        beads, forces = simulation.read_actions(action[None])
        pulls.append((int(beads[0]), forces[0]))
        simulation.act(action[None])
        ropes.append(simulation.points[0].copy())
    # where a reset lays the rope; the chain engine's own vertices differ by rounding
    steps, off = len(pulls), np.abs(simulation.rope.points(simulation.qpos())[0] - end).max()
    headings = [f"step {step} of {steps}" for step in range(steps + 1)]
    frames = Film.frames(ropes, end, headings, pulls, np.arange(steps + 1) == steps)
    return frames, steps, f"beads differ by up to {off:.3g} m per coordinate" if off else ""


def _episode_film(path: Path, row: int) -> tuple[list[Image], int, str]:
    """Replay an episode; see `_state_film`."""
    dataset = open_episodes(path)
    _require_row(row, dataset.episodes.episodes.rows)
    stored = dataset.select([row])
    made = replay(stored.episodes, stored.found_task)
    steps, difference = int(made.episodes["length"][0]), made.differences(stored.episodes)
    return film_of(made, dataset.task), steps, "; ".join(difference[:3])


def _require_row(row: int, count: int) -> None:
    if row >= count:
        raise InvalidInput(f"there is no row {row}; the dataset has {count} rows, counted from 0")


def _print_facts(facts: Mapping[str, Any], console: Console) -> None:
    """Print a line for each fact that is known."""
    for name, value in facts.items():
        if text := in_words(value):
            _say(console, f"{name:20} {text}", " " * 21)


def _print_table(
    rows: Sequence[Sequence[object]], left: Sequence[str], title: str | None, console: Console
) -> None:
    """Print a table, its head first, in parts of 80 characters, each of which repeats column 0."""
    widths = [max(len(str(cell)) for cell in column) + _GAP for column in zip(*rows, strict=True)]
    parts = [[0]]
    for k, width in enumerate(widths[1:], 1):
        if len(parts[-1]) > 1 and sum(widths[column] for column in parts[-1]) + width > _WIDTH:
            parts.append([0])
        parts[-1].append(k)
    for part in parts:
        head, *cells = ([one_line(row[k]) for k in part] for row in rows)
        table = narrow_table(head, title=title if part is parts[0] else None, left=left)
        for row in cells:
            table.add_row(*row)
        console.print(table)


def _say(console: Console, line: str, indent: str = "") -> None:
    # paths stay whole, to be copied
    whole: Any = {"break_long_words": False, "break_on_hyphens": False}
    text = fill(line, _WIDTH, subsequent_indent=indent, **whole)
    console.print(text, highlight=False, markup=False, soft_wrap=True)
