"""Which tasks fit the knot types of a state file; no pull changes a rope's knot type."""

from __future__ import annotations

import numpy as np

from knotgym.envs.tasks import TaskConfig
from knotgym.states.state_file import States
from knotgym.topology.knot_table import UNKNOT


def start_nx(task: TaskConfig, states: States) -> int:
    """Crossings that episodes of a task on a file's states begin with.

    A tie begins at the least diagram of the knot that its goals are: the plain loop, or of another
    knot the fewest crossings that the file has.
    """
    knots = set(states.knot[states.nx == task.goal_nx].tolist())
    if task.task != "tie" or not knots or UNKNOT in knots:
        return task.start_nx
    return int(states.nx[np.isin(states.knot, sorted(knots))].min())


def fitting_tasks(states: States, split: str) -> str:
    """The ties and conversions between states of a file's one knot, as a user is told them."""
    there = [nx for nx in sorted(set(states.nx.tolist())) if len(states.rows(nx, split))]
    least = int(states.nx.min())
    ties = [nx for nx in there if nx > least and least in there]
    if least in there and len(set(states.gauss_code[states.rows(least, split)].tolist())) > 1:
        ties = [least, *ties]
    steps = [nx for nx in there if nx - 1 in there]
    fitting = [
        f"{name} with nx = {', '.join(map(str, which))}"
        for name, which in (("tie", ties), ("convert", steps))
        if which
    ]
    return "; ".join(fitting) or "none"
