"""Learn values of diagrams from undirected data, by counting: no network and no demonstrator.

    python examples/learners/diagram_values.py data/tie-nx2/wander-chain-bench-100k-v0 --out dv.h5

Writes dv.h5 and dv.py, a policy: `knotgym evaluate --policy dv:act`, in the same folder. What each
macro-action led to is counted by code and by the passes of a grid that are near, with all images
under the eight symmetries; value iteration orders the passes towards a goal, and the policy makes
the first. It reads the columns of the set alone, no table that ships.
"""

import inspect
import re
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from cards import card_of
from cyclopts import run
from numpy.typing import NDArray

from knotgym.control import Moves, PassValues, Sight
from knotgym.datasets import columns_of
from knotgym.envs import Marked
from knotgym.loaders import arrays, as_policy
from knotgym.topology import GaussCode

MODULE = """from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.control import Moves, PassValues, Sight
from knotgym.envs import Marked
from knotgym.loaders import as_policy
from knotgym.topology import GaussCode

FILES = [__file__[:-3] + ".h5"]
BEADS, DOUBT, SWEEPS = 100, {doubt}, {sweeps}
CARD = {card}  # what an entry claims of the training


{functions}

act = policy_of(FILES[0])
"""
MOST_NX, BEADS, IMAGES = 5, 100, range(8)
# beads between the ends of a pass and of one that it counts for, and failures added to those
# counted, chosen on train starts of tie 3; passes of a path, at most
REACH, DOUBT, SWEEPS = 8, 20, 16


def near(sight: Sight, made: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the numbers and symmetries of the passes that lie near one that was made."""
    diagram, (first, _) = sight.diagram, sight.diagram.canonical()
    images = [k for k in IMAGES if diagram.image(k) == first]
    named = [(one, number, k) for k in images for one, number in Moves.grid(diagram.nx).items()]
    known = np.array([one.on(sight, k) for one, _, k in named])
    apart = np.abs(known[:, :2] - made[:2])
    far = np.minimum(apart, BEADS - apart).sum(axis=1) + 1000 * (known[:, 2] != made[2])
    return [named[k][1:] for k in np.flatnonzero(far <= max(REACH, far.min()))]


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
    for old, new, move in zip(seen(before[kept]), seen(after[kept]), made[kept], strict=True):
        if old.diagram.nx <= MOST_NX:
            known = new.diagram.nx <= MOST_NX and new.diagram.code != old.diagram.code
            counts.update(
                {
                    (old.diagram.image(k), number, new.diagram.image(k) if known else None)
                    for number, k in near(old, move)
                }
            )
    return Moves.counted(counts)


def seen(points: NDArray[Any]) -> list[Sight]:
    """See ropes by their codes alone: counts by outer face, too, are too few for one tier."""
    sights = Sight.of(points)
    return [one._replace(diagram=one.diagram._replace(outer=())) for one in sights]


def policy_of(file: str) -> Any:
    """Return the policy: the pass of most worth towards the goal's code."""
    values = PassValues(Moves.load(file), DOUBT, SWEEPS)

    def predict(observations: Any) -> NDArray[np.int64]:
        marked = Marked.split(observations)
        sights = seen(marked.points.astype(np.float64))
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


def main(dataset: str, *, sweeps: int = SWEEPS, out: Path) -> None:
    """Write the table of a dataset, and the policy of it.

    Args:
        dataset: Minari id or folder of a set of random macro-actions.
        sweeps: of value iteration.
        out: table of moves.
    """
    began = time.process_time()
    table_of(dataset).save(out)
    words = __file__, dataset, "--sweeps", str(sweeps), "--out", out.name
    name = "diagram values" + f", {sweeps} sweep" * (sweeps != SWEEPS)
    of_set = re.findall(r"-seed(\d+)-v", columns_of(dataset).name) or [1]
    seconds, more = time.process_time() - began, {"seed": int(of_set[0]), "action": "macro"}
    card = card_of(name, [dataset], seconds, words, **more)
    functions = "\n\n".join(inspect.getsource(one) for one in (seen, policy_of, code_of))
    module = MODULE.format(card=card, doubt=DOUBT, sweeps=sweeps, functions=functions)
    out.with_suffix(".py").write_text(module)


if __name__ == "__main__":
    run(main)
