"""Make the table of transitions that the expert's graph is drawn from, the one that ships.

    python benchmarks/transitions.py --seeds 8 7 0 --rounds 50 20 40

Plays so many rounds of the search from each seed (the defaults made the table that ships), and adds
what archives of other runs have counted (their archive.h5). Changes seen once and codes of more
than --max-nx crossings are left out.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from knotgym.control.transition_counts import TransitionCounts
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.search import SearchConfig, new_archive, search_round
from rich.console import Console

from knotgym.runs.executors import executor


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[8, 7, 0])
    parser.add_argument(
        "--rounds",
        type=int,
        nargs="*",
        default=[50, 20, 40],
        help="of the search, 768 actions each, for each seed",
    )
    parser.add_argument("--archive", type=Path, action="append", default=[])
    parser.add_argument("--max-nx", type=int, default=5)
    parser.add_argument("--least", type=int, default=2, help="times that a change was seen")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("knotgym/control/data/transitions.h5"))
    args = parser.parse_args()
    console, table, settings = Console(), TransitionCounts(), SearchConfig(max_nx=4)
    for path in args.archive:
        table.add(Archive.load(path).transitions, settings.most_templates)
    with executor(args.workers) as pool:
        for seed, rounds in zip(args.seeds, args.rounds, strict=True):
            config = replace(settings, seed=seed)
            archive = new_archive(config)
            for number in range(rounds):
                for batch in search_round(archive, config):
                    for _ in batch.follow(pool):
                        pass
                if number % 10 == 9:
                    classes, changes = len(archive.niches), len(archive.transitions.seen)
                    console.print(
                        f"seed {seed}, round {number + 1}: {classes} classes, {changes} changes",
                        highlight=False,
                    )
            table.add(archive.transitions, settings.most_templates)
    table.pruned(max_nx=args.max_nx, least=args.least).save(args.out)


if __name__ == "__main__":
    main()
