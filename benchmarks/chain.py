"""The chain engine beside MuJoCo's: how fast, how near, and alike in random play.

    python benchmarks/chain.py speed [--out chain.json]

Commands: speed, distance, policy.

`speed`: CPU milliseconds an action of either engine on one pinned core, the same ropes and pulls,
in turn. `distance`: how far beads end from where MuJoCo puts them after 1, 2 and 4 random actions
of full force, from shipped states of 0 to 4 crossings, mean over beads and states; and how often
both show the same Gauss code. `policy`: success of random actions in the nine set-ups of both state
sets, test split, with the same starts and goals on either engine, and the 95 % interval of the
difference on these states. Parts that --out holds are not played again.
`passages.py` is about safety.
"""

import json
import os
import statistics
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.envs import TaskConfig
from knotgym.generate import EvaluateConfig, evaluate
from knotgym.rope import CHAIN, MUJOCO, ChainSimulation, Rope, RopeConfig, Simulation, simulation
from knotgym.runs import Difference, RunOptions
from knotgym.states import read_states, shipped
from knotgym.topology import label_many

Array = NDArray[np.float64]
SETS = ("readable", "random-walk")
TASKS = ("unknot", "tie", "convert")
PART = 256  # episodes of one seed
FORCE = RopeConfig().max_force


def starts(each: int, rng: np.random.Generator) -> Array:
    """qpos of `each` states of every crossing number of every set."""
    found = []
    for name in SETS:
        states = read_states(shipped(name), images=False)
        for nx in range(5):
            rows = rng.permutation(np.flatnonzero(states.nx == nx))[:each]
            found.append(states.qpos[rows])
    return np.concatenate(found)


def pulls(count: int, steps: int, rng: np.random.Generator) -> list[tuple[Any, Array]]:
    return [
        (rng.integers(100, size=count), FORCE * rng.uniform(-1, 1, (count, 3)))
        for _ in range(steps)
    ]


def timed(simulation: Simulation, actions: list[tuple[Any, Array]]) -> float:
    """CPU milliseconds an action of one rope."""
    began = time.process_time()
    for beads, forces in actions:
        simulation.step(beads, forces)
    return 1e3 * (time.process_time() - began) / len(actions) / simulation.count


def traced(simulation: Simulation, qpos: Array, actions: list[tuple[Any, Array]]) -> Array:
    """Points after each action: (actions, ropes, beads, 3)."""
    simulation.set_qpos(qpos)
    after = []
    for beads, forces in actions:
        simulation.step(beads, forces)
        after.append(simulation.points.copy())
    return np.stack(after)


def apart(one: Array, other: Array) -> dict[str, float]:
    """Mean distance of beads, millimetres, after 1, 2 and 4 actions."""
    far = 1e3 * np.linalg.norm(one - other, axis=-1).mean(axis=(1, 2))
    return {f"after {k}": round(float(far[k - 1]), 3) for k in (1, 2, 4)}


def speed(args: Namespace, rng: np.random.Generator) -> dict[str, Any]:
    qpos = read_states(shipped("random-walk"), images=False).qpos[: args.ropes]
    engines = [simulation(MUJOCO, len(qpos)), ChainSimulation(len(qpos))]
    for engine in engines:
        engine.set_qpos(qpos)
        timed(engine, pulls(len(qpos), 1, rng))
    spent = []
    for _ in range(args.repeats):
        actions = pulls(len(qpos), 20, rng)
        spent.append((timed(engines[0], actions[:3]), timed(engines[1], actions)))
    medians = [statistics.median(column) for column in zip(*spent, strict=True)]
    return {
        "MuJoCo, ms an action": medians[0],
        "chain, ms an action": medians[1],
        "times as fast": statistics.median(slow / fast for slow, fast in spent),
        "chain, seconds of rope a second": 192 / medians[1],
    }


def distance(args: Namespace, rng: np.random.Generator) -> dict[str, Any]:
    qpos = starts(args.states, rng)
    actions = pulls(len(qpos), 4, rng)
    truth = traced(simulation(MUJOCO, len(qpos)), qpos, actions)
    found = traced(ChainSimulation(len(qpos)), qpos, actions)
    same = [
        statistics.mean(a == b for a, b in zip(label_many(one), label_many(other), strict=True))
        for one, other in zip(truth, found, strict=True)
    ]
    moved = 1e3 * np.linalg.norm(truth[0] - Rope().points(qpos), axis=-1).mean()
    return {
        "states": len(qpos),
        "beads move in the first action, mm": round(float(moved), 2),
        "apart, mm": apart(truth, found),
        "same code after 1, 2, 3, 4": [round(share, 3) for share in same],
    }


def policy(args: Namespace, rng: np.random.Generator) -> dict[str, Any]:
    cells = [(name, task, nx) for name in SETS for task in TASKS for nx in (2, 3, 4)]
    found: dict[str, dict[str, list[int]]] = {}
    if args.out.is_file():
        found = json.loads(args.out.read_text(encoding="utf-8"))["results"]["successes"]
    parts = range(args.episodes // PART)
    # the chain first, then a part of every cell in turn: what takes long is MuJoCo
    order = [(CHAIN, part, cell) for cell in cells for part in parts]
    order += [(MUJOCO, part, cell) for part in parts for cell in cells]
    for engine, part, (name, task, nx) in order:
        key = f"{name} {task} {nx}"
        done = found.setdefault(key, {}).setdefault(engine, [])
        if part < len(done):
            continue
        config = EvaluateConfig(
            tasks=(task,),
            nx=(nx,),
            episodes=PART,
            seed=part,
            task=TaskConfig(task=task, observation="state", states=name, engine=engine),
        )
        done.append(evaluate(config, RunOptions(workers=1, quiet=True))[0].successes)
        told = {"part": PART, "successes": found, "table": compared(found)}
        args.out.write_text(json.dumps({"results": told}, indent=1) + "\n", encoding="utf-8")
    return {"part": PART, "successes": found, "table": compared(found)}


def compared(found: dict[str, dict[str, list[int]]]) -> list[str]:
    """Rows of a table: success on either engine, and the interval of the difference."""
    rows, within = [], 0
    for key, parts in found.items():
        if len(parts) < 2 or not all(parts.values()):
            continue
        sides = [np.arange(PART * len(one)) < sum(one) for one in (parts[CHAIN], parts[MUJOCO])]
        _, low, high, _ = Difference.between(*((side, [np.arange(len(side))]) for side in sides))
        within += low <= 0 <= high
        interval = f"{100 * low:+.1f} to {100 * high:+.1f}"
        cells = (f"{100 * side.mean():.1f} ({len(side)})" for side in sides)
        rows.append(f"| {key} | {' | '.join(cells)} | {interval} |")
    return [*rows, f"{within} of {len(rows)} hold 0"]


COMMANDS = {run.__name__: run for run in (speed, distance, policy)}


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=COMMANDS)
    parser.add_argument("--out", type=Path, default=Path("chain.json"))
    parser.add_argument("--ropes", type=int, default=64)
    parser.add_argument("--states", type=int, default=20, help="of each crossing number and set")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=1024, help="of `policy`, of each cell")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity") and args.command == "speed":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    told = COMMANDS[args.command](args, np.random.default_rng(args.seed))
    args.out.write_text(json.dumps({"results": told}, indent=2) + "\n", encoding="utf-8")
    Console().print(told)


if __name__ == "__main__":
    main()
