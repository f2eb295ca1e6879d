"""Measure a set of a million states: bytes, opening, stretches, batches, arrays, expansion.

    python benchmarks/columns.py

The set repeats 400 random episodes of 50 pulls. Rates are per CPU second, the file in the operating
system's cache. The table of docs/offline-rl.md is from here.
"""

import tempfile
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from knotgym.common import Stream
from knotgym.control import PolicyConfig, make_policy, replay, rollouts
from knotgym.datasets import expanded, open_episodes, write_episodes
from knotgym.envs import TaskConfig
from knotgym.loaders import Sequences, Transitions, arrays

TASK = TaskConfig(task="tie", engine="chain", observation="state")
LENGTH, EPISODES, REPEATED = 50, 400, 50


def rate(call: Callable[[], object], seconds: float = 2.0) -> float:
    """Return the calls of a function per CPU second."""
    call()
    began, count = time.process_time(), 0
    while time.process_time() - began < seconds:
        call()
        count += 1
    return count / (time.process_time() - began)


def main() -> None:
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    seeds = [Stream.EPISODE.derived_seed(0, number) for number in range(EPISODES)]
    part = rollouts(make_policy(PolicyConfig(policy="random")), TASK, seeds)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as room:
        path = Path(room) / "episodes.h5"
        write_episodes(path, [part] * REPEATED, TASK)
        episodes = open_episodes(path).episodes
        size, pulls = path.stat().st_size, int(episodes.episodes["length"].sum())
        print(f"{episodes.steps.rows} states, {size / 1e9:.2f} GB, {size / pulls:.0f} bytes a pull")
        print(f"opening: {1000 / rate(lambda: open_episodes(path)):.0f} ms of CPU time")
        seen, copy = episodes.steps["observation"], np.empty((64, TASK.beads, 3), np.float32)

        def stretch() -> None:
            first = int(rng.integers(len(seen) - 64))
            np.copyto(copy, seen[first : first + 64])

        print(f"stretches of 64 observations: {rate(stretch):.0f} a CPU second")
        sequences = Sequences(path, LENGTH)

        def sequence() -> None:
            one = sequences[int(rng.integers(len(sequences)))]
            np.copyto(copy[:LENGTH], one["observation"])

        print(f"Sequences of {LENGTH}: {rate(sequence):.0f} a CPU second")
        opened = Transitions(path)
        batches = rate(lambda: opened.batch(rng.integers(len(opened), size=256)))
        print(f"Transitions.batch of 256: {256 * batches:.0f} transitions a CPU second")
        for turn in ("first", "second"):
            began = time.process_time()
            held = arrays(path)
            spent, size = time.process_time() - began, sum(one.nbytes for one in held.values())
            print(f"arrays, {turn} call: {spent:.1f} s of CPU time, {size / 1e9 / spent:.2f} GB/s")
            del held
        recording = Path(room) / "recording.h5"
        write_episodes(recording, [part.recording()], TASK)
        began = time.process_time()
        made = expanded(open_episodes(recording), replay).episodes.steps.rows - EPISODES
        print(f"expansion: {made / (time.process_time() - began):.0f} pulls a CPU second")


if __name__ == "__main__":
    main()
