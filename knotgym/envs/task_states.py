"""States from which a task's starts and goals are sampled."""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from knotgym.common.errors import InvalidInput
from knotgym.envs.knot_tasks import fitting_tasks, start_nx
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.model import RopeConfig, rope_of
from knotgym.states.split_names import CODE_SPLITS
from knotgym.states.state_file import States, read_states, shipped, ships, states_file
from knotgym.topology.knot_table import UNKNOT

OWN, SHIPPED = "own", "shipped"  # origin of states: the user's file, or a set that ships


class TaskSide(NamedTuple):
    """States of a task's starts or goals, their origin (OWN or SHIPPED), and their nx."""

    states: States
    origin: str
    nx: int


def state_origins(config: TaskConfig) -> dict[str, str]:
    """Return the origin of a task's states, OWN or SHIPPED, for `start` and for `goal`.

    Raises:
        InvalidInput: there are no such states.
    """
    starts, goals = task_sides(config)
    return {"start": starts.origin, "goal": goals.origin}


def task_sides(config: TaskConfig) -> tuple[TaskSide, TaskSide]:
    """Return the states from which a task's starts and goals are sampled.

    They come from the requested file. Only plain loops come from the set that ships, if the file
    has none in either split.

    Raises:
        InvalidInput: there are none, or starts and goals are of different knot types.
    """
    path = states_file(config.states)
    own = _of_our_rope(path, config.beads)
    starts, goals = (_side(config, path, own, nx) for nx in (start_nx(config, own), config.goal_nx))
    knots = [
        sorted(set(side.states.knot[side.states.rows(side.nx, config.split)].tolist()))
        for side in (starts, goals)
    ]
    if len({*knots[0], *knots[1]}) > 1:
        raise InvalidInput(
            f"task {config.task!r} with nx = {config.nx} would start as {', '.join(knots[0])} and"
            f" end as {', '.join(knots[1])}, and no action changes the knot type;"
            f" {_fit(config, own)}"
        )
    codes = goals.states.gauss_code[goals.states.rows(goals.nx, config.split)[: config.max_goals]]
    if starts.nx == goals.nx and len(set(codes.tolist())) < 2:
        raise InvalidInput(
            f"a tie to nx = {goals.nx} starts at the simplest diagram of {knots[0][0]} in {path},"
            f" which shows its only goal's code already; {_fit(config, own)}"
        )
    return starts, goals


def _side(config: TaskConfig, path: Path, own: States, nx: int) -> TaskSide:
    """Return the states with nx crossings from which a side of the task is sampled."""
    states, origin = own, SHIPPED if ships(config.states) else OWN
    if nx == 0 and not (states.nx == 0).any() and config.beads == RopeConfig().beads:
        path, origin = shipped(), SHIPPED
        states = _of_our_rope(path, config.beads)
    if not len(states.rows(nx, config.split)):
        if config.split in CODE_SPLITS and len(states.rows(nx, config.split[:-5])):
            raise InvalidInput(
                f"split {config.split!r} has no state with nx = {nx} in {path}: there are too few"
                " diagrams to hold one out; use split 'train' or 'test'"
            )
        if set(own.knot.tolist()) not in (set(), {UNKNOT}):
            advice = _fit(config, own)
        elif there := sorted(set(states.split[states.nx == nx].tolist())):
            advice = f"Use split {' or '.join(map(repr, there))}"
        else:
            beads = "" if config.beads == RopeConfig().beads else f" --set beads={config.beads}"
            advice = f"Generate some: knotgym-generate --nx {nx}{beads}"
        raise InvalidInput(
            f"no states with nx = {nx} in split {config.split!r} of {path}, needed by task"
            f" {config.task!r} with nx = {config.nx}; it has {_contents(states)}."
            f" {advice}"
        )
    return TaskSide(states, origin, nx)


def _fit(config: TaskConfig, own: States) -> str:
    """Return which tasks fit the states of a file, as text for errors."""
    knots = sorted(set(own.knot.tolist()))
    if len(knots) > 1:
        return f"these states are {', '.join(knots)}: keep one type, with knotgym dataset select"
    return f"tasks that fit these states of {knots[0]}: {fitting_tasks(own, config.split)}"


def _of_our_rope(path: Path, beads: int) -> States:
    """Read the states of a file; raise InvalidInput if they were made for another rope."""
    states = _read(path, path.stat().st_mtime_ns if path.exists() else 0)
    # states at rest don't depend on the integrator's step, so the default rope is compared
    if (own := states.points.shape[1]) != beads:
        raise InvalidInput(f"{path} has ropes of {own} beads, got beads = {beads}; use {own}")
    made_for, ours = states.attributes.get("rope"), rope_of(beads).fingerprint
    if made_for != ours:
        raise InvalidInput(f"{path} was made for rope model {made_for}, this version has {ours}")
    return states


def _contents(states: States) -> str:
    """List the crossings and splits of a file, as in "nx 0 (train, test), 3 (test)"."""
    splits = {
        nx: ", ".join(dict.fromkeys(states.split[states.nx == nx].tolist()))
        for nx in sorted(set(states.nx.tolist()))
    }
    return "nx " + ", ".join(f"{nx} ({of})" for nx, of in splits.items()) if splits else "no rows"


@lru_cache(maxsize=4)
def _read(path: Path, written: int) -> States:
    """Read states without pictures, cached by the time at which the file was `written`."""
    return read_states(path, images=False)
