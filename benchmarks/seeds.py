"""Seeds of eight learners on tiers of bench: which differences are more than chance.

    python benchmarks/seeds.py ROOM

Trains the learners of `examples/learners/offline_torch.py` on the sets of demonstrations (`noisy`,
in decisions) and of random macro-actions (`wander`, in macro-actions), plays each on the test split
with protocol code, and keeps them as entries, ROOM/entries/CELL-seedK.h5, the smallest cells first.
What is there stays, so the script can be stopped and run again. It needs torch, and the sets:
`knotgym suite --states bench --size 100k --policy wander --task tie --nx 2 --out ROOM/data`.
`benchmarks/results.py` makes the page.

The settings were fixed before the first training that counts: one number of updates for all, by no
search, as cores were short.
"""

import os
import subprocess
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from itertools import product
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


def train(room: Path, name: str, seed: int, loaded: dict[str, Any]) -> Path:
    """Train what a folder lacks of the learners of a cell; return the folder."""
    import offline_torch  # here, as --help needs no torch

    task, nx, tier, size, _ = CELLS[name]
    folder = Path(f"{name}-seed{seed}")
    folder.mkdir(exist_ok=True)
    data = f"data/knotgym/{task}-nx{nx}/{tier}-chain-bench-{size}-v0"
    for learner in LEARNERS:
        out = folder / f"{learner}.pt"
        if not out.with_suffix(".py").exists():
            settings = {"action": ACTIONS[tier], "updates": UPDATES, "width": WIDTH}
            given = Namespace(learner=learner, datasets=[data], seed=seed, out=out, **settings)
            offline_torch.make(given, loaded)
    return room / folder


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path, help="folder of data, models and entries")
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS))
    given = parser.parse_args()
    room = given.room.resolve()
    sys.path.insert(0, str(ROOT / "examples" / "learners"))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    os.chdir(room)
    Path("entries").mkdir(exist_ok=True)
    sets: dict[str, dict[str, Any]] = {name: {} for name in given.cells}  # stay in memory
    for seed, name in product(range(SEEDS), given.cells):
        task, nx, *_, seeds = CELLS[name]
        entry = Path("entries", f"{name}-seed{seed}.h5")
        if seed < seeds and not entry.exists():
            folder = train(room, name, seed, sets[name])
            acting = [word for one in LEARNERS for word in ("--policy", f"{one}:act")]
            acting += ["--protocol", "code", "--task", task, "--nx", str(nx), "--workers", "1"]
            # no path of this machine in a claim
            words = ("knotgym", "evaluate", *acting, "--record", f"../{entry}")
            subprocess.run(words, cwd=folder, check=True)


if __name__ == "__main__":
    main()
