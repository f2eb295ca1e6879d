"""Assignment of states to train and test.

Near-duplicates (`near_duplicates`) are always in the same split. For splits by code see
`States.rows`.

After a change run `pytest tests/datasets/test_splits.py`: no split may hold what is another's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from knotgym.states.near_duplicates import families, nearest
from knotgym.states.sources import STATE_SPLITS
from knotgym.topology import GaussCode, Symmetry, canonical

if TYPE_CHECKING:
    from knotgym.states.state_file import States

# splits of pictures: test-code has held-out codes, test-nx a held-out crossing number
IMAGE_SPLITS = (*STATE_SPLITS, "test-code", "test-nx")


def held_form(code: str, *, marked: bool) -> str:
    """Return what a split of pictures by code compares, in place of a Gauss code.

    Args:
        code: without chirality.
        marked: whether all pictures mark base and direction. If not, a picture fits every code of
            its diagram, so these are one: `topology.canonical`, which also takes mirror images
            and switched crossings for the same.
    """
    return code if marked else str(canonical(GaussCode.parse(code), Symmetry.DIAGRAM))


def split(
    codes: Sequence[GaussCode], train_share: float, rng: np.random.Generator
) -> NDArray[np.str_]:
    """Assign states to "train" and "test", splitting the states of each code as evenly as possible.

    Args:
        codes: codes of the states, compared without chirality.
        train_share: fraction of the states that go to train.
        rng: generator of all random choices.

    Returns:
        str (n,), the split of each state.
    """
    plain = [code.plain for code in codes]
    kinds = sorted(set(plain), key=lambda code: code.visits)
    order = rng.permutation(len(kinds))
    assigned = np.full(len(codes), "test", dtype="<U5")
    # Order all states code by code, with codes and the states of each code shuffled. State i goes
    # to train where floor(i * share + 1/2) steps up: every stretch is split in the same proportion.
    walk = [
        index
        for k in order
        for index in rng.permutation([i for i, code in enumerate(plain) if code == kinds[k]])
    ]
    trained_by = np.floor(np.arange(len(walk) + 1) * train_share + 0.5)
    assigned[np.array(walk, dtype=np.int64)[np.diff(trained_by) > 0]] = "train"
    return assigned


def keep_duplicates_together(
    assigned: NDArray[np.str_], points: NDArray[np.float64], codes: Sequence[GaussCode]
) -> NDArray[np.str_]:
    """Give near-duplicates one split, and keep the sizes of splits where that is possible.

    Families of near-duplicates are assigned first, the largest first, each to the split with the
    most room for it. Of the other states those move that their own split has no room for.

    Args:
        assigned: str (n,), the split of each state.
        points: float64 (n, beads, 3), metres.
        codes: of the states; sizes are kept for each number of crossings.
    """
    changed, family = assigned.copy(), families(points)
    nx = [code.nx for code in codes]
    # room: states that each split of each nx may still take
    room = Counter(zip(nx, assigned.tolist(), strict=True))
    members = [np.flatnonzero(family == one).tolist() for one in np.unique(family)]
    for rows in sorted(members, key=len, reverse=True):  # stable: equal sizes stay in order
        own = str(assigned[rows[0]])
        names = sorted(set(assigned.tolist()), key=lambda name: name != own)  # own wins a tie
        enough = len(assigned) if len(rows) > 1 else 1
        fitting = {name: sum(min(room[nx[row], name], enough) for row in rows) for name in names}
        changed[rows] = max(names, key=lambda name: fitting[name])
        room.subtract((nx[row], str(changed[row])) for row in rows)
    return changed


def overlap(states: States, nx: int) -> dict[str, Any]:
    """Measure what the test states of an nx share with train.

    Returns:
        Values for JSON: "test_states", their number; "code_in_train", how many have a code (without
        chirality) of a train state of the same nx; "diagram_in_train", the same up to symmetry
        (`topology.canonical`); "nearest", the smallest distance in metres to any train
        state of the file at the best symmetry (`near_duplicates`), None if either split is empty.
    """
    train, test = (states.rows(nx, split) for split in STATE_SPLITS)
    codes = {
        name: [GaussCode.parse(text) for text in states.gauss_code[rows].tolist()]
        for name, rows in (("train", train), ("test", test))
    }
    known, diagrams = (
        set(codes["train"]),
        {canonical(code, Symmetry.DIAGRAM) for code in codes["train"]},
    )
    every = np.flatnonzero(states.split == "train")
    near = len(test) and len(every)
    return {
        "test_states": len(test),
        "code_in_train": sum(code in known for code in codes["test"]),
        "diagram_in_train": sum(
            canonical(code, Symmetry.DIAGRAM) in diagrams for code in codes["test"]
        ),
        "nearest": (
            float(nearest(states.points[test], states.points[every])[0].min()) if near else None
        ),
    }
