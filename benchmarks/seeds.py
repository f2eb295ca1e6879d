"""Seeds of eight learners on tiers of bench: which differences are more than chance.

    python benchmarks/seeds.py ROOM [--cells NAME ...] [--updates]

Trains the learners of `examples/learners/offline_torch.py` on the sets of demonstrations (`noisy`,
in decisions) and of random macro-actions (`wander`, in macro-actions), plays each on the test split
by the cell's protocol, and keeps them as entries, ROOM/entries/CELL-seedK.h5, the smallest cells
first. What is there stays, so the script can be stopped and run again. It needs torch, and the
sets: `knotgym suite --states bench --size 100k --policy wander --task tie --nx 2 --out ROOM/data`.
`benchmarks/results.py` makes the page.

--updates plays train starts instead, after each number of updates in TRIED, seed 0. By these rates
numbers were chosen before anything played test: the smallest from which on no doubling brought a
gain whose interval excludes 0. At tie 3 none did.
"""

import os
import subprocess
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
WIDTH, TRIED = 128, (600, 1200, 2400, 4800)  # batches of 128, AdamW at 1e-3
LEARNERS = ("BC", "GCBC", "NextBC", "Flow", "GCIVL", "IQL", "TD3BC", "CRL")
SHORT, LONG = (dict.fromkeys(LEARNERS, count) for count in TRIED[:2])
LONGER = LONG | {"BC": 2400, "IQL": 2400, "TD3BC": 600, "GCIVL": 4800, "CRL": 4800}
ACTIONS = {"noisy": "decision", "wander": "macro"}


class Cell(NamedTuple):
    """What is trained on one set, and played."""

    task: str
    nx: int
    tier: str
    size: str
    seeds: int
    updates: dict[str, int]
    protocol: str = "code"
    learners: tuple[str, ...] = LEARNERS

    @property
    def name(self) -> str:
        kind = f"-{self.protocol}" * (self.protocol != "code")
        return f"{self.task}-nx{self.nx}{kind}-{self.tier}-{self.size}"

    @property
    def data(self) -> str:
        return f"data/knotgym/{self.task}-nx{self.nx}/{self.tier}-chain-bench-{self.size}-v0"


ALL = (
    Cell("tie", 2, "wander", "100k", 5, LONG),
    Cell("tie", 2, "noisy", "100k", 5, LONGER),
    Cell("tie", 3, "wander", "100k", 5, SHORT),
    Cell("tie", 3, "noisy", "10k", 5, SHORT),
    Cell("convert", 2, "wander", "100k", 2, SHORT),
    Cell("convert", 2, "noisy", "10k", 2, SHORT),
    Cell("convert", 3, "wander", "100k", 2, SHORT),
    Cell("convert", 3, "noisy", "10k", 2, SHORT),
    Cell("tie", 2, "noisy", "100k", 5, LONGER, "goal-state", ("BC", "GCBC")),
    Cell("tie", 3, "noisy", "10k", 5, SHORT, "goal-state", ("BC", "GCBC")),
    Cell("convert", 2, "noisy", "10k", 3, SHORT, "goal-state", ("BC", "GCBC")),
    Cell("convert", 3, "noisy", "10k", 3, SHORT, "goal-state", ("BC", "GCBC")),
)
CELLS = {cell.name: cell for cell in ALL}


def train(
    cell: Cell, seed: int, updates: dict[str, int], out: dict[str, Path], loaded: dict[str, Any]
) -> list[str]:
    """Train those learners of a cell whose files `out` aren't there; return words that name all."""
    import offline_torch  # here, as --help needs no torch

    from knotgym.generate import PROTOCOLS

    views = {"observation": PROTOCOLS[cell.protocol], "action": ACTIONS[cell.tier]}
    for learner, file in out.items():
        if not file.with_suffix(".py").exists():
            file.parent.mkdir(exist_ok=True)
            given = Namespace(
                learner=learner, datasets=[cell.data], seed=seed, width=WIDTH, every=0
            )
            vars(given).update(views, updates=updates[learner], out=file)
            offline_torch.make(given, loaded)
    return [word for file in out.values() for word in ("--policy", f"{file.stem}:act")]


def entry(cell: Cell, seed: int, loaded: dict[str, Any]) -> None:
    """Train a cell's learners with a seed, and keep what they play on the test split."""
    file = Path("entries", f"{cell.name}-seed{seed}.h5")
    if file.exists():
        return
    folder = Path(f"{cell.name}-seed{seed}")
    out = {learner: folder / f"{learner}.pt" for learner in cell.learners}
    acting = train(cell, seed, cell.updates, out, loaded)
    acting += ["--protocol", cell.protocol, "--record", f"../{file}"]  # no path of this machine
    evaluate(cell, folder, acting)


def updates(cell: Cell, loaded: dict[str, Any]) -> None:
    """Train a cell's learners with seed 0 for each number in TRIED, and play train starts."""
    folder, acting = Path(f"{cell.name}-updates"), []
    for count in TRIED:
        out = {learner: folder / f"{learner}{count}.pt" for learner in cell.learners}
        acting += train(cell, 0, dict.fromkeys(LEARNERS, count), out, loaded)
    acting += ["--states", "bench", "--engine", "chain", "--split", "train"]
    evaluate(cell, folder, [*acting, "--out", "scores.json"])


def evaluate(cell: Cell, folder: Path, words: list[str]) -> None:
    """Play 256 episodes of each policy in a folder."""
    setup = ("--task", cell.task, "--nx", str(cell.nx), "--workers", "1")
    subprocess.run(("knotgym", "evaluate", *words, *setup), cwd=folder, check=True)


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path, help="folder of data, models and entries")
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS))
    parser.add_argument("--updates", action="store_true", help="play train starts, seed 0")
    given = parser.parse_args()
    room = given.room.resolve()
    sys.path.insert(0, str(ROOT / "examples" / "learners"))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    os.chdir(room)
    Path("entries").mkdir(exist_ok=True)
    cells = [CELLS[name] for name in given.cells]
    loaded: dict[str, dict[str, Any]] = {cell.name: {} for cell in cells}  # stays in memory
    if given.updates:
        for cell in cells:
            updates(cell, loaded[cell.name])
        return
    for seed, cell in product(range(max(cell.seeds for cell in cells)), cells):
        if seed < cell.seeds:
            entry(cell, seed, loaded[cell.name])


if __name__ == "__main__":
    main()
