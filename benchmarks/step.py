"""How fast an environment steps on one core, by observation mode, beside raw MuJoCo on the same
rope.

    python benchmarks/step.py [--out step.json] [--steps 50] [--repeats 12] [--vector-steps 12]
                              [--threads 1,2]

The raw share of a mode is the time that `mujoco.batch` alone takes for the same forces from the
same start (24 substeps an action; the qpos at the end are compared bit for bit) over the time of
the environment's steps. Both are taken in turn, ten actions at a time, on one pinned core in CPU
seconds, so that what else runs on the machine hits both alike; medians over the repeats.

A second table has the vector environment on one thread, for both engines: labels, rewards, infos,
observations and autoreset, beside the same actions on the ropes alone. Episodes end at all times.
A third has the chain engine's on more threads, in turn: steps a second of the wall's clock; and by
what factor a step would take less time on so many cores, from the CPU time of its parts on one
thread. That can be measured on a busy machine too: a call of `Threads.spread` then takes the nth
part of its rows' time, or as long as what is done meanwhile, and everything else takes its time.
"""

import itertools
import json
import os
import statistics
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray
from rich.console import Console

import knotgym
from knotgym.common import Threads
from knotgym.rope import Rope, simulation

MODES = ("state", "pixels", "both")
VECTOR = {"mujoco": 64, "chain": 1024}  # engine -> ropes of make_vec
CHUNK = 10  # actions between two looks at the clock


class Raw:
    """The rope in `mujoco.batch` alone."""

    def __init__(self, rope: Rope, qpos: NDArray[np.float64]) -> None:
        self.rope, self.batch = rope, Batch(rope.model, 1, 1)
        self.qpos, self.xfrc = self.batch.bind("qpos"), self.batch.bind("xfrc_applied")
        self.qpos[0] = qpos

    def step(self, bead: int, force: NDArray[np.float64], undone: bool) -> None:
        before = self.batch.state.copy() if undone else None
        self.xfrc[0, self.rope.bodies[bead], :3] = force
        self.batch.step(nstep=self.rope.config.frame_skip)
        self.xfrc[0, self.rope.bodies[bead], :3] = 0.0
        if before is not None:  # the environment takes an action back that tears the rope
            self.batch.state[:] = before


def measured(env: Any, actions: NDArray[np.float32]) -> tuple[float, float]:
    """CPU seconds of the environment and of the raw rope for one action each, over one episode."""
    env.reset(seed=0)
    stepped = env.unwrapped.episodes.simulation
    raw = Raw(stepped.rope, stepped.qpos()[0])
    ours, theirs = 0.0, 0.0
    for start in range(0, len(actions), CHUNK):
        steps = []
        began = time.process_time()
        for action in actions[start : start + CHUNK]:
            info = env.step(action)[4]
            steps.append((info["bead"], info["force"], info["simulation_failed"]))
        ours += time.process_time() - began
        began = time.process_time()
        for bead, force, undone in steps:
            raw.step(bead, force, undone)
        theirs += time.process_time() - began
    if not np.array_equal(raw.qpos, stepped.qpos()):
        raise SystemExit(
            "the raw rope did not go where the environment's did: they cannot be compared"
        )
    return ours / len(actions), theirs / len(actions)


class Accounts(Threads):
    """One thread, and the CPU seconds of its calls: of rows, and of what is done meanwhile."""

    def __init__(self) -> None:
        super().__init__(1)
        self.calls = list[tuple[float, float]]()

    def spread(
        self,
        work: Callable[[slice], Any],
        rows: int,
        unit: int = 1,
        meanwhile: Callable[[], None] | None = None,
        most: int | None = None,
    ) -> list[Any]:
        began, calls = time.process_time(), self.calls.copy()
        if meanwhile is not None:
            meanwhile()
        between = time.process_time()
        found = super().spread(work, rows, unit, None, most)
        self.calls = [*calls, (time.process_time() - between, between - began)]
        return found


def vector(task: str, mode: str, engine: str, ropes: int, nx: int, threads: int = 1) -> Any:
    """Return a vector environment whose episodes are at random steps."""
    settings: Any = {"observation": mode, "engine": engine, "threads": threads, "nx": nx}
    name, kind = f"knotgym/{task.capitalize()}-v0", "vector_entry_point"
    envs: Any = gym.make_vec(name, num_envs=ropes, vectorization_mode=kind, **settings)
    envs.reset(seed=0)
    drawn = np.random.default_rng(0).integers(0, envs.unwrapped.config.horizon, ropes)
    envs.unwrapped.episodes.steps[:] = drawn
    return envs


def thread_rates(
    task: str, mode: str, ropes: int, steps: int, nx: int, counts: list[int]
) -> list[dict[str, Any]]:
    """Steps a second by the wall's clock on each number of threads, and the factor of as many cores
    by CPU time.
    """
    every = {count: vector(task, mode, "chain", ropes, nx, count) for count in (*counts, 0)}
    accounts = every[0].unwrapped.episodes.simulation.threads = Accounts()
    rng, walls = np.random.default_rng(1), {count: list[float]() for count in every}
    spent = list[tuple[float, list[tuple[float, float]]]]()
    for _ in range(steps + 1):
        actions = rng.uniform(-1, 1, (ropes, 6)).astype(np.float32)
        for count, envs in every.items():
            accounts.calls, began, cpu = [], time.perf_counter(), time.process_time()
            envs.step(actions)
            walls[count].append(time.perf_counter() - began)
        cpu = time.process_time() - cpu  # of the last, on one thread
        spent.append((cpu - sum(map(sum, accounts.calls)), accounts.calls))
    rows = []
    for count in counts:
        needed = [
            alone + sum(max((own + other) / count, other) for own, other in calls)
            for alone, calls in spent[1:]
        ]
        whole = [alone + sum(map(sum, calls)) for alone, calls in spent[1:]]
        factor = statistics.median(whole) / statistics.median(needed)
        rate = ropes / statistics.median(walls[count][1:])
        names = ("observation", "threads", "steps_per_second", "factor_by_cpu")
        rows.append(dict(zip(names, (mode, count, rate, factor), strict=True)))
    return rows


def vector_rates(
    task: str, mode: str, engine: str, ropes: int, steps: int, nx: int
) -> tuple[float, float]:
    """Steps a CPU second of `make_vec` on one thread, and of the ropes alone; medians."""
    envs = vector(task, mode, engine, ropes, nx)
    rng = np.random.default_rng(0)
    episodes = envs.unwrapped.episodes
    alone = simulation(engine, ropes, episodes.simulation.rope)
    times = []
    for _ in range(steps + 1):
        actions = rng.uniform(-1, 1, (ropes, 6)).astype(np.float32)
        alone.restore(episodes.simulation.states())
        began = time.process_time()
        envs.step(actions)
        between = time.process_time()
        alone.act(actions)
        times.append((between - began, time.process_time() - between))
    ours, theirs = (statistics.median(column) for column in zip(*times[1:], strict=True))
    return ropes / ours, ropes / theirs  # the first step warms up


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=50, help="actions an episode")
    parser.add_argument("--repeats", type=int, default=12, help="episodes a mode")
    parser.add_argument("--ropes", type=int, help="ropes of make_vec; by default as in VECTOR")
    parser.add_argument("--vector-steps", type=int, default=12, help="steps of make_vec")
    parser.add_argument("--task", default="tie", help="tie starts at loops, unknot at tangles")
    parser.add_argument("--nx", type=int, default=2)
    parser.add_argument("--threads", default="1,2", help="numbers of threads of make_vec")
    parser.add_argument("--states", help="state file, instead of the one that ships")
    parser.add_argument("--out", type=Path, default=Path("step.json"))
    args = parser.parse_args()
    if min(args.steps, args.repeats, args.vector_steps) < 1:
        parser.error(
            "--steps, --repeats and --vector-steps must be at least 1, got"
            f" {args.steps}, {args.repeats} and {args.vector_steps}"
        )
    counts = [int(count) for count in args.threads.split(",")]
    ropes, threaded = args.ropes or VECTOR["chain"], list[dict[str, Any]]()
    for mode in MODES[:2]:
        threaded += thread_rates(args.task, mode, ropes, args.vector_steps, args.nx, counts)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    longest, name = args.steps + 1, f"knotgym/{args.task.capitalize()}-v0"  # none ends early
    settings = {"nx": args.nx, "states": args.states, "horizon": longest, "hold": longest}
    envs = {
        mode: gym.make(name, observation=mode, disable_env_checker=True, **settings)
        for mode in MODES
    }
    rng = np.random.default_rng(0)
    times: dict[str, list[tuple[float, float]]] = {mode: [] for mode in MODES}
    for repeat in range(args.repeats + 1):
        actions = rng.uniform(-1, 1, (args.steps, 6)).astype(np.float32)
        for mode, env in envs.items():
            pair = measured(env, actions)
            if repeat:  # the first warms up
                times[mode].append(pair)
    modes = {
        mode: {
            "steps_per_second": 1 / statistics.median(ours for ours, _ in pairs),
            "raw_steps_per_second": 1 / statistics.median(theirs for _, theirs in pairs),
            "raw_share": statistics.median(theirs / ours for ours, theirs in pairs),
            "own_ms": 1000 * statistics.median(ours - theirs for ours, theirs in pairs),
        }
        for mode, pairs in times.items()
    }
    names = ("engine", "ropes", "observation", "steps_per_second", "ropes_alone")
    many = list[dict[str, Any]]()
    for engine, mode in itertools.product(VECTOR, MODES):
        ropes = args.ropes or VECTOR[engine]
        rates = vector_rates(args.task, mode, engine, ropes, args.vector_steps, args.nx)
        many.append(dict(zip(names, (engine, ropes, mode, *rates), strict=True)))
    given = {name: value for name, value in vars(args).items() if name != "out"}
    told = {"settings": given, "modes": modes, "make_vec": many, "threads": threaded}
    args.out.write_text(json.dumps({"knotgym": knotgym.__version__, **told}, indent=1) + "\n")
    Console().print(told)


if __name__ == "__main__":
    main()
