"""Episodes of made-up numbers that fit the schemas; no simulator is needed to make them."""

from collections.abc import Sequence

import numpy as np

from knotgym.common.tables import Table
from knotgym.datasets.episodes import EPISODES, STEPS, Episodes, code_rows, code_sizes, sign_rows
from knotgym.topology.gauss import GaussCode

BEADS, NQ = 5, 9
_CHIRAL = ("", "1+a,1-a", "1+a,2-c,2+c,1-a", "1-c,1+c")


def episodes(lengths: Sequence[int], seed: int = 0, policy: str = "random") -> Episodes:
    """Make episodes of so many pulls; all numbers are drawn from the seed."""
    rng, count, rows = np.random.default_rng(seed), len(lengths), sum(lengths) + len(lengths)
    sizes = {"beads": BEADS, "nq": NQ, **code_sizes(2)}
    codes = [GaussCode.parse(_CHIRAL[k]) for k in rng.integers(len(_CHIRAL), size=rows)]
    goals = [GaussCode.parse(_CHIRAL[k]) for k in rng.integers(len(_CHIRAL), size=count)]
    table, steps = EPISODES.sized(**sizes).empty(count), STEPS.sized(**sizes).empty(rows)
    table |= {
        "policy": np.full(count, policy),
        "goal_visits": code_rows(goals, sizes["visits"]),
        "length": np.array(lengths, dtype=np.int64),
        "seed": np.arange(count) + 1000 * seed,
    }
    steps |= {
        "visits": code_rows(codes, sizes["visits"]),
        "signs": sign_rows(codes, sizes["labels"]),
        "crossings": np.array([code.nx for code in codes], np.int16),
    }
    del steps["expert_action"]
    for columns in (table, steps):
        for array in columns.values():
            if array.dtype.kind == "f":
                array[:] = rng.normal(size=array.shape)
    last = np.cumsum(np.asarray(lengths) + 1) - 1
    for name in ("bead", "force", "action", "reward", "share"):
        steps[name][last] = 0
    steps["truncated"][last - 1] = True
    return Episodes(Table(EPISODES.sized(**sizes), table), Table(STEPS.sized(**sizes), steps))
