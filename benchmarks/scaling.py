"""Throughput with several worker processes over one: collection of states and of pixels, and the
main job.

    python benchmarks/scaling.py [--out scaling.json] [--workers 1 2] [--repeats 3]

The same run as a whole command, starting of processes and files included, with each number of
workers in turn; medians of wall time over the repeats. Bar: 1.8 times as fast with two workers as
with one, on two free cores; on a busy machine the figures mean nothing. The files are compared: the
number of workers doesn't change a byte.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from knotgym.common.atomic_files import sha256
from knotgym.control.policies import PolicyConfig
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import CollectConfig, collect
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.state_recipe import generate
from knotgym.runs.run_options import RunOptions

JOBS = ("state", "pixels", "main")


def run(name: str, size: int, out: Path, workers: int) -> tuple[float, dict[str, str]]:
    """Seconds that a job takes, and the SHA-256 of its data files."""
    options = RunOptions(workers=workers, quiet=True)
    began = time.perf_counter()
    if name == "main":
        generate(GenerateConfig(nx=(3,), count=size), out, options)
    else:
        task = TaskConfig(task="tie", nx=2, observation=name)
        policy = PolicyConfig(policy="random")
        collect(CollectConfig(task=task, policy=policy, episodes=size), out, options)
    taken = time.perf_counter() - began
    return taken, {
        path.name: sha256(path)
        for path in out.rglob("*")
        if path.is_file() and path.name != "collection.json"
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", nargs="+", choices=JOBS, default=list(JOBS))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=400, help="of a collection")
    parser.add_argument("--states", type=int, default=40, help="of the main job")
    parser.add_argument("--out", type=Path, default=Path("scaling.json"))
    args = parser.parse_args()
    table = Table(
        "job",
        *(f"{count} workers, s" for count in args.workers),
        *(f"{count} over {args.workers[0]}" for count in args.workers[1:]),
    )
    results: dict[str, dict[str, float]] = {}
    for name in args.jobs:
        size = args.states if name == "main" else args.episodes
        taken: dict[int, list[float]] = {count: [] for count in args.workers}
        seen = []
        for _ in range(args.repeats):
            for count in args.workers:
                with tempfile.TemporaryDirectory() as folder:
                    seconds, files = run(name, size, Path(folder) / "out", count)
                taken[count].append(seconds)
                seen.append(files)
        if any(files != seen[0] for files in seen):
            raise SystemExit(f"{name}: the files differ between runs")
        medians = {count: statistics.median(times) for count, times in taken.items()}
        gains = [medians[args.workers[0]] / medians[count] for count in args.workers[1:]]
        results[name] = {str(count): seconds for count, seconds in medians.items()}
        table.add_row(
            name,
            *(f"{seconds:.1f}" for seconds in medians.values()),
            *(f"{gain:.2f}" for gain in gains),
        )
    Console().print(table)
    about = {
        "cores": os.cpu_count(),
        "episodes": args.episodes,
        "states": args.states,
        "repeats": args.repeats,
        "bar": 1.8,
    }
    args.out.write_text(
        json.dumps({"about": about, "seconds": results}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
