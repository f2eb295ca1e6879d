"""How fast `knotgym collect` is, beside the bare chain engine.

    python benchmarks/collect.py [--episodes 1024] [random:2 expert:2 expert:3]

For each policy and number of crossings: steps a CPU second of the engine alone, pulled at random
from the same starts, and of a collection in this process, from its seeds to a closed file of
columns that has been read back; before and after it the engine is timed again, because machines
that others use change their speed within minutes. Minari's form of the same episodes is timed
apart. Bytes are those of a step on disk, as columns and as a recording.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.control import PolicyConfig
from knotgym.datasets import MinariMetadata, columns_of, open_episodes, publish, write_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import CollectConfig, collect
from knotgym.rope import ChainSimulation
from knotgym.runs import RunOptions

ROPES, PULLS = 256, 50  # of the engine alone
OPTIONS = RunOptions(workers=1, quiet=True)


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the CPU seconds of a call, and what it returned."""
    began = time.process_time()
    result = work()
    return time.process_time() - began, result


def engine_rate(qpos: Any) -> float:
    """Return the pulls a CPU second of the chain engine from ropes at rest."""
    simulation, rng = ChainSimulation(len(qpos)), np.random.default_rng(0)
    simulation.set_qpos(qpos)
    beads = rng.integers(100, size=(PULLS, len(qpos)))
    forces = rng.uniform(-1, 1, (PULLS, len(qpos), 3)) * simulation.max_force

    def pull() -> None:
        for some, force in zip(beads, forces, strict=True):
            simulation.step(some, force)

    return PULLS * len(qpos) / seconds(pull)[0]


def measure(policy: str, nx: int, episodes: int, folder: Path) -> None:
    """Print the figures of one policy and number of crossings."""
    task = TaskConfig(task="tie", nx=nx, engine="chain", observation="state")
    config = CollectConfig(
        task=task, policy=PolicyConfig(policy=policy), episodes=episodes, form="columns"
    )
    starts = config.played(range(ROPES), seed=0).episodes["start_qpos"]
    before = engine_rate(starts)

    def collected() -> tuple[Path, int]:
        out = open_episodes(collect(config, folder, OPTIONS)).path
        return out, int(columns_of(out).episodes.episodes["length"].sum())

    spent, (out, steps) = seconds(collected)
    engine = (before + engine_rate(starts)) / 2
    few_config = replace(config, episodes=64, form="minari")
    dataset, made = columns_of(out), collect(few_config, folder / "few", OPTIONS)
    published = columns_of(made)
    metadata = MinariMetadata(**(published.metadata or {}))
    write = partial(publish, [published.episodes], task, metadata)
    minari, plain = (
        seconds(partial(write, folder / form, form=form))[0] for form in ("minari", "columns")
    )
    minari -= plain
    few = int(published.episodes.episodes["length"].sum())
    write_episodes(folder / "recording.h5", [dataset.episodes.recording()], task)
    sizes = [path.stat().st_size / steps for path in (out, folder / "recording.h5")]
    print(
        f"{policy} nx {nx}: {steps} steps, {steps / spent:.0f} a CPU second, engine {engine:.0f}:"
        f" {100 * steps / spent / engine:.1f} %; Minari's form {few / minari:.0f} a CPU second;"
        f" {sizes[0]:.0f} and {sizes[1]:.0f} bytes a step"
    )


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=1024)
    parser.add_argument("which", nargs="*", default=["random:2", "expert:2", "expert:3"])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for one in given.which:
            policy, _, nx = one.partition(":")
            measure(policy, int(nx or 2), given.episodes, Path(temporary))


if __name__ == "__main__":
    main()
