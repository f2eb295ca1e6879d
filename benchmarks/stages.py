"""Where the time goes: the share of each stage in the main job, in collection of states and of
pixels, and in images, on all cores.

    python benchmarks/stages.py [--out stages.json] [--jobs main state pixels images] [--workers 0]
    [--clock wall]

Each of so many processes does its shard of the job as the command does (`--shard`), files included,
with a stopwatch on the functions below; nested calls count for the inner one. What no stopwatch
sees is Python and the rest. Bars: `mj_step` has 85 % of the main job's time and 75 % of pixel
collection's, whose policy is random: no other leaves less to physics. On a busy machine take
`--clock cpu`.
"""

import argparse
import importlib
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import mujoco.batch
from rich.console import Console
from rich.table import Table

BARS = {"main": 0.85, "pixels": 0.75}
STAGES = ("mj_step", "configurations", "label", "quality", "picture", "compression")
WATCHED = {
    "configurations": (
        "rope.model.Rope.points",
        "rope.model.Rope.points_and_gaps",
        "rope.model.Rope.qpos",
        "rope.reset_noise.noised",
        "rope.closed_curves.clearance",
    ),
    "label": (
        "topology.crossings.find_crossings",
        "topology.crossings.label",
        "topology.crossings.label_many",
        "topology.crossings.count_crossings",
        "topology.reference_labeller.pyknotid_code",
    ),
    "quality": (
        "quality.measures.measure",
        "quality.measures.noise_survival",
        "quality.measures.base_spacing",
    ),
    "picture": (
        "rendering.picture.draw",
        "rendering.picture.draw_many",
        "rendering.appearance.render",
    ),
    "compression": (
        "datasets.episode_writer.EpisodeWriter.add",
        "datasets.episode_writer.merge_episodes",
        "datasets.image_table.encode",
        "datasets.image_table.write_rows",
        "states.state_file.write_states",
        "generate.states.archive.Archive.save",
        "datasets.gallery.write_gallery",
    ),
}


def holder_of(name: str) -> tuple[Any, str]:
    """The module or class that a watched function stands in, and its name there."""
    path, _, last = name.rpartition(".")
    try:
        return importlib.import_module(f"knotgym.{path}"), last
    except ModuleNotFoundError:  # a method
        path, _, kind = path.rpartition(".")
        return getattr(importlib.import_module(f"knotgym.{path}"), kind), last


class Stopwatch:
    """Seconds by stage, each without those of the stages called from it."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock, self.seconds, self._open = clock, Counter[str](), list[list[Any]]()

    def watch(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def watched(*arguments: Any, **keywords: Any) -> Any:
            self._open.append([self.clock(), 0.0])
            try:
                return function(*arguments, **keywords)
            finally:
                began, inner = self._open.pop()
                whole = self.clock() - began
                self.seconds[stage] += whole - inner
                if self._open:
                    self._open[-1][1] += whole

        return watched

    def attach(self) -> None:
        """Put the stopwatch on every function watched, under every name it was imported by."""
        import knotgym.cli.main
        import knotgym.generate.episodes.collect
        import knotgym.generate.images.image_recipe
        import knotgym.generate.states.state_recipe
        import knotgym.rope.mujoco_simulation

        class Batch(mujoco.batch.Batch):
            step = self.watch("mj_step", mujoco.batch.Batch.step)

        simulation: Any = knotgym.rope.mujoco_simulation
        simulation.Batch = Batch
        modules = [module for name, module in sys.modules.items() if name.startswith("knotgym")]
        for stage, names in WATCHED.items():
            for name in names:
                holder, last = holder_of(name)
                own = getattr(holder, last)
                timed = self.watch(stage, own)
                for module in [holder, *modules]:
                    if getattr(module, last, None) is own:
                        setattr(module, last, timed)


def run(name: str, number: int, of: int, size: int, folder: Path) -> None:
    """Shard `number` of a run that gives each of `of` shards `size` things to make."""
    from knotgym.control.policies import PolicyConfig
    from knotgym.envs.tasks import TaskConfig
    from knotgym.generate.episodes.collect import CollectConfig, collect
    from knotgym.generate.images.image_recipe import make_images
    from knotgym.generate.images.images_config import ImagesConfig
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.state_recipe import generate
    from knotgym.runs.run_options import RunOptions
    from knotgym.runs.shards import Shard

    options = RunOptions(workers=1, quiet=True, shard=Shard(number, of))
    if name == "main":
        generate(GenerateConfig(nx=(3,), count=size * of), folder / name, options)
    elif name == "images":
        make_images(ImagesConfig(count=size * of), folder / name, options)
    else:
        task = TaskConfig(task="tie", nx=2, observation=name)
        policy = PolicyConfig(policy="random")
        config = CollectConfig(task=task, policy=policy, episodes=size * of)
        collect(config, options.shard.folder(folder / name), options)


def worker(
    name: str, number: int, of: int, size: int, folder: Path, clock: str, queue: Any
) -> None:
    import cv2

    cv2.setNumThreads(1)
    tick = time.perf_counter if clock == "wall" else time.process_time
    watch = Stopwatch(tick)
    watch.attach()
    run(name, number, of, max(1, size // 10), folder / "warm")
    watch.seconds.clear()
    began = tick()
    run(name, number, of, size, folder)
    queue.put({**watch.seconds, "whole": tick() - began})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("stages.json"))
    parser.add_argument(
        "--jobs",
        nargs="+",
        choices=("main", "state", "pixels", "images"),
        default=["main", "state", "pixels", "images"],
    )
    parser.add_argument("--workers", type=int, default=0, help="processes, 0 for one a core")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    parser.add_argument("--states", type=int, default=10, help="of the main job, for each process")
    parser.add_argument(
        "--episodes", type=int, default=60, help="of a collection, for each process"
    )
    parser.add_argument("--pictures", type=int, default=300, help="of images, for each process")
    args = parser.parse_args()
    workers = args.workers or len(os.sched_getaffinity(0))
    sizes = {
        "main": args.states,
        "state": args.episodes,
        "pixels": args.episodes,
        "images": args.pictures,
    }
    context = multiprocessing.get_context("spawn")
    table = Table("job", *STAGES, "Python, rest", "bar for mj_step")
    shares: dict[str, dict[str, float]] = {}
    for name in args.jobs:
        with tempfile.TemporaryDirectory() as folder:
            queue = context.Queue()
            shards = [
                (name, number + 1, workers, sizes[name], Path(folder), args.clock, queue)
                for number in range(workers)
            ]
            processes = [context.Process(target=worker, args=shard) for shard in shards]
            for process in processes:
                process.start()
            seconds: Counter[str] = sum((Counter(queue.get()) for _ in processes), Counter())
            for process in processes:
                process.join()
        shares[name] = {stage: seconds[stage] / seconds["whole"] for stage in STAGES}
        shares[name]["rest"] = 1 - sum(shares[name].values())
        table.add_row(
            name,
            *(f"{share:.1%}" for share in shares[name].values()),
            f"{BARS[name]:.0%}" if name in BARS else "",
        )
    Console().print(table)
    about = {"workers": workers, "clock": args.clock, "sizes": sizes, "cores": os.cpu_count()}
    args.out.write_text(
        json.dumps({"settings": about, "shares": shares, "bars": BARS}, indent=1) + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
