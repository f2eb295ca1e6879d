"""The expert in the nine setups of the paper, and a random policy beside it, on the test split.

    knotgym-generate --nx 0-4 --count 40 --balance empirical --out empirical
    python benchmarks/expert.py --empirical empirical/states.h5
        --references knotgym/generate/episodes/data/references.json

Prints success with 95 % intervals, steps and planning seconds an episode. The random policy also
plays the states of --empirical, whose codes are as frequent as a random policy meets them, beside
the curated ones. Every setup is written to --out as it ends; the same command goes on after the
last one there. With --references the mean returns of both are written for `knotgym collect`, which
states them as Minari's reference scores.
"""

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from knotgym.common.atomic_files import atomic_write
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import PolicyConfig
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.evaluate import EvaluateConfig, evaluate
from knotgym.generate.episodes.results import Result
from knotgym.runs.executors import executor


def play(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Setup, as "tie-nx3 expert" or "tie-nx3 random natural", -> its settings, result and wall
    seconds; those in --out are taken from there.
    """
    done: dict[str, dict[str, Any]] = (
        json.loads(args.out.read_text(encoding="utf-8")) if args.out.is_file() else {}
    )
    expert = PolicyConfig(policy="expert", planner=PlannerConfig(budget=args.budget))
    kinds = [
        ("expert", expert, args.episodes, args.states),
        ("random", PolicyConfig(), args.random_episodes, args.states),
    ]
    if args.empirical:
        kinds.append(("random empirical", PolicyConfig(), args.random_episodes, args.empirical))
    with executor(args.workers) as pool:
        for nx in map(int, args.nx.split(",")):
            for task in args.tasks.split(","):
                for kind, policy, episodes, states in kinds:
                    if not episodes:
                        continue
                    shared = TaskConfig(task="tie", observation="state", states=states)
                    config = EvaluateConfig(
                        policies=(policy,),
                        tasks=(task,),
                        nx=(nx,),
                        splits=(args.split,),
                        episodes=episodes,
                        seed=args.seed,
                        task=shared,
                    )
                    settings = json.loads(json.dumps(asdict(config)))
                    name = f"{task}-nx{nx} {kind}"
                    if name in done:
                        if done[name]["settings"] != settings:
                            raise SystemExit(
                                f"{args.out} holds {name} with other settings; give the same"
                                " options again, or another --out"
                            )
                        continue
                    began = time.perf_counter()
                    (result,), _ = evaluate(config, pool)
                    done[name] = {
                        "settings": settings,
                        "result": asdict(result),
                        "seconds": round(time.perf_counter() - began, 1),
                    }
                    with atomic_write(args.out) as temporary:
                        temporary.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")
                    Console(width=150).print(
                        f"{name}: {result.successes} of {result.episodes},"
                        f" {done[name]['seconds']} s",
                        highlight=False,
                    )
    return done


def show(done: dict[str, dict[str, Any]]) -> None:
    """A row for each setup."""
    table = Table(
        "setup", "success", "95 % interval", "steps", "return", "planned actions", "planning s"
    )
    for name, played in done.items():
        result = Result(**played["result"])
        effort = (
            (f"{result.planned_actions:.0f}", f"{result.planning_seconds:.2f}")
            if result.planned_actions
            else ("", "")
        )
        table.add_row(
            name,
            f"{result.successes} of {result.episodes}",
            f"{100 * result.low:.1f} to {100 * result.high:.1f} %",
            "" if result.steps is None else f"{result.steps:.1f}",
            f"{result.mean_return:.2f}",
            *effort,
        )
    Console(width=150).print(table)


def references(done: dict[str, dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Setup -> mean returns of random and expert, and the fewer of the episodes they were taken
    over; where both were played.
    """
    means = {}
    for setup in dict.fromkeys(name.split()[0] for name in done):
        results = {
            policy: done[f"{setup} {policy}"]["result"]
            for policy in ("random", "expert")
            if f"{setup} {policy}" in done
        }
        if len(results) == 2:
            means[setup] = {
                policy: round(result["mean_return"], 4) for policy, result in results.items()
            }
            means[setup]["episodes"] = min(result["episodes"] for result in results.values())
    return means


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--episodes", type=int, default=64, help="of the expert, each setup; 0 for none"
    )
    parser.add_argument(
        "--random-episodes",
        type=int,
        default=256,
        help="of the random policy, each setup; 0 for none",
    )
    parser.add_argument("--tasks", default="unknot,tie,convert")
    parser.add_argument("--nx", default="2,3,4")
    parser.add_argument("--split", default="test")
    parser.add_argument(
        "--states", help="state file for both policies, instead of the one that ships"
    )
    parser.add_argument(
        "--empirical", help="state file of empirical balance, for the random policy once more"
    )
    parser.add_argument("--budget", type=int, default=PlannerConfig().budget)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("expert.json"))
    parser.add_argument("--references", type=Path)
    args = parser.parse_args()
    done = play(args)
    show(done)
    if args.references:
        with atomic_write(args.references) as temporary:
            temporary.write_text(json.dumps(references(done), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
