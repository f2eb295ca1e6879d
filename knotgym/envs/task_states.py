"""States from which a task's starts and goals are sampled.

No action changes a rope's knot type, so starts and goals are of one type.
"""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput
from knotgym.envs.tasks import TaskConfig
from knotgym.rope import RopeConfig
from knotgym.states import SPLITS, States, is_bundled, read_states, resolve_states, shipped
from knotgym.topology import UNKNOT


class TaskSide(NamedTuple):
    """Where a task's starts or goals are sampled from.

    Attributes:
        states: all states of the file.
        origin: "own", the user's file, or "shipped", a set that ships.
        nx: crossings of the start or the goal.
        rows: int64 (n,), the rows of the task's split with so many.
    """

    states: States
    origin: str
    nx: int
    rows: NDArray[np.int64]


def task_sides(task: TaskConfig) -> list[tuple[TaskSide, TaskSide]]:
    """Return the states from which starts and goals are sampled, for each of `task.singles`.

    They come from the requested file. Only plain loops come from the set that ships, if the file
    has none in either split.

    Raises:
        InvalidInput: there are none, starts and goals are of different knot types, or some starts
            or goals would come from another file than the others, so that rows are ambiguous.
    """
    sides = [_sides(single) for single in task.singles]
    # equal files are read once, see `_read`
    if any(len({id(side.states) for side in same}) > 1 for same in zip(*sides, strict=True)):
        raise InvalidInput(
            f"{resolve_states(task.states)} has no plain loops, which several tasks at once need:"
            " generate some beside the others, as with knotgym-generate --nx 0-4"
        )
    return sides


def _sides(task: TaskConfig) -> tuple[TaskSide, TaskSide]:
    """Return the states of a task with one nx."""
    path = resolve_states(task.states)
    states = _of_our_rope(path, task)
    both = _start_nx(task, states), task.sides[1]
    starts, goals = (_side(task, path, states, nx) for nx in both)
    goals = goals._replace(rows=goals.rows[: task.max_goals])
    begin, end = (
        ", ".join(sorted({*side.states.knot[side.rows].tolist()})) for side in (starts, goals)
    )
    if begin != end or ", " in begin:
        raise InvalidInput(
            f"task {task.task!r} with nx = {task.nx} would start as {begin} and end as {end}, and"
            f" no action changes the knot type; {path} has {_contents(states)}"
        )
    if starts.nx == goals.nx and len(set(goals.states.gauss_code[goals.rows].tolist())) < 2:
        raise InvalidInput(
            f"a tie to nx = {goals.nx} starts at the simplest diagram of {begin} in"
            f" {path}, which shows its only goal's code already; it has {_contents(states)}"
        )
    return starts, goals


def _start_nx(task: TaskConfig, states: States) -> int:
    """Return the number of crossings with which episodes of a task start.

    A tie starts at the simplest diagram of its goals' knot type: the plain loop for the unknot,
    else the diagrams with the fewest crossings in the file.
    """
    start_nx, goal_nx = task.sides
    knots = set(states.knot[states.nx == goal_nx].tolist())
    if task.tasks != ("tie",) or not knots or UNKNOT in knots:
        return start_nx
    return int(states.nx[np.isin(states.knot, sorted(knots))].min())


def _side(task: TaskConfig, path: Path, states: States, nx: int) -> TaskSide:
    """Return the states with nx crossings from which a side of the task is sampled."""
    origin = "shipped" if is_bundled(task.states) else "own"
    if nx == 0 and not (states.nx == 0).any() and task.beads == RopeConfig().beads:
        path, origin = shipped(), "shipped"
        states = _of_our_rope(path, task)
    rows = states.rows(nx, task.split)
    if not len(rows):
        split = SPLITS[task.split]
        if split.by_code and len(states.rows(nx, split.base)):
            raise InvalidInput(
                f"split {task.split!r} has no state with nx = {nx} in {path}: there are too few"
                " diagrams to hold one out; use split 'train' or 'test'"
            )
        beads = "" if task.beads == RopeConfig().beads else f" --set beads={task.beads}"
        raise InvalidInput(
            f"no states with nx = {nx} in split {task.split!r} of {path}, needed by task"
            f" {task.task!r} with nx = {task.nx}; it has {_contents(states)}. Generate some:"
            f" knotgym-generate --nx {nx}{beads}"
        )
    return TaskSide(states, origin, nx, rows)


def _of_our_rope(path: Path, task: TaskConfig) -> States:
    """Read the states of a file; raise InvalidInput if they were made for another rope."""
    states = _read(path, path.stat().st_mtime_ns if path.exists() else 0)
    if (beads := states.points.shape[1]) != task.beads:
        raise InvalidInput(
            f"{path} has ropes of {beads} beads, got beads = {task.beads}; use {beads}"
        )
    # states at rest depend on the rope's shape, not on its damping or the integrator's step
    if unlike := task.rope_at_rest.unlike(states.attributes.get("rope")):
        shape = f" for rope = {task.rope}" if task.rope else ""
        raise InvalidInput(f"{path} was made for {unlike}{shape}")
    return states


def _contents(states: States) -> str:
    """List crossings, splits and knots of a file, as in "nx 3 (train, test), 4 (test) of 3_1"."""
    splits = {
        nx: ", ".join(dict.fromkeys(states.split[states.nx == nx].tolist()))
        for nx in sorted(set(states.nx.tolist()))
    }
    shown = ", ".join(f"{nx} ({of})" for nx, of in splits.items())
    return f"nx {shown} of {', '.join(sorted(set(states.knot.tolist())))}" if splits else "no rows"


@lru_cache(maxsize=4)
def _read(path: Path, written: int) -> States:
    """Read states without pictures, cached by the time at which the file was `written`."""
    return read_states(path, images=False)
