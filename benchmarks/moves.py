"""Make the tables of moves that the planners use, from play and random macro-actions.

    python benchmarks/moves.py passes --out passes.h5
    python benchmarks/moves.py passes --split train-code --out passes-by-code.h5
    python benchmarks/moves.py changes --out changes.h5

`passes` counts what the passes do that the policy `play` tries in its searches, in rounds; each
round's table orders the passes of the next. Some of the passes are drawn at random, or nothing new
would be learned. Only those are kept that are among the best `--most` for some goal.
`changes` counts what the macro-actions of the policy `scripted` do to Gauss codes.

The tables that ship were made by earlier scripts, from about 350,000 passes and 84,000 pulls; their
figures are in notes/validation.md.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from knotgym.common import Table
from knotgym.control import (
    COUNTED_NX,
    EXAMPLES,
    IMAGES,
    Diagram,
    Example,
    Generators,
    Ids,
    MoveRow,
    Moves,
    PassPlan,
    PassPlanner,
    PassValues,
    Play,
    PlayPlayer,
    Pulls,
    Scripted,
    ScriptedPlayer,
    Sight,
    canonical_image,
    first_goal,
    pooled,
    rollouts,
    see,
    template_images,
    templates,
)
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import Pass, sub_chains
from knotgym.topology import GaussCode

TASKS = (("tie", 2), ("tie", 3), ("tie", 4), ("convert", 3), ("unknot", 4))
Counts = Counter[tuple[Diagram, int, Diagram | None]]


class Exploring(PassValues):
    """The order of passes, in which some are replaced by others at random."""

    def __init__(self, moves: Moves, explored: float, rng: np.random.Generator) -> None:
        super().__init__(moves)
        self._explored, self._rng = explored, rng

    def order(self, goal: GaussCode, diagram: Diagram) -> Iterator[tuple[int, int, float]]:
        image, count = canonical_image(diagram)[1], len(templates(diagram.nx))
        known = super().order(goal, diagram)
        while True:
            choice = None if self._rng.random() < self._explored else next(known, None)
            yield choice or (int(self._rng.integers(count)), image, 0.0)


class Counting(Play):
    """Play that counts the passes tried in its searches."""

    def player(self, batch: EpisodeBatch) -> "CountingPlayer":
        return CountingPlayer(self.inner, batch)


class CountingPlayer(PlayPlayer):
    counts: Counts = Counter()

    def decided(self, index: int, found: object) -> None:
        if isinstance(found, PassPlan):
            self.count(found)
        super().decided(index, found)  # type: ignore[arg-type]

    def count(self, found: PassPlan) -> None:
        known: dict[int, tuple[Diagram, dict[Pass, tuple[int, int]]]] = {}
        for tried in found.tried:
            if id(tried.points) not in known:
                (sight,) = see(tried.points[None])
                known[id(tried.points)] = sight.diagram, templates_of(sight)
            before, names = known[id(tried.points)]
            if before.nx > COUNTED_NX:
                continue
            label, image = names[tried.move]
            after, code = None, tried.landing.code
            if code != before.code and code.nx <= COUNTED_NX:
                after = see(tried.landing.points[None])[0].diagram.image(image)
            self.counts[before.image(image), label, after] += 1


def templates_of(sight: Sight) -> dict[Pass, tuple[int, int]]:
    """The template of every pass of a rope, and the symmetry to the diagram that it is of."""
    first, _ = canonical_image(sight.diagram)
    own = [k for k in range(IMAGES) if sight.diagram.image(k) == first]
    all_templates = templates(sight.diagram.nx)
    return {one.on(sight, k): (n, k) for k in own for n, one in enumerate(all_templates)}


def best_passes(counts: Counts, goals: list[GaussCode], most: int, least: int) -> Moves:
    """The table of the best passes of every diagram at which at least `least` began."""

    def table(rows: Counts) -> Moves:
        return Moves(pooled(((*key, seen) for key, seen in rows.items()), pass_image))

    values, begun = PassValues(table(counts)), Counter[Diagram]()
    for (before, _, _), seen in counts.items():
        begun[before] += seen
    kept = set[tuple[Diagram, int]]()
    for before in [diagram for diagram, count in begun.items() if count >= least]:
        for goal in goals:
            for k in range(IMAGES):
                order = zip(values.order(goal, before.image(k)), range(most), strict=False)
                kept |= {
                    (before, pass_image(before.nx, k ^ j, label)) for (label, j, _), _ in order
                }
    return table(Counter({key: seen for key, seen in counts.items() if key[:2] in kept}))


def pass_image(nx: int, image: int, label: int) -> int:
    return template_images(nx, image)[label]


def make_passes(args: argparse.Namespace) -> None:
    rng, moves, goals = np.random.default_rng(args.seed), Moves(), dict[GaussCode, None]()
    for number in range(args.rounds):
        task, nx = TASKS[number % len(TASKS)]
        config = TaskConfig(
            task=task, nx=nx, split=args.split, endless=True, horizon=args.pulls, engine="chain"
        )
        values = Exploring(moves, args.explored, rng)
        # one lane after another would be slow, and the draws of all lanes are one stream
        first = args.seed + number * args.episodes
        seeds = range(first, first + args.episodes)
        rollouts(Counting(PassPlanner(values=values)), config, seeds, keep=None)
        goals |= dict.fromkeys(first_goal(g)[0] for g in EpisodeBatch(config).side_codes("goal"))
        counts = CountingPlayer.counts
        moves = Moves(pooled(((*key, seen) for key, seen in counts.items()), pass_image))
        print(
            f"round {number + 1}, {task} {nx}: {counts.total()} passes, {len(moves.rows)} outcomes"
        )
    best_passes(CountingPlayer.counts, [*goals], args.most, args.least).save(args.out)


class Watching(Scripted):
    """Random macro-actions, whose changes of code are counted."""

    def player(self, batch: EpisodeBatch) -> "WatchingPlayer":
        return WatchingPlayer(batch)


class WatchingPlayer(ScriptedPlayer):
    tried = Counter[Diagram]()
    seen = Counter[tuple[Diagram, Diagram]]()
    examples = defaultdict[tuple[Diagram, Diagram], list[Example]](list)
    most_examples = 8

    def __init__(self, batch: EpisodeBatch) -> None:
        super().__init__(batch)
        # by lane and base bead: the code before, its image and the example; codes counted since
        self._before: dict[tuple[int, int], tuple[Diagram, int, Example]] = {}
        self._met: dict[tuple[int, int], set[GaussCode]] = {}

    def begin(self, ids: Ids, rngs: Generators) -> None:
        super().begin(ids, rngs)
        lanes = {*ids.tolist()}
        self._before = {key: one for key, one in self._before.items() if key[0] not in lanes}

    def act(self, ids: Ids) -> Pulls:
        pulls, points = super().act(ids), self._batch.simulation.points[ids]
        beads = points.shape[1]
        # the dynamics are nearly the same from the first bead of every sub-chain
        for base, _ in sub_chains(self._batch.task.rope_config):
            sights = see(np.roll(points, -base, axis=1))
            for index, sight in zip(ids.tolist(), sights, strict=True):
                code, key = sight.diagram.code, (index, base)
                if key in self._before and code not in self._met[key]:
                    self._met[key].add(code)
                    self.count(*self._before[key], Diagram(code))
                if self.begun[index]:
                    move = self.moves[index]
                    target = -1.0 if move.side else -2.0  # a spread keeps its height
                    if move.target >= 0:
                        target = sight.position((move.target - base) % beads)
                    example = Example(move.side, sight.position((move.bead - base) % beads), target)
                    first, image = canonical_image(Diagram(code))
                    self._before[key], self._met[key] = (first, image, example), {code}
                    self.tried[first] += 1
        return pulls

    def count(self, before: Diagram, image: int, example: Example, after: Diagram) -> None:
        # of a code with symmetries, several images of `after` are the same change
        own = [image ^ k for k in range(IMAGES) if before.image(k) == before]
        k = min(own, key=lambda k: (after.image(k).code.visits, after.image(k).code.chirality, k))
        change = before, after.image(k)
        self.seen[change] += 1
        if len(self.examples[change]) < self.most_examples:
            self.examples[change].append(example.image(k, 2 * before.nx + 1))


def make_changes(args: argparse.Namespace) -> None:
    config = TaskConfig(task="tie", nx=2, endless=True, horizon=args.pulls, engine="chain")
    rollouts(Watching(), config, range(args.seed, args.seed + args.episodes), keep=None)
    made, changes = WatchingPlayer, list[MoveRow]()
    for (before, after), seen in made.seen.items():
        if seen >= args.least and max(before.nx, after.nx) <= COUNTED_NX:
            changes.append(MoveRow(before, len(changes), after, seen, made.tried[before]))
    moves = Moves(changes)
    rows = [
        (moves.index[row.before], row.label, *example)
        for row in changes
        for example in made.examples[row.before, row.after]
    ]
    columns = zip(EXAMPLES.columns, zip(*rows, strict=True), strict=True)
    moves.save(args.out, Table(EXAMPLES, {c.name: np.array(v, c.dtype) for c, v in columns}))
    print(f"{made.tried.total()} macro-actions, {len(changes)} changes of code")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("passes", "changes"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=256, help="of a round")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--pulls", type=int, default=100, help="of an episode")
    parser.add_argument("--split", default="train", help="train-code for sets split by code")
    parser.add_argument("--explored", type=float, default=0.25, help="share of random passes")
    parser.add_argument("--most", type=int, default=10, help="passes kept per diagram and goal")
    parser.add_argument("--least", type=int, default=2, help="times that something was seen")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    (make_passes if args.what == "passes" else make_changes)(args)


if __name__ == "__main__":
    main()
