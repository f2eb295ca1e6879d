"""Make the tables of moves that the planners use: play, and count where passes lead.

    python benchmarks/moves.py passes.h5 --out passes.h5
    python benchmarks/moves.py passes-by-code.h5 --out passes-by-code.h5
    python benchmarks/moves.py passes-every-code.h5 --out passes-every-code.h5

Ropes are led to one goal after another by the search of the policy `expert`, and all passes that it
tries are counted. Each round's table orders the passes of the next; some passes are drawn at
random, or nothing new would be learned. Only those are kept that are among the best `--most` for
some goal. All draws come from `--seed`: the same command writes the same bytes.

The tables that ship were counted by earlier scripts, from about 350,000 passes; a test compares
what this one counts with them.
"""

from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Generator, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import Array, Stream
from knotgym.control import BatchedSearch, Moves, PassPlannerConfig, PassSearch, PassValues, Sight
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import Pass
from knotgym.topology import UNKNOT, GaussCode, Symmetry, canonical, codes_of, label

TASKS = (("tie", 2), ("tie", 3), ("tie", 4), ("convert", 3), ("unknot", 4))
MOST_NX = 5  # crossings of the diagrams that are counted
IMAGES = range(8)
# table that ships -> split whose starts are played, and the goals: the split's own; all codes of 2
# to 4 crossings; or those but the ones with the diagram of a held-out goal
SHIPPED = {
    "passes.h5": ("train", "own"),
    "passes-by-code.h5": ("train-code", "not held out"),
    "passes-every-code.h5": ("train", "every"),
}
# diagram before, which is the first of its images; number of the move; diagram after, None for any
# not of interest
Counts = Counter[tuple[Any, int, Any]]


def best_passes(counts: Counts, goals: Iterable[GaussCode], most: int, least: int) -> Moves:
    """The table of the best passes of every diagram at which at least `least` began."""
    values, begun = PassValues(Moves.counted(counts)), Counter[Any]()
    for (before, _, _), count in counts.items():
        begun[before] += count
    kept = set[tuple[Any, int]]()
    for before in [diagram for diagram, count in begun.items() if count >= least]:
        grid = Moves.grid(before.nx)
        for goal in goals:
            for k in IMAGES:
                order = zip(values.order(goal, before.image(k)), range(most), strict=False)
                kept |= {
                    (before, grid[values.moves.templates[number].image(k ^ j, before.nx)])
                    for (number, j, _), _ in order
                }
    return Moves.counted({key: count for key, count in counts.items() if key[:2] in kept})


def play(
    state: Array,
    points: Array,
    goals: Sequence[GaussCode],
    values: PassValues,
    args: Namespace,
    rng: np.random.Generator,
) -> Generator[Any, Any, Counts]:
    """Lead a rope to one goal after another; count all passes on the way.

    Args:
        state, points: of the chain engine: where the rope lies.
        goals: from which goals are drawn.
        values: order of the passes.
        args: `pulls` to play for, and the share of passes `explored` at random.
        rng: source of all draws.
    """
    counts, left = Counts(), int(args.pulls)
    while left > 0:
        goal = goals[int(rng.integers(len(goals)))]
        landing, (sight,) = None, Sight.of(points[None])
        own = sight.diagram
        if rng.random() >= args.explored and not own.code.matches(goal):
            plan = yield from PassSearch(values, goal, PassPlannerConfig()).run(state, points)
            for tried in plan.tried:
                count(counts, tried.points, tried.move, tried.landing.points)
            left -= plan.spent
            landing = plan.passes[-1].landing if plan.passes else None
        if landing is None:
            some = [*Moves.grid(min(own.nx, MOST_NX))]
            # of the diagram's first image, for which templates are counted
            image = own.canonical()[1]
            move = some[int(rng.integers(len(some)))].on(sight, image)
            landing = yield from BatchedSearch.try_pass(state, move, goal)
            left -= max(1, landing.pulls)
            count(counts, points, move, landing.points)
        if landing.lost:
            break
        state, points = landing.state, landing.points
    return counts


def count(counts: Counts, points: Array, move: Pass, led: Array) -> None:
    """Count a pass of a rope that lay at `points`, and lies at `led` now."""
    (sight,) = Sight.of(points[None])
    before = sight.diagram
    if before.nx > MOST_NX or move.bead == move.target:
        return
    number, image = named(sight)[move]
    after, code = None, label(led)
    if code != before.code and code.nx <= MOST_NX:
        after = Sight.of(led[None])[0].diagram.image(image)
    counts[before.image(image), number, after] += 1


@lru_cache(maxsize=256)
def named(sight: Sight) -> dict[Pass, tuple[int, int]]:
    """The template of every pass of a rope, and the symmetry to the diagram that it is of."""
    before = sight.diagram
    first, _ = before.canonical()
    own = [k for k in IMAGES if before.image(k) == first]
    return {one.on(sight, k): (n, k) for k in own for one, n in Moves.grid(before.nx).items()}


def goals_of(batch: EpisodeBatch, which: str) -> list[GaussCode]:
    """The codes that ropes are led to."""
    if which == "own":
        return batch.side_codes("goal") + batch.side_codes("start")
    every = [code for nx in (2, 3, 4) for code in codes_of(UNKNOT, nx)]
    if which == "every":
        return every
    held = {
        canonical(code, Symmetry.DIAGRAM)
        for task, nx in TASKS
        for code in EpisodeBatch(TaskConfig(task=task, nx=nx, split="test-code")).side_codes("goal")
    }
    return [code for code in every if canonical(code, Symmetry.DIAGRAM) not in held]


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=SHIPPED)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=256, help="of a round")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--pulls", type=int, default=1000, help="simulated for an episode")
    parser.add_argument("--explored", type=float, default=0.25, help="share of random passes")
    parser.add_argument("--most", type=int, default=10, help="passes kept per diagram and goal")
    parser.add_argument("--least", type=int, default=2, help="passes counted at a diagram")
    parser.add_argument("--first", type=Path, help="table that orders the first round's passes")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    split, which = SHIPPED[args.table]
    counts, sought = Counts(), dict[GaussCode, None]()
    values = PassValues(Moves() if args.first is None else Moves.load(args.first))
    for number in range(args.rounds):
        task, nx = TASKS[number % len(TASKS)]
        config = TaskConfig(task=task, nx=nx, split=split, engine="chain", observation="state")
        batch, ids = EpisodeBatch(config, args.episodes), np.arange(args.episodes)
        batch.begin(ids, [Stream.PASS_STARTS.derived_seed(args.seed, number, k) for k in ids])
        goals = goals_of(batch, which)
        sought |= dict.fromkeys(goals)
        rngs = [Stream.PASS_PLAY.generator(args.seed, number, k) for k in ids]
        states, points = batch.simulation.states(ids), batch.simulation.points[ids].copy()
        played = (
            play(*begun, goals, values, args, rng)
            for begun, rng in zip(zip(states, points, strict=True), rngs, strict=True)
        )
        # in order of their numbers, whichever ends first
        for _, found in sorted(BatchedSearch(128).run(played)):
            counts.update(found)
        values = PassValues(Moves.counted(counts))
        print(f"round {number + 1}, {task} {nx}: {counts.total()} passes, {len(counts)} outcomes")
    best_passes(counts, sought, args.most, args.least).save(args.out)


if __name__ == "__main__":
    main()
