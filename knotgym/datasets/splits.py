"""Splits: which rows are for training, and how states are dealt out to train and test.

Rows that a symmetry of the rope brings near each other (`near_duplicates`) are of one split. What
splits of a state file by code are, `States.rows` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.near_duplicates import families, nearest
from knotgym.tasks import SPLITS, TaskConfig
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.symmetry import diagram_form

if TYPE_CHECKING:
    from knotgym.datasets.states import States

STATE_SPLITS = SPLITS
# of pictures; test-code shows codes that only it and test-nx show, test-nx more crossings
IMAGE_SPLITS = (*STATE_SPLITS, "test-code", "test-nx")


def split(
    codes: Sequence[GaussCode], by: str, train_share: float, rng: np.random.Generator
) -> NDArray[np.str_]:
    """Assign states to "train" and "test", the states of each code as evenly as can be.

    Args:
        codes: of the states, compared without chirality.
        by: "state", or "code" for splits that share no code.
        train_share: of the states, or of the codes.
        rng: decides.

    Returns:
        str (n,).
    """
    plain = [code.plain for code in codes]
    kinds = sorted(set(plain), key=lambda code: code.visits)
    order = rng.permutation(len(kinds))
    assigned = np.full(len(codes), "test", dtype="<U5")
    if by == "code":
        train = {kinds[k] for k in order[: round(train_share * len(kinds))]}
        assigned[[code in train for code in plain]] = "train"
        return assigned
    # one walk over all states, code by code in random order: every stretch of the walk is split in
    # the same proportion
    walk = [
        index
        for k in order
        for index in rng.permutation([i for i, code in enumerate(plain) if code == kinds[k]])
    ]
    trained_by = np.floor(np.arange(len(walk) + 1) * train_share + 0.5)
    assigned[np.array(walk, dtype=np.int64)[np.diff(trained_by) > 0]] = "train"
    return assigned


def kept_together(
    assigned: NDArray[np.str_], points: NDArray[np.float64], codes: Sequence[GaussCode]
) -> NDArray[np.str_]:
    """The same splits, but near-duplicates are all of the split of the first of them.

    For each state that is moved so, one that has no near-duplicate goes the other way, of the same
    code or else of the same nx, where there is one: splits keep their sizes.

    Args:
        assigned: str (n,).
        points: float64 (n, beads, 3), metres.
        codes: of the states.
    """
    dealt, family = assigned.copy(), families(points)
    alone = np.bincount(family)[family] == 1
    first = np.unique(family, return_index=True)[1][family]
    for row in np.flatnonzero(dealt != dealt[first]).tolist():
        others = np.flatnonzero(alone & (dealt == dealt[first[row]])).tolist()
        same = [other for other in others if codes[other].matches(codes[row])]
        same += [other for other in others if codes[other].nx == codes[row].nx]
        for other in same[:1]:
            dealt[other] = dealt[row]
        dealt[row] = dealt[first[row]]
    return dealt


def overlap(states: States, nx: int) -> dict[str, Any]:
    """What the test states of an nx share with train, JSON-able.

    Returns:
        "test_states"; of them, "code_in_train": those whose code, without chirality, a train state
        of the same nx shows; "diagram_in_train": those whose code one shows up to symmetry
        (`topology.symmetry.diagram_form`); and "nearest", metres: the least distance of any to any
        train state of the file, at the best symmetry (`near_duplicates`), None without both.
    """
    train, test = (states.rows(nx, split) for split in STATE_SPLITS)
    codes = {
        name: [GaussCode.parse(text) for text in states.gauss_code[rows].tolist()]
        for name, rows in (("train", train), ("test", test))
    }
    known, diagrams = set(codes["train"]), {diagram_form(code) for code in codes["train"]}
    every = np.flatnonzero(states.split == "train")
    near = len(test) and len(every)
    return {
        "test_states": len(test),
        "code_in_train": sum(code in known for code in codes["test"]),
        "diagram_in_train": sum(diagram_form(code) in diagrams for code in codes["test"]),
        "nearest": (
            float(nearest(states.points[test], states.points[every])[0].min()) if near else None
        ),
    }


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
