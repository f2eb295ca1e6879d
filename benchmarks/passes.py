"""Make the counts of passes that the demonstrator's order is drawn from, the file that ships.

    python benchmarks/passes.py --rounds play/train
    python benchmarks/passes.py --rounds play/every --every-code
    python benchmarks/passes.py --rounds play/train-code --every-code --split train-code

Plays in the chain engine from starts of the train split towards its goals, or with `--every-code`
towards every code of so many crossings; with `--split train-code` towards those whose diagrams no
held-out goal has. Counts what passes do to
diagrams, and takes the counts into the order after every round. From round `--later` on play
explores less, so that passes of promise are counted more often. Diagrams keep the passes that
are among the best `--most` for one of the goals, unless fewer than `--least` began there.

Counts are written to `--rounds` after every round; run the command again to go on after the last,
with the same result. A round takes half a minute of a core.
"""

import argparse
from pathlib import Path

from knotgym.control.macro_lanes import MacroLanes
from knotgym.control.pass_counts import EVERY_CODE, PASSES, PassCounts, first_goal
from knotgym.control.pass_play import (
    PassPlay,
    PassPlayConfig,
    draw_starts,
    goals_not_held_out,
    searches,
)
from rich.console import Console

from knotgym.common.streams import Stream, generator
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.states.split_names import CODE_SPLITS
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import codes_of

# what an episode of each round plays, in turn: ties are learned from most
TASKS = ("tie-2", "tie-3", "tie-3", "tie-4", "convert-2", "convert-3", "convert-4", "unknot-4")
LATER = PassPlayConfig(explored=0.1, greedy=0.4)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=Path, required=True, help="folder for counts so far")
    parser.add_argument("--count", type=int, default=18, help="rounds")
    parser.add_argument("--later", type=int, default=9, help="rounds until play explores less")
    parser.add_argument("--episodes", type=int, default=3000, help="of a round")
    parser.add_argument("--starts", type=int, default=256, help="resets of each task")
    parser.add_argument("--most", type=int, default=10)
    parser.add_argument("--least", type=int, default=12, help="passes from a diagram that is kept")
    parser.add_argument("--lanes", type=int, default=192, help="other numbers give other counts")
    parser.add_argument("--split", default="train", help="train-code for sets split by code")
    parser.add_argument("--every-code", action="store_true", help="goals are all of nx crossings")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="default: the file that ships")
    args = parser.parse_args()
    console, tasks = Console(), [name.split("-") for name in TASKS]
    drawn = {
        (task, nx): draw_starts(
            TaskConfig(task=task, nx=int(nx), split=args.split, observation="state"),
            args.starts,
            generator(Stream.PASS_STARTS, args.seed, number),
        )
        for number, (task, nx) in enumerate(dict.fromkeys(map(tuple, tasks)))
    }
    if args.every_code:
        for (task, nx), own in drawn.items():
            if args.split in CODE_SPLITS:
                held_in = TaskConfig(task=task, nx=int(nx), split=args.split, observation="state")
                drawn[task, nx] = own._replace(goals=goals_not_held_out(held_in))
            elif task != "unknot":
                drawn[task, nx] = own._replace(goals=[*codes_of(UNKNOT, int(nx))])
    lanes = MacroLanes(args.lanes, MacroActionConfig())
    starts = [drawn[task, nx] for task, nx in tasks]
    args.rounds.mkdir(parents=True, exist_ok=True)
    counts = PassCounts()
    for number in range(args.count):
        path = args.rounds / f"{number}.h5"
        if not path.is_file():
            config = PassPlayConfig() if number < args.later else LATER
            play = PassPlay(counts, config)
            won = [
                reached
                for _, reached in lanes.run(
                    searches(play, starts, args.episodes, args.seed, number)
                )
            ]
            counts.save(path)
            console.print(
                f"round {number + 1}: {100 * sum(won) / len(won):.1f} % reached the goal;"
                f" {counts.seen.total()} passes counted",
                highlight=False,
            )
        # read back in any case: the order of the counts is that of the file
        counts = PassCounts.load(path)
    # images of a goal keep the same passes
    goals = dict.fromkeys(first_goal(goal)[0] for one in drawn.values() for goal in one.goals)
    towards_every = args.every_code and args.split not in CODE_SPLITS
    out = args.out or (EVERY_CODE if towards_every else PASSES[args.split])
    counts.pruned([*goals], args.most, args.least).save(out)


if __name__ == "__main__":
    main()
