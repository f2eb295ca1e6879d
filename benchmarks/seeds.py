"""Seeds of eight learners on tiers of bench: which differences are more than chance.

    python benchmarks/seeds.py ROOM --choose     half and twice the updates, on train starts
    python benchmarks/seeds.py ROOM

Trains the learners of `examples/learners/offline_torch.py` on the sets of demonstrations (`noisy`,
in decisions) and of random macro-actions (`wander`, in macro-actions), plays each on the test split
with protocol code, and keeps them as entries, ROOM/entries/CELL-seedK.h5, the smallest cells first.
What is there stays, so the script can be stopped and run again. It needs torch.
`benchmarks/results.py` makes the page.

The settings were fixed before the first training that counts: one number of updates for all, by no
search, as cores were short. --choose shows what half and twice as many bring on held-out train
starts, with seed 0.
"""

import json
import os
import subprocess
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
LEARNERS = ("BC", "GCBC", "NextBC", "Flow", "GCIVL", "IQL", "TD3BC", "CRL")
UPDATES, WIDTH, SEEDS = 600, 128, 5  # batches of 128, AdamW at 1e-3
ACTIONS = {"noisy": "decision", "wander": "macro"}
# task, nx, tier, size, seeds: the small ones first
CELLS = {
    f"{task}-nx{nx}-{tier}-{size}": (task, nx, tier, size, seeds)
    for task, nx, tier, size, seeds in (
        ("tie", 2, "wander", "100k", 5),
        ("tie", 2, "noisy", "100k", 5),
        ("tie", 3, "wander", "100k", 5),
        ("tie", 3, "noisy", "10k", 5),
        ("convert", 2, "wander", "100k", 1),
        ("convert", 2, "noisy", "10k", 1),
        ("convert", 3, "wander", "100k", 1),
        ("convert", 3, "noisy", "10k", 1),
    )
}


def run(*words: object, cwd: Path) -> None:
    """Run a command; end with its status if it fails."""
    search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    made = subprocess.run(
        [*map(str, words)], cwd=cwd, env={**os.environ, "PYTHONPATH": search}, check=False
    )
    if made.returncode:
        sys.exit(made.returncode)


class Room:
    """A folder of data, models and entries; sets that are loaded stay in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.loaded = folder, dict[str, dict[str, Any]]()
        (folder / "entries").mkdir(parents=True, exist_ok=True)

    def data(self, name: str) -> str:
        """Return the folder of a cell's set; make it if there is none."""
        task, nx, tier, size, _ = CELLS[name]
        data = f"data/knotgym/{task}-nx{nx}/{tier}-chain-bench-{size}-v0"
        if not (self.folder / data).exists():
            setup = ("--task", task, "--nx", nx, "--policy", tier, "--size", size)
            more = (*setup, "--states", "bench", "--workers", 1, "--resume", "--out", "data")
            run("knotgym", "suite", *more, cwd=self.folder)
        return data

    def train(self, name: str, seed: int, folder: str, updates: Sequence[int]) -> None:
        """Train what a folder lacks of the learners of a cell."""
        sys.path.insert(0, str(ROOT / "examples" / "learners"))
        import offline_torch

        (self.folder / folder).mkdir(exist_ok=True)
        os.chdir(self.folder)
        data, action = self.data(name), ACTIONS[CELLS[name][2]]
        for learner in LEARNERS:
            out = Path(folder, f"{learner}.pt")
            if out.with_suffix(".py").exists():
                continue
            given = Namespace(learner=learner, datasets=[data], action=action, updates=updates)
            vars(given).update(width=WIDTH, seed=seed, out=out)
            offline_torch.make(given, self.loaded.setdefault(name, {}))

    def choose(self) -> None:
        """Print how often learners succeed from train starts, by updates."""
        counts = UPDATES // 2, UPDATES, 2 * UPDATES
        for name in ("tie-nx2-wander-100k", "tie-nx2-noisy-100k"):
            folder = f"choose-{name}"
            self.train(name, 0, folder, counts)
            files = [f"{one}_{k}" for one in LEARNERS for k in counts[:-1]] + [*LEARNERS]
            acting = [word for one in files for word in ("--policy", f"{one}:act")]
            acting += ["--task", "tie", "--nx", "2", "--states", "bench", "--engine", "chain"]
            acting += ["--split", "train", "--workers", 1]
            run("knotgym", "evaluate", *acting, "--out", "scores.json", cwd=self.folder / folder)
            found = json.loads((self.folder / folder / "scores.json").read_text())
            for one in found["results"]:
                print(name, one["policy"], round(100 * one["success_rate"], 1))

    def enter(self, name: str, seed: int) -> None:
        """Make a cell's entry of a seed, if there is none."""
        task, nx, *_ = CELLS[name]
        entry = self.folder / "entries" / f"{name}-seed{seed}.h5"
        if entry.exists():
            return
        models = f"{name}-seed{seed}"
        self.train(name, seed, models, [UPDATES])
        acting = [word for one in LEARNERS for word in ("--policy", f"{one}:act")]
        acting += ["--protocol", "code", "--task", task, "--nx", str(nx)]
        acting += ["--workers", "1", "--record"]
        acting += [os.path.relpath(entry, self.folder / models)]  # no path of this machine
        run("knotgym", "evaluate", *acting, cwd=self.folder / models)


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path, help="folder of data, models and entries")
    parser.add_argument("--choose", action="store_true", help="play held-out train starts")
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS))
    parser.add_argument("--seeds", type=int, nargs="+", default=range(SEEDS))
    given = parser.parse_args()
    room = Room(given.room.resolve())
    if given.choose:
        return room.choose()
    for seed in given.seeds:
        for name in given.cells:
            if seed < CELLS[name][-1]:
                room.enter(name, seed)
    return None


if __name__ == "__main__":
    main()
