"""A million frames: written, opened and read back with flat memory.

    python benchmarks/memory.py [--out memory.json] [--frames 1000000] [--room FOLDER]

Episodes of 50 steps, of ropes pulled about once, are put together in the compact form (states and
actions) until there are so many frames; nothing is simulated again, but every byte is written and
read as of as many different ones. Writing, opening and reading are each done in a process of its
own, whose peak of resident memory is the kernel's; a tenth of the frames is done first, so that
what grows with them shows. Read by chunk: every episode once, through `knotgym.loaders`, states as
float32, and its small columns.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from pulled import EPISODES, STEPS, pulled_about
from rich.console import Console
from rich.table import Table

from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import Transitions


def source(path: Path) -> None:
    """The few episodes that are repeated."""
    with EpisodeWriter(path, TaskConfig(task="tie", observation="state"), compact=True) as writer:
        for episode in pulled_about(np.random.default_rng(0)):
            writer.add(episode)


def write(few: Path, many: Path, frames: int) -> dict[str, float]:
    copies = -(-frames // (EPISODES * (STEPS + 1)))
    merge_episodes([few] * copies, many, concatenate=True)
    return {
        "frames": copies * EPISODES * (STEPS + 1),
        "bytes_per_frame": many.stat().st_size / (copies * EPISODES * (STEPS + 1)),
    }


def stream(few: Path, many: Path, frames: int) -> dict[str, float]:
    """As `collect` and `generate` write: every episode encoded anew."""
    from knotgym.datasets.episode_reader import EpisodeReader

    episodes = list(EpisodeReader(few))
    with EpisodeWriter(many, TaskConfig(task="tie", observation="state"), compact=True) as writer:
        for number in range(-(-frames // (STEPS + 1))):
            writer.add(episodes[number % len(episodes)])
    return {}


def opened(few: Path, many: Path, frames: int) -> dict[str, float]:
    begun = time.perf_counter()
    data = Transitions(many, observation="state")
    count = len(data)
    taken = time.perf_counter() - begun
    begun = time.perf_counter()
    data.observations(data.segments // 2, 10, 12)
    return {"open_s": taken, "first_frames_s": time.perf_counter() - begun, "transitions": count}


def read(few: Path, many: Path, frames: int) -> dict[str, float]:
    data = Transitions(many, observation="state")
    total, seen = 0.0, 0
    for segment in range(data.segments):
        states = data.observations(segment)
        total += float(states[0, 0]) + float(data.columns(segment).actions.sum())
        seen += len(states)
    return {"frames_read": seen, "checksum": total}


def peak() -> float:
    """Most memory this process has had, MB: Linux's own count, for getrusage's begins with that of
    the process that started this one.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


STAGES = {"write": write, "write, encoded anew": stream, "open": opened, "read by chunk": read}


def measured(stage: str, few: Path, many: Path, frames: int) -> dict[str, Any]:
    """A stage in a process of its own: what it found, its seconds and its peak of memory."""
    words = [
        sys.executable,
        __file__,
        "--stage",
        stage,
        "--few",
        str(few),
        "--many",
        str(many),
        "--frames",
        str(frames),
    ]
    found: dict[str, Any] = json.loads(
        subprocess.run(words, check=True, capture_output=True, text=True).stdout
    )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("memory.json"))
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument(
        "--room",
        type=Path,
        help="where the data is made, about 3 GB; a temporary folder by default",
    )
    for name in ("--stage", "--few", "--many"):  # this script in a process of its own
        parser.add_argument(name, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.stage:
        began, cpu = time.perf_counter(), time.process_time()
        found = STAGES[args.stage](Path(args.few), Path(args.many), args.frames)
        spent = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}
        sys.stdout.write(json.dumps({**found, **spent, "peak_mb": peak()}))
        return
    rows: dict[str, dict[str, Any]] = {}
    table = Table("stage", "frames", "seconds", "CPU s", "peak MB")
    with tempfile.TemporaryDirectory(dir=args.room) as room:
        few = Path(room) / "few.h5"
        source(few)
        for frames in (args.frames // 10, args.frames):
            for stage in STAGES:
                if stage == "write, encoded anew" and frames == args.frames:
                    continue  # minutes; that memory is flat shows in a tenth
                many = Path(room) / ("anew.h5" if stage == "write, encoded anew" else "many.h5")
                found = rows[f"{stage}, {frames} frames"] = measured(stage, few, many, frames)
                table.add_row(
                    stage,
                    str(frames),
                    *(f"{found[name]:.2f}" for name in ("seconds", "cpu_seconds")),
                    f"{found['peak_mb']:.0f}",
                )
    console = Console()
    console.print(table)
    last = rows[f"open, {args.frames} frames"]
    size = rows[f"write, {args.frames} frames"]["bytes_per_frame"]
    console.print(
        f"opened in {last['open_s']:.2f} s (bar: 1 s); {size:.0f} bytes a frame", highlight=False
    )
    args.out.write_text(
        json.dumps({"settings": {"frames": args.frames}, "stages": rows}, indent=1) + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
