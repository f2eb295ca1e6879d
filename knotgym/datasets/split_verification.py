"""Verify that starts and goals are of the task's split and that no episode occurs twice.

A start or goal belongs to the split of the state that it matches, whatever its options say. It
matches a state within NEAR / 2, after the best translation and rotation about z: reset noise at its
default scale stays below 6 mm, and nothing is that close to two states of a curated set. The plain
loop, where action sequences begin, belongs to no split.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import KnotgymError
from knotgym.datasets.episode_dataset import EpisodeDataset
from knotgym.datasets.episodes import episode_digests
from knotgym.envs.task_states import start_nx
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.model import Rope
from knotgym.states.near_duplicates import NEAR, distances
from knotgym.states.split_names import STATE_SPLITS
from knotgym.states.state_file import States, read_states, shipped

_MATCH = NEAR / 2  # metres, root mean square over the beads
_SAME = 1e-6  # metres; above the rounding of `distances`, far below what any stirring does


def split_faults(dataset: EpisodeDataset) -> list[str]:
    """List the episodes whose start or goal isn't of the task's split.

    They are compared with the states that the task resets from. A single episode file whose states
    aren't found is skipped; a dataset without its states is a fault.
    """
    try:
        sides = _sides(dataset)
    except KnotgymError as error:
        return [f"{dataset.path}: its split can't be checked: {error}"]
    faults: list[str] = []
    found: dict[str, set[int]] = {split: set() for split in STATE_SPLITS}
    for name, states in sides.items():
        checked = _Side(name, states, dataset)
        for row in range(dataset.episodes.episodes.rows):
            split, fault = checked.judge(row)
            if split is not None:
                found.setdefault(split, set()).add(row)
            faults += [f"{dataset.path}, episode {row}: {fault}"] if fault else []
    mixed = {split: rows for split, rows in found.items() if rows}
    if len(mixed) > 1:
        listed = "; ".join(f"{split}: {_ranges(rows)}" for split, rows in mixed.items())
        faults.append(f"{dataset.path}: mixes splits, of starts or goals of episodes {listed}")
    return faults


def duplicate_faults(dataset: EpisodeDataset) -> list[str]:
    """List the episodes with the same start, goal and pulls, bit for bit, as an earlier one.

    Without reset noise two seeds may give the same episode; then only a repeated seed is a fault.
    """
    faults: list[str] = []
    seeds, first = dataset.episodes.episodes["seed"].tolist(), dict[Any, int]()
    for row, digest in enumerate(episode_digests(dataset.episodes)):
        earlier = first.setdefault((digest, not dataset.task.reset_noise and seeds[row]), row)
        if earlier != row:
            faults.append(
                f"{dataset.path}, episode {row}: the same as episode {earlier}, start, goal and"
                " pulls"
            )
    return faults


class _Side:
    """The starts or the goals of a file, and the states that they are drawn from."""

    def __init__(self, name: str, states: States, dataset: EpisodeDataset) -> None:
        self.name, self.states, self.task = name, states, dataset.task
        self.table = dataset.episodes.episodes
        self.rope = Rope(self.task.rope)
        self.splits = _split_names(states, self.task)
        self.mine = self.splits == self.task.split
        self.known: dict[bytes, int | None] = {}
        self.allowed = {*states.rows(self.task.goal_nx, self.task.split)[: self.task.max_goals]}
        # start_qpos of demonstrations: splits must not share start states
        self.origins: set[bytes] = set()
        if name == "start" and "start_qpos" in states.source:
            self.origins = {one.tobytes() for one in states.source["start_qpos"][self.mine]}

    def judge(self, index: int) -> tuple[str | None, str]:
        """Return the split of an episode's start or goal, None if unknown, and its fault or ""."""
        given = int(self.table[self.name][index])
        named = None if given < 0 else given
        task, states = self.task, self.states
        if named is not None and not 0 <= named < len(states):
            return None, f"its {self.name} is row {named}, of {len(states)} states"
        row = self._row_at(index)
        if row is None and named is None:
            return None, ""
        at = named if row is None else row
        split, fault = str(self.splits[at]), ""
        if split != task.split:
            fault = f"its {self.name} is row {at} " + (
                f"as the column says, of the {split} split"
                if row is None
                else f"of the states, of the {split} split; the dataset says {task.split}"
            )
        elif row is not None and named is not None and self.splits[named] != task.split:
            fault = f"its {self.name} is row {named}, of the {self.splits[named]} split"
        elif row is not None and named is not None and self.name == "goal":
            right = states.points[named].astype(np.float32)
            if not np.array_equal(self.table["goal_points"][index], right):
                fault = f"its goal isn't row {named} of the states, as the column goal says"
            elif task.max_goals is not None and named not in self.allowed:
                fault = f"its goal is row {named}, not of the first {task.max_goals}, max_goals"
        return split, fault

    def _row_at(self, index: int) -> int | None:
        """Return the row of the state that the start or goal matches, or None."""
        what = "start_qpos" if self.name == "start" else "goal_points"
        if what not in self.table:
            return None  # a recording holds no vertices
        stored = self.table[what][index]
        # episodes share few starts and goals: each is looked up once
        key = stored.tobytes()
        if key in self.origins:
            return None
        if key not in self.known:
            points = self.rope.points(stored) if self.name == "start" else stored
            self.known[key] = self._nearest(np.asarray(points, dtype=np.float64))
        return self.known[key]

    def _nearest(self, points: NDArray[np.float64]) -> int | None:
        if points.shape != self.states.points.shape[1:] or not np.isfinite(points).all():
            return None
        # demonstrations start at the plain loop, which is of no split
        loop = self.rope.loop()
        loops = np.stack([loop, loop * (-1, 1, 1)])  # walked either way
        if self.name == "start" and distances(points, loops).min() < _SAME:
            return None
        apart = distances(points, self.states.points)
        # a state of the task's own split takes precedence
        for rows in (np.flatnonzero(self.mine), np.flatnonzero(~self.mine)):
            if len(rows) and apart[rows].min() < _MATCH:
                return int(rows[np.argmin(apart[rows])])
        return None


def _split_names(states: States, task: TaskConfig) -> NDArray[np.str_]:
    """Return the split of each row, str (n,); by code, such as "test-code", if the task's is."""
    names = states.split.astype("<U10")
    if task.split not in STATE_SPLITS:
        for nx in (start_nx(task, states), task.goal_nx):
            names[states.rows(nx, task.split)] = task.split
    return names


def _sides(dataset: EpisodeDataset) -> dict[str, States]:
    """Read the states that starts and goals are drawn from, found as the environment does."""
    task = dataset.task
    files = [shipped()]
    if task.states is not None:
        own = dataset.states_path()
        if not own.is_file() and dataset.metadata is None:
            return {}
        files.insert(0, own)
    read = [read_states(path, images=False) for path in files]
    return {
        name: next((states for states in read if len(states.rows(nx, task.split))), read[0])
        for name, nx in (("start", start_nx(task, read[0])), ("goal", task.goal_nx))
    }


def _ranges(numbers: Iterable[int]) -> str:
    """Write whole numbers as ranges.

    >>> _ranges([4, 0, 1, 2])
    '0-2, 4'
    """
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)
