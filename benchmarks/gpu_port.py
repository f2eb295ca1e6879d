"""Whether MuJoCo's GPU port can run the rope: what it refuses, and how far it goes another way.

    pip install mujoco-warp
    python benchmarks/gpu_port.py [--out warp.json] [--device cpu] [--solver newton]

The rope is handed to `mujoco_warp` as it is, and then with the solver changed to one that it has;
one action of full force (24 steps) is taken there and by MuJoCo on the CPU, with that solver and
with the rope's own. Compiling the kernels for a CPU takes minutes.

Found with mujoco_warp 4.0.0 on a CPU device: PGS, the rope's solver, is refused. With Newton
everything else is taken (ball joints, connect equalities, fluid drag, capsules), but in float32:
after one action a bead lies 0.02 mm from where MuJoCo has it. What it plays can't be replayed to
the bit on a CPU, which every dataset promises, so it is no backend.
"""

import argparse
import copy
import json
import time
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp
from numpy.typing import NDArray
from rich.console import Console

from knotgym.rope.model import Rope

SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
BEAD, FORCE = 40, (-0.2, 0.15, 0.1)


def on_cpu(model: mujoco.MjModel, rope: Rope) -> NDArray[np.float64]:
    """Generalized positions after one action of MuJoCo's own."""
    data = mujoco.MjData(model)
    data.xfrc_applied[rope.bodies[BEAD], :3] = FORCE
    mujoco.mj_step(model, data, rope.config.frame_skip)
    return np.array(data.qpos)


def on_warp(model: mujoco.MjModel, rope: Rope) -> tuple[NDArray[np.float32], float]:
    """The same of mujoco_warp, and milliseconds a step once the kernels are compiled."""
    there = mujoco_warp.put_model(model)
    for _ in range(2):  # the first compiles
        data = mujoco_warp.put_data(model, mujoco.MjData(model), nworld=1, nconmax=512, njmax=1024)
        xfrc = np.zeros((1, model.nbody, 6), dtype=np.float32)
        xfrc[0, rope.bodies[BEAD], :3] = FORCE
        warp.copy(data.xfrc_applied, warp.array(xfrc, dtype=warp.spatial_vector))
        began = time.perf_counter()
        for _ in range(rope.config.frame_skip):
            mujoco_warp.step(there, data)
        warp.synchronize()
        taken = time.perf_counter() - began
    return data.qpos.numpy()[0], 1000 * taken / rope.config.frame_skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--solver", choices=tuple(SOLVERS), default="newton")
    parser.add_argument("--out", type=Path, default=Path("warp.json"))
    args = parser.parse_args()
    warp.set_device(args.device)
    rope = Rope()
    found: dict[str, Any] = {
        "mujoco": mujoco.__version__,
        "warp": warp.__version__,
        "device": args.device,
        "solver": args.solver,
    }
    try:
        mujoco_warp.put_model(rope.model)
        found["the rope as it is"] = "taken"
    except NotImplementedError as error:
        found["the rope as it is"] = f"refused: {error}"
    own = on_cpu(rope.model, rope)
    changed = copy.copy(rope.model)
    changed.opt.solver = SOLVERS[args.solver]
    other = on_cpu(changed, rope)
    there, taken = on_warp(changed, rope)
    apart = {
        "CPU, its solver over ours": (other, own),
        "warp over CPU, its solver": (there, other),
        "warp over CPU, ours": (there, own),
    }
    for name, (first, second) in apart.items():
        points = rope.points(np.asarray(first, dtype=np.float64)) - rope.points(second)
        found[f"{name}, farthest bead, m"] = float(np.linalg.norm(points, axis=1).max())
    found["ms a step of one rope"] = taken
    for name, value in found.items():
        Console().print(f"{name:45} {value}", highlight=False, soft_wrap=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
