"""How often an action that is only repeated unties a rope, with and without a bound on towing.

    python benchmarks/towing.py --limits none 0.04 --expert-episodes 64

The constant action (1, 1, 1, 1, 1, 1), and forces in the 26 directions of {-1, 0, 1}^3 on the bead
nearest to a fixed point: where the base bead lies at reset, and the world's origin. Each plays the
same --episodes of unknot at each --nx, on the test split, under each of --limits (`tow_limit`,
metres). All episodes of a set-up lie in one batched simulation. The planning expert plays
--expert-episodes of each set-up that has a limit. Writes JSON to --out after every set-up; the same
command goes on after the last one there.
"""

import argparse
import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write
from knotgym.control.policies import PolicyConfig
from knotgym.control.rollouts import episode_seed
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.evaluate import EvaluateConfig, evaluate
from knotgym.runs.executors import executor

DIRECTIONS = [force for force in product((-1, 0, 1), repeat=3) if any(force)]
POINTS = ("base", "origin")


def fixed_actions(base: NDArray[np.float64], directions: int) -> dict[str, NDArray[np.float32]]:
    """Name -> action (6,), for a base bead that lies at `base`, in units of actions, (3,)."""
    places = {"base": base, "origin": np.zeros(3)}
    named = {"constant": np.ones(6, dtype=np.float32)}
    for point, force in product(POINTS, DIRECTIONS[:directions]):
        action = np.concatenate([places[point], force])
        named[f"{point} {force}"] = action.astype(np.float32)
    return named


def repeated(task: TaskConfig, episodes: int, directions: int, seed: int) -> dict[str, int]:
    """Name of a fixed action -> episodes that it unties."""
    names = list(fixed_actions(np.zeros(3), directions))
    count = episodes * len(names)
    batch, actions = EpisodeBatch(task, count, threads=0), np.zeros((count, 6), dtype=np.float32)
    reach = batch.simulation.rope.config.reach
    for index in range(count):
        number, kind = divmod(index, len(names))
        batch.begin(index, np.random.default_rng(episode_seed(seed, number)))
        base = batch.simulation.points[index, 0] / reach
        actions[index] = fixed_actions(base, directions)[names[kind]]
    under_way, untied = np.arange(count), np.zeros(count, dtype=int)
    while len(under_way):
        _, terminated, truncated = batch.step(actions[under_way], under_way)
        untied[under_way[terminated]] = 1
        under_way = under_way[~(terminated | truncated)]
    return dict(zip(names, untied.reshape(episodes, -1).sum(axis=0).tolist(), strict=True))


def summed_up(untied: dict[str, int], episodes: int) -> dict[str, Any]:
    """Rates of the constant action, and of the best and the mean of the others by their point."""
    figures: dict[str, Any] = {"constant": untied["constant"] / episodes}
    for point in POINTS:
        own = {name: k for name, k in untied.items() if name.startswith(point)}
        best = max(own, key=lambda name: own[name])
        figures[point] = {
            "best": own[best] / episodes,
            "best_action": best,
            "mean": sum(own.values()) / len(own) / episodes,
        }
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--limits", nargs="+", default=["none", "0.04"])
    parser.add_argument("--nx", type=int, nargs="+", default=[2, 3, 4])
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--directions", type=int, default=len(DIRECTIONS), help="of the 26, first")
    parser.add_argument("--expert-episodes", type=int, default=0)
    parser.add_argument("--budget", type=int, default=20000, help="of the expert")
    parser.add_argument("--split", default="test")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("towing.json"))
    args = parser.parse_args()
    done = json.loads(args.out.read_text(encoding="utf-8")) if args.out.is_file() else {}
    for limit, nx in product(args.limits, args.nx):
        tow_limit = None if limit == "none" else float(limit)
        task = TaskConfig(
            task="unknot", nx=nx, split=args.split, observation="state", tow_limit=tow_limit
        )
        sizes = f"{args.episodes} and {args.expert_episodes} episodes, seed {args.seed}"
        name = f"nx {nx}, limit {limit}, {args.split}, {sizes}"
        if name not in done:
            untied = repeated(task, args.episodes, args.directions, args.seed)
            done[name] = {"untied": untied, **summed_up(untied, args.episodes)}
            if args.expert_episodes and tow_limit is not None:
                done[name]["expert"] = experts(task, args)
            with atomic_write(args.out) as temporary:
                temporary.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")
        show(name, done[name])


def experts(task: TaskConfig, args: argparse.Namespace) -> float:
    """The expert's rate."""
    from knotgym.control.planner_config import PlannerConfig

    policy = PolicyConfig(policy="expert", planner=PlannerConfig(budget=args.budget))
    config = EvaluateConfig(
        policies=(policy,),
        tasks=("unknot",),
        nx=(task.nx,),
        splits=(task.split,),
        episodes=args.expert_episodes,
        seed=args.seed,
        task=task,
    )
    with executor(args.workers) as pool:
        (result,), _ = evaluate(config, pool)
    return result.success_rate


def show(name: str, figures: dict[str, Any]) -> None:
    """Print a set-up, rates in percent."""
    print(f"{name}: constant {100 * figures['constant']:.1f} %", end="")
    for point in POINTS:
        best, mean = figures[point]["best"], figures[point]["mean"]
        print(f"; {point}: best {100 * best:.1f} %, mean {100 * mean:.1f} %", end="")
    print(f"; expert {100 * figures['expert']:.1f} %" if "expert" in figures else "", flush=True)


if __name__ == "__main__":
    main()
