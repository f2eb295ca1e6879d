"""How well the demonstrator does, and how often its first choice is the one it takes.

    python benchmarks/demonstrator.py --episodes 96
    python benchmarks/demonstrator.py --tasks unknot --nx 2,3,4 --tow-limit 0.04

Plays episodes of the streams of evaluations, so that no reset is one of those that the counts of
passes come from. Prints, of each setup: success; choices where the first pass was taken, and where
one of the first three; episodes with a later choice, and those in which the planner took over;
actions simulated and CPU seconds an episode. The same seed gives the same figures but for the
seconds.
"""

import argparse
import time
from collections import Counter

import numpy as np
from rich.console import Console

from knotgym.control.demonstrator import PLANNER, Demonstrator, DemonstratorConfig
from knotgym.control.pass_counts import DiagramValues, PassCounts
from knotgym.control.rollouts import EVALUATION, Rollout, rollout
from knotgym.envs.tasks import TaskConfig

BATCH = 32  # episodes side by side


def ranks(played: Rollout) -> tuple[list[int], bool]:
    """The number of each choice of an episode, and whether the planner took over."""
    moves, begun = played.episode.move, played.episode.macro_start
    assert moves is not None and begun is not None
    chosen = [str(move).split() for move in moves[begun]]
    return [int(words[1]) for words in chosen], any(str(move).startswith(PLANNER) for move in moves)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", default="tie,convert")
    parser.add_argument("--nx", default="2,3,4")
    parser.add_argument("--split", default="train")
    parser.add_argument("--engine", default="chain")
    parser.add_argument("--tow-limit", type=float)
    parser.add_argument("--episodes", type=int, default=96, help="of each setup")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", type=int, default=DemonstratorConfig().budget)
    parser.add_argument("--candidates", type=int, default=DemonstratorConfig().candidates)
    parser.add_argument("--passes", help="counts of passes, instead of those that ship")
    args = parser.parse_args()
    config = DemonstratorConfig(budget=args.budget, candidates=args.candidates)
    values = DiagramValues(PassCounts.load(args.passes)) if args.passes else None
    for setup in ((task, int(nx)) for task in args.tasks.split(",") for nx in args.nx.split(",")):
        task = TaskConfig(
            task=setup[0],
            nx=setup[1],
            split=args.split,
            engine=args.engine,
            observation="state",
            tow_limit=args.tow_limit,
        )
        policy, played, began = Demonstrator(config, values=values), [], time.process_time()
        for first in range(0, args.episodes, BATCH):
            numbers = range(first, min(first + BATCH, args.episodes))
            played += rollout(task, policy, numbers, args.seed, streams=EVALUATION)
        seconds = (time.process_time() - began) / len(played)
        found = [ranks(one) for one in played]
        taken = Counter(rank for one, _ in found for rank in one)
        planned = np.array([planner for _, planner in found])
        later = np.array([any(rank > 1 for rank in one) for one, _ in found])
        shares = {
            "success": np.mean([one.success for one in played]),
            "first choice": taken[1] / taken.total(),
            "of three": sum(taken[rank] for rank in (1, 2, 3)) / taken.total(),
            "episodes with a later one": later.mean(),
            "planner": planned.mean(),
        }
        actions = np.mean([one.effort.actions for one in played])
        pulls = np.mean([len(one.episode) for one in played])
        told = ", ".join(f"{name} {100 * share:.1f} %" for name, share in shares.items())
        Console(width=200).print(
            f"{task.task} nx {task.nx} {task.split} {task.engine}, {len(played)} episodes: {told};"
            f" {actions:.0f} actions and {seconds:.2f} CPU s"
            f" an episode, {pulls:.1f} pulls long",
            highlight=False,
        )


if __name__ == "__main__":
    main()
