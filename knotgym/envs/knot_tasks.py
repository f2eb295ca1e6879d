"""Tasks that fit the knot types of a state file; no action changes a rope's knot type."""

import numpy as np

from knotgym.envs.tasks import TaskConfig
from knotgym.states.state_file import States
from knotgym.topology.knot_table import UNKNOT


def start_nx(task: TaskConfig, states: States) -> int:
    """Return the number of crossings with which episodes of a task start.

    A tie starts at the simplest diagram of its goals' knot type: the plain loop for the unknot,
    else the diagrams with the fewest crossings in the file.
    """
    knots = set(states.knot[states.nx == task.goal_nx].tolist())
    if task.task != "tie" or not knots or UNKNOT in knots:
        return task.start_nx
    return int(states.nx[np.isin(states.knot, sorted(knots))].min())


def fitting_tasks(states: States, split: str) -> str:
    """Return the ties and conversions that a file of one knot type allows, as text for errors."""
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
