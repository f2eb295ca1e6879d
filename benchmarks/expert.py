"""The expert in the nine setups of the paper, and a random policy beside it, on the test split.

    python benchmarks/expert.py [--episodes 64] [--random-episodes 256] [--out expert.json] [--references FILE]

Prints success with 95 % intervals, steps and planning seconds an episode. With --references the mean returns are written for
`knotgym collect`, which states them as Minari's reference scores.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console

from knotgym.generate.engines import engine
from knotgym.generate.evaluate import EvaluateConfig, evaluate, report, show
from knotgym.generate.planner import PlannerConfig
from knotgym.generate.policies import PolicyConfig
from knotgym.tasks import TaskConfig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=64, help="of the expert, each setup")
    parser.add_argument("--random-episodes", type=int, default=256, help="of the random policy, each setup; 0 for none")
    parser.add_argument("--tasks", default="unknot,tie,convert")
    parser.add_argument("--nx", default="2,3,4")
    parser.add_argument("--split", default="test")
    parser.add_argument("--states", help="state file, instead of the one that ships; one with natural balance, say")
    parser.add_argument("--budget", type=int, default=PlannerConfig().budget)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("expert.json"))
    parser.add_argument("--references", type=Path)
    args = parser.parse_args()
    console = Console(width=150)
    kinds = [(PolicyConfig(policy="expert", planner=PlannerConfig(budget=args.budget)), args.episodes), (PolicyConfig(), args.random_episodes)]
    parts: list[dict[str, Any]] = []
    means: dict[str, dict[str, float]] = {}
    with engine(args.workers) as pool:
        for task in args.tasks.split(","):
            for nx in map(int, args.nx.split(",")):
                for policy, episodes in kinds:
                    if not episodes:
                        continue
                    base = TaskConfig(task="tie", observation="state", states=args.states)
                    config = EvaluateConfig(
                        policies=(policy,), tasks=(task,), nx=(nx,), splits=(args.split,), episodes=episodes, seed=args.seed, task=base
                    )
                    results, _ = evaluate(config, pool)
                    show(results, console)
                    parts.append(report(config, results))
                    args.out.write_text(json.dumps(parts, indent=1) + "\n")  # a long run: what is there so far
                    row = means.setdefault(f"{task}-nx{nx}", {"episodes": args.episodes})
                    row[policy.policy] = results[0].mean_return
    if args.references:
        args.references.write_text(json.dumps(means, indent=1) + "\n")


if __name__ == "__main__":
    main()
