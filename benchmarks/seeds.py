"""Five seeds of eight learners on tiers of bench: which differences are more than chance.

    python benchmarks/seeds.py ROOM

Trains the learners of `examples/learners/offline_torch.py` on the sets of the policy `noisy`, plays
each on the same 512 episodes of the test split, in the chain engine, and keeps them as entries,
ROOM/entries/CELL-seedK.h5, seed after seed, the smallest cells first. What is there stays, so the
script can be stopped and run again. It needs torch. `benchmarks/results.py` makes the page.

The settings were fixed before the first training, and so was what we expected of it: `ORDERED` and
`CHANGES` were committed with this file. Known were the benchmark page, where learners of d3rlpy and
OGBench have one seed each, and 128 episodes of a DiscreteBC of 240 updates (71 successes), played
to time a training.
"""

import os
import subprocess
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEARNERS = ("DiscreteBC", "BC", "GCBC", "Flow", "IQL", "TD3BC", "GCIVL", "CRL")
SEEDS, EPISODES = 5, 512
# task, nx, tier, updates of every learner (batches of 256, AdamW at 1e-3)
CELLS = {
    "tie-nx2-10k": ("tie", 2, "10k", 500),
    "tie-nx2-100k": ("tie", 2, "100k", 1500),
    "tie-nx3-10k": ("tie", 3, "10k", 500),
    "convert-nx3-10k": ("convert", 3, "10k", 500),
    "tie-nx3-100k": ("tie", 3, "100k", 1500),
    "convert-nx3-100k": ("convert", 3, "100k", 1500),
}
# Expected before the first training. In tie-nx2-10k, the first of two has the higher mean, and a
# seed of it beats a seed of the second in nine pairs of ten:
ORDERED = (("DiscreteBC", "IQL"), ("IQL", "BC"), ("GCIVL", "GCBC"), ("BC", "TD3BC"), ("BC", "Flow"))
# The first of two has the higher mean in the first cell, and the lower one in the second:
CHANGES = (
    ("GCBC", "BC", "tie-nx2-10k", "tie-nx2-100k"),  # with few data, goals reached add variety
    ("GCIVL", "IQL", "tie-nx2-10k", "tie-nx3-10k"),  # as from tie 2 to tie 3 at 100k, one seed
    ("BC", "Flow", "tie-nx2-10k", "tie-nx2-100k"),  # a flow needs more data
    ("TD3BC", "CRL", "tie-nx2-10k", "tie-nx2-100k"),  # a classifier of goals needs more data
)


def run(*words: object, cwd: Path) -> None:
    """Run a command; end with its status if it fails."""
    search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    made = subprocess.run(
        [*map(str, words)], cwd=cwd, env={**os.environ, "PYTHONPATH": search}, check=False
    )
    if made.returncode:
        sys.exit(made.returncode)


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path, help="folder of data, models and entries")
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=list(CELLS))
    given = parser.parse_args()
    room: Path = given.room.resolve()
    (room / "entries").mkdir(parents=True, exist_ok=True)
    for name in given.cells:
        task, nx, tier, updates = CELLS[name]
        data = f"data/knotgym/{task}-nx{nx}/noisy-chain-bench-{tier}-v0"
        if not (room / data).exists():
            setup = ("--task", task, "--nx", nx, "--policy", "noisy", "--size", tier)
            more = (*setup, "--states", "bench", "--workers", 1, "--resume", "--out", "data")
            run("knotgym", "suite", *more, cwd=room)
        for seed in range(SEEDS):
            entry = room / "entries" / f"{name}-seed{seed}.h5"
            if entry.exists():
                continue
            models = f"{name}-seed{seed}"
            (room / models).mkdir(exist_ok=True)
            for learner in LEARNERS:
                out = Path(models, f"{learner}.pt")
                if not (room / out).with_suffix(".py").exists():
                    script = ROOT / "examples" / "learners" / "offline_torch.py"
                    words = ("--steps", updates, "--seed", seed, "--out", out)
                    run(sys.executable, script, learner, data, *words, cwd=room)
            acting = [word for one in LEARNERS for word in ("--policy", f"{one}:act")]
            acting += ["--task", task, "--nx", str(nx), "--states", "bench", "--engine", "chain"]
            acting += ["--episodes", str(EPISODES), "--workers", "1", "--record"]
            acting += [os.path.relpath(entry, room / models)]  # no path of this machine in a claim
            run("knotgym", "evaluate", *acting, cwd=room / models)


if __name__ == "__main__":
    main()
