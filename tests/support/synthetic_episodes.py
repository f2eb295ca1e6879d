"""Episodes of made-up numbers that fit the schemas; no simulator is needed to make them.

The files of `TINY` were played: three episodes each of `knotgym collect --task tie --nx 2 --engine
chain --policy expert` (and `random`) with a horizon of 20 steps and pictures of 32 pixels, written
by `knotgym dataset export --to compact`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Table
from knotgym.datasets import STEPS, Episodes, write_episodes
from knotgym.envs import TaskConfig
from knotgym.topology import GaussCode

TINY = {
    name: Path(__file__).parents[1] / "data/episodes" / f"{name}.h5"
    for name in ("expert", "random")
}
BEADS, NQ = 50, 9
TASK = TaskConfig(task="tie", beads=BEADS, observation="state", image_size=16, engine="chain")
CODES = ("", "1+a,1-a", "1+a,2-c,2+c,1-a", "1-c,1+c")
_CIRCLE = 2 * np.pi * np.arange(BEADS) / BEADS


def episodes(
    lengths: Sequence[int],
    seed: int = 0,
    *,
    codes: Sequence[int] | None = None,
    policy: str = "random",
) -> Episodes:
    """Make episodes of so many pulls.

    All numbers are drawn from the seed; `codes` are the indices in CODES that each state shows.
    """
    rng, count, rows = np.random.default_rng(seed), len(lengths), sum(lengths) + len(lengths)
    sizes = {"beads": BEADS, "nq": NQ, **Episodes.code_sizes(2)}
    shown = rng.integers(len(CODES), size=rows) if codes is None else codes
    read = [GaussCode.parse(CODES[k]) for k in shown]
    goals = [GaussCode.parse(CODES[k]) for k in rng.integers(len(CODES), size=count)]
    schemas = Episodes.schema_beside(STEPS).sized(**sizes), STEPS.sized(**sizes)
    own, steps = schemas[0].empty(count), schemas[1].empty(rows)
    own |= {
        "policy": np.full(count, policy),
        "goal_visits": code_rows(goals, sizes["visits"]),
        "length": np.array(lengths, dtype=np.int64),
        "seed": np.arange(count) + 1000 * seed,
        "start": np.arange(count),
        "goal": np.arange(count),
    }
    steps |= {
        "visits": code_rows(read, sizes["visits"]),
        "signs": sign_rows(read, sizes["labels"]),
        "crossings": np.array([code.nx for code in read], np.int16),
        "bead": rng.integers(BEADS, size=rows).astype(np.uint16),
    }
    for name in ("expert_action", "macro_start", "macro_bead", "macro_target", "macro_side"):
        del steps[name]
    for columns in (own, steps):
        for array in columns.values():
            if array.dtype.kind == "f":
                array[:] = rng.uniform(-1, 1, array.shape)
    # ropes are circles with a bump, so that they can be drawn
    for points in (own["goal_points"], steps["observation"]):
        points[..., 0], points[..., 1] = 0.1 * np.cos(_CIRCLE), 0.1 * np.sin(_CIRCLE)
        points[..., 2] *= 0.01
        points[:, 0, 0] += rng.uniform(0, 0.05, len(points))
    last = np.cumsum(np.asarray(lengths) + 1) - 1
    for name in ("bead", "force", "action", "reward", "applied_fraction"):
        steps[name][last] = 0
    steps["truncated"][last - 1] = True
    return Episodes(Table(schemas[0], own), Table(schemas[1], steps))


def code_rows(codes: Sequence[GaussCode], width: int = 0) -> NDArray[np.int16]:
    """Return the visits of codes as rows, padded with zeros: int16 (n, width).

    `width` is that of the longest code by default.
    """
    width = width or Episodes.code_sizes(max((code.nx for code in codes), default=0))["visits"]
    rows = np.zeros((len(codes), width), dtype=np.int16)
    for row, code in zip(rows, codes, strict=True):
        row[: len(code.visits)] = code.visits
    return rows


def sign_rows(codes: Sequence[GaussCode], width: int = 0) -> NDArray[np.int8]:
    """Return the crossing signs of codes as rows, padded with zeros: int8 (n, width)."""
    width = width or Episodes.code_sizes(max((code.nx for code in codes), default=0))["labels"]
    rows = np.zeros((len(codes), width), dtype=np.int8)
    for row, code in zip(rows, codes, strict=True):
        row[: code.nx] = code.signs
    return rows


def written(path: Path, made: Episodes, task: TaskConfig = TASK) -> Path:
    """Write episodes to a file."""
    write_episodes(path, [made], task)
    return path
