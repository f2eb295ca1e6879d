"""Learn values of diagrams from undirected data, by counting: no network and no demonstrator.

    python examples/learners/diagram_values.py data/tie-nx2/wander-chain-bench-100k-v0 --out dv.h5

Writes dv.h5 and dv.py, a policy: `knotgym evaluate --policy dv:act`, in the same folder. What each
macro-action led to is counted by diagram (code and outer face) and by the nearest pass of a grid,
with all images under the eight symmetries; value iteration orders the passes towards a goal, and
the policy makes the first. It reads the columns of the set alone, no table that ships.
"""

import re
import shlex
import sys
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import sha256
from knotgym.control import Moves, PassValues, Sight
from knotgym.datasets import columns_of
from knotgym.envs import Marked
from knotgym.loaders import arrays
from knotgym.topology import GaussCode

MODULE = """import sys

sys.path.insert(0, {folder!r})
from diagram_values import policy_of

FILES = [__file__[:-3] + ".h5"]
CARD = {card}  # what an entry claims of the training
act = policy_of(FILES[0])
"""
MOST_NX, BEADS, IMAGES = 5, 100, range(8)


@lru_cache
def grid(nx: int) -> tuple[Any, ...]:
    """List the passes of diagrams of nx crossings: any two places, or a strand some beads away."""
    if nx == 0:
        reach = (8, 11, 14, 18, 24, 32, 40, 50)
        pairs = [(bead, bead + k) for bead in range(5, 100, 5) for n in reach for k in (n, -n)]
        places = [(0, *pair) for pair in pairs if 0 < pair[1] < 100]
    else:
        parts: tuple[int, ...] = {1: (20, 50, 80), 2: (25, 50, 75)}.get(nx, (30, 70))
        ends = [100 * arc + part for arc in range(2 * nx + 1) for part in parts]
        places = [(0, bead, end) for bead in ends for end in ends if bead != end]
        parts = (30, 70) if nx > 1 else (20, 35, 50, 65, 80)
        ends = [100 * arc + part for arc in range(2 * nx + 1) for part in parts]
        places += [(1, bead, beads) for bead in ends for beads in (10, 14, 18, -10, -14, -18)]
    return tuple(Moves(templates=[(*one, side) for one in places for side in (1, -1)]).templates)


TEMPLATES = [one for nx in range(MOST_NX + 1) for one in grid(nx)]
FIRST = np.cumsum([0, *(len(grid(nx)) for nx in range(MOST_NX))]).tolist()
NUMBERS = {(nx, one): FIRST[nx] + k for nx in range(MOST_NX + 1) for k, one in enumerate(grid(nx))}


@lru_cache(maxsize=4096)
def passes(sight: Sight) -> tuple[NDArray[np.int64], list[tuple[int, int]]]:
    """Return all passes of a rope, (n, 3), and each one's number and symmetry."""
    diagram = sight.diagram
    first, _ = diagram.canonical()
    named = [(NUMBERS[diagram.nx, one], k) for k in IMAGES if diagram.image(k) == first
             for one in grid(diagram.nx)]  # fmt: skip
    return np.array([TEMPLATES[number].on(sight, k) for number, k in named]), named


def nearest(sight: Sight, made: NDArray[np.int64]) -> tuple[int, int]:
    """Return the number and the symmetry of the pass that is nearest to the one that was made."""
    known, named = passes(sight)
    apart = np.abs(known[:, :2] - made[:2])
    far = np.minimum(apart, BEADS - apart).sum(axis=1) + 1000 * (known[:, 2] != made[2])
    return named[int(far.argmin())]


def table_of(dataset: str) -> Moves:
    """Count what the macro-actions of a dataset led to."""
    data = arrays(dataset, observation="state", action="macro")
    before, after = (
        data[name][:, : 3 * BEADS].reshape(-1, BEADS, 3).astype(np.float64)
        for name in ("observations", "next_observations")
    )
    counts = Counter[Any]()
    made = data["actions"] * [1, 1, 2] - [0, 0, 1]
    kept = ~data["timeouts"]  # the last of an episode may be cut short
    for old, new, move in zip(
        Sight.of(before[kept]), Sight.of(after[kept]), made[kept], strict=True
    ):
        if old.diagram.nx <= MOST_NX:
            number, image = nearest(old, move)
            seen = new.diagram.nx <= MOST_NX and new.diagram.code != old.diagram.code
            led = new.diagram.image(image) if seen else None
            counts[old.diagram.image(image), number, led] += 1
    return Moves(pooled(counts), TEMPLATES)


def pooled(counts: Counter[Any]) -> Iterator[tuple[Any, int, Any, int, int]]:
    """Yield the rows of a table: counts summed over the symmetries of each diagram."""
    tried, seen = Counter[Any](), Counter[Any]()
    for (before, number, after), count in counts.items():
        for k in (k for k in IMAGES if before.image(k) == before):
            there = NUMBERS[before.nx, TEMPLATES[number].image(k, before.nx)]
            tried[before, there] += count
            if after is not None:
                seen[before, there, after.image(k)] += count
    return ((*key, count, tried[key[:2]]) for key, count in seen.items())


def policy_of(file: str) -> Any:
    """Return the policy: the pass of most worth towards the goal's code."""
    from knotgym.loaders import as_policy

    values = PassValues(Moves.load(file))

    def predict(observations: Any) -> NDArray[np.int64]:
        marked = Marked.split(observations)
        sights = Sight.of(marked.points.astype(np.float64))
        return np.array(
            [chosen(*one) for one in zip(sights, marked.goal, marked.points, strict=True)]
        )

    def chosen(sight: Sight, tokens: Any, points: Any) -> list[int]:
        for move, _ in values.passes(code_of(tokens), sight):
            return [move.bead, move.target, (move.side + 1) // 2]
        rng = np.random.default_rng(np.frombuffer(points.tobytes(), np.uint32))  # what isn't known
        bead = int(rng.integers(BEADS))
        return [bead, (bead + int(rng.integers(8, 92))) % BEADS, int(rng.integers(2))]

    return as_policy(predict, action="macro", frame="canonical", observation="marked")


def code_of(tokens: NDArray[Any]) -> GaussCode:
    """Return the code of tokens (n, 2): over or under, and the index of the other visit."""
    sides, others = tokens[tokens[:, 0] != 0].astype(int).T.tolist() or ([], [])
    first = sorted(k for k, other in enumerate(others) if k < other)
    label = {k: n + 1 for n, k in enumerate(first)}
    each = enumerate(zip(sides, others, strict=True))
    return GaussCode(tuple(side * label[min(k, other)] for k, (side, other) in each))


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="Minari id or folder of a set of random macro-actions")
    parser.add_argument("--out", type=Path, required=True, help="table of moves")
    given = parser.parse_args()
    began = time.process_time()
    table_of(given.dataset).save(given.out)
    opened = columns_of(given.dataset)
    card = {
        "learner": "diagram values",
        "data": {opened.name: sha256(opened.path)},
        "seed": int((re.findall(r"-seed(\d+)-v", opened.name) or [1])[0]),  # of the set
        "action": "macro",
        "seconds": round(time.process_time() - began, 1),
        "command": shlex.join(["python", "examples/learners/diagram_values.py", *sys.argv[1:]]),
    }
    module = MODULE.format(card=card, folder=str(Path(__file__).parent))
    given.out.with_suffix(".py").write_text(module)


if __name__ == "__main__":
    main()
