"""What a cheaper MuJoCo model of the rope would cost and change: milliseconds an action, and how
far beads end from where ours put them.

    python benchmarks/physics.py [--out physics.json] [--starts 40] [--repeats 5]

Every row is the rope with one setting changed. All of them take the same random actions from the
same curated states, in turn, on one pinned core; milliseconds are medians over the repeats of the
CPU time of an action's `mujoco.mj_step`, "times" is against the published model of the same repeat.
The distances are medians over the starts of the bead that ended furthest from where it ends under
"ours", after one action and after ten. What is rounding shows as 1e-12 or nothing; the root is not:
MuJoCo integrates joint angles, and counted from another bead the same motion is cut into other
steps. `integrator_steps` is a keyword of the environments.
"""

import argparse
import copy
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from knotgym.envs.tasks import TaskConfig
from knotgym.rope.model import Rope, RopeConfig
from knotgym.states.state_file import read_states, shipped

ACTIONS = 10
Tweak = Callable[[mujoco.MjModel], None]


def without(flag: mujoco.mjtDisableBit) -> Tweak:
    def tweak(model: mujoco.MjModel) -> None:
        model.opt.disableflags |= flag.value

    return tweak


def option(name: str, value: float) -> Tweak:
    return lambda model: setattr(model.opt, name, value)


PUBLISHED, OURS = "published: rooted at the start", "ours: rooted in the middle"
VARIANTS: dict[str, tuple[RopeConfig, Tweak]] = {
    PUBLISHED: (RopeConfig(rooted="start"), lambda model: None),
    OURS: (RopeConfig(), lambda model: None),
    "no islands": (RopeConfig(), without(mujoco.mjtDisableBit.mjDSBL_ISLAND)),
    "no mid-phase": (RopeConfig(), without(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)),
    "dense Jacobian": (RopeConfig(), option("jacobian", mujoco.mjtJacobian.mjJAC_DENSE.value)),
    "solver CG": (RopeConfig(), option("solver", mujoco.mjtSolver.mjSOL_CG.value)),
    "solver Newton": (RopeConfig(), option("solver", mujoco.mjtSolver.mjSOL_NEWTON.value)),
    "10 sub-chains": (RopeConfig(sub_chains=10), lambda model: None),
    "14 sub-chains": (RopeConfig(sub_chains=14), lambda model: None),
    "20 sub-chains": (RopeConfig(sub_chains=20), lambda model: None),
    "integrator_steps=20": (TaskConfig(task="tie", integrator_steps=20).rope, lambda model: None),
}


def run(
    rope: Rope,
    model: mujoco.MjModel,
    starts: NDArray[np.float64],
    beads: NDArray[np.int64],
    forces: NDArray[np.float64],
) -> tuple[float, NDArray[np.float64]]:
    """CPU seconds an action; and where the beads are after the first and after the last, (starts,
    2, beads, 3).
    """
    data, spent, where = mujoco.MjData(model), 0.0, np.empty((len(starts), 2, *starts.shape[1:]))
    for start, points in enumerate(starts):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = rope.qpos(points)
        for action in range(ACTIONS):
            data.xfrc_applied[:] = 0.0
            data.xfrc_applied[rope.bodies[beads[start, action]], :3] = forces[start, action]
            began = time.process_time()
            mujoco.mj_step(model, data, rope.config.frame_skip)
            spent += time.process_time() - began
            if action in (0, ACTIONS - 1):
                where[start, int(action > 0)] = rope.points(data.qpos)
    return spent / (len(starts) * ACTIONS), where


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("physics.json"))
    parser.add_argument(
        "--starts", type=int, default=40, help="states from which ten actions are taken"
    )
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rng = np.random.default_rng(0)
    states = read_states(shipped(), images=False).points
    starts = states[rng.choice(len(states), args.starts, replace=args.starts > len(states))]
    beads = rng.integers(states.shape[1], size=(len(starts), ACTIONS))
    forces = RopeConfig().max_force * rng.uniform(-1, 1, (len(starts), ACTIONS, 3))
    models = {}
    for name, (config, tweak) in VARIANTS.items():
        model = copy.deepcopy(Rope(config).model)
        tweak(model)
        models[name] = Rope(config), model
    spent: dict[str, list[float]] = {name: [] for name in models}
    ends: dict[str, NDArray[np.float64]] = {}
    for _ in range(args.repeats):
        for name, (rope, model) in models.items():
            seconds, ends[name] = run(rope, model, starts, beads, forces)
            spent[name].append(seconds)
    table = Table(
        "model", "ms an action", "times as fast", "apart after 1 action, mm", f"after {ACTIONS}, mm"
    )
    rows = {}
    for name in models:
        times = statistics.median(
            theirs / own for theirs, own in zip(spent[PUBLISHED], spent[name], strict=True)
        )
        apart = 1000 * np.median(
            np.linalg.norm(ends[name] - ends[OURS], axis=3).max(axis=2), axis=0
        )
        rows[name] = {
            "ms": 1000 * statistics.median(spent[name]),
            "times": times,
            "apart_mm": apart.tolist(),
        }
        table.add_row(
            name,
            f"{rows[name]['ms']:.2f}",
            f"{times:.2f}",
            *(f"{distance:.2g}" for distance in apart),
        )
    Console(width=120).print(table)
    about = {
        "mujoco": mujoco.__version__,
        "starts": args.starts,
        "actions": ACTIONS,
        "repeats": args.repeats,
    }
    args.out.write_text(
        json.dumps({"settings": about, "models": rows}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
