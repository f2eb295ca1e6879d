"""The simulation engines, one record each, and simulations shared within a process.

A new engine is a `Simulation` and a record in ENGINES; commands, runs, environments and checks know
it by that.
"""

from __future__ import annotations

import hashlib
import logging
import os
import time
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from knotgym.common import Array, Kinds, choice, one_line

if TYPE_CHECKING:
    from knotgym.rope.interface import Simulation
    from knotgym.rope.model import Rope, RopeConfig

MUJOCO, CHAIN = "mujoco", "chain"
_COMPILING = "compiling, once", 30.0  # and about how many seconds it takes
_MICROMETRE = 1e-6  # metres


class Engine(NamedTuple):
    """Everything in which one engine differs from the others.

    Attributes:
        simulation: "module:class" of its `Simulation`, imported when one is made.
        is_reference: whether others are compared with it, so that ids and tables don't name it.
        kernels: "module:function" of compiled functions, for which a first run has to wait.
        has_integrator: whether `integrator_steps` are its own.
        blocks: episodes of a block of a run, at least and at most: without planning, and with.
        pieces: blocks of a run, at least, so that workers have equal shares.
        together: drawn states and demonstrations of a call, about.
        workers: that play recorded pulls again; 0 for one a core, 1 if it is done before workers
            have started.
        rounding: metres between points of its states and points computed from their qpos.
    """

    simulation: str
    is_reference: bool = False
    kernels: tuple[str, ...] = ()
    has_integrator: bool = False
    blocks: tuple[tuple[int, int], tuple[int, int]] = ((8, 64), (2, 8))
    pieces: int = 32
    together: int = 3
    workers: int = 0
    rounding: float = 0.0

    def behaviour(self) -> str:
        """Return a digest of what the engine does: where a fixed run leads, in whole micrometres.

        Processors differ in the last bits, by less than 1e-12 m at its end, and no coordinate is
        within 1e-10 m of where rounding turns: it is the same on all of them, and may be stored.
        """
        places = np.rint(_fixed_run(self.simulation) / _MICROMETRE).astype("<i8")
        return hashlib.sha256(places.tobytes()).hexdigest()[:12]

    def unlike(self, said: object) -> str:
        """Say that another engine's digest is this one's; "" if it is, or if none is `said`."""
        if said is None or said == (here := self.behaviour()):
            return ""
        return f"an engine that does otherwise: its digest is {one_line(str(said))}, here {here}"


# A block takes about half a minute of one core at most: what a kill loses. The chain engine steps
# many ropes in little more time than one, MuJoCo doesn't; and a policy that plans simulates 500 to
# 5,000 pulls an episode beside its own 50.
ENGINES = Kinds(
    "engine",
    {
        MUJOCO: Engine(
            "knotgym.rope.mujoco_simulation:MujocoSimulation",
            is_reference=True,
            has_integrator=True,
        ),
        CHAIN: Engine(
            "knotgym.rope.chain.chain_simulation:ChainSimulation",
            kernels=("knotgym.rope.chain.solver:advance",),
            blocks=((64, 1024), (16, 64)),
            pieces=4,
            together=12,
            workers=1,
            rounding=1e-9,  # its qpos are computed from its points, and back with rounding
        ),
    },
)

EngineName = Annotated[str, choice(growing=ENGINES)]  # type of a configuration's field

_log = logging.getLogger("knotgym")
_warned: set[str] = set()  # engines
_shared: dict[tuple[str, int, RopeConfig], Simulation] = {}


def simulation(
    engine: str, count: int = 1, rope: Rope | None = None, threads: int = 1
) -> Simulation:
    """Return a simulation of `count` plain loops; `threads` 0 uses every core.

    Only this imports the engine.

    Raises:
        InvalidInput: there is no such engine.
    """
    made: Any = resolve_name(ENGINES[engine].simulation)
    return made(count, rope, threads)


def simulation_of(count: int, config: RopeConfig, engine: str = MUJOCO) -> Simulation:
    """Return this process's simulation of `count` ropes, creating it on the first call.

    The caller must set or restore every rope before use, and must be done with the simulation
    before it is requested again.
    """
    from knotgym.rope.model import Rope

    # one for each size: making one compiles a model and lays its ropes, which takes longer than
    # many of the calls that share it
    key = engine, count, config
    if key not in _shared:
        _shared[key] = simulation(engine, count, Rope(config))
    return _shared[key]


@cache
def _fixed_run(made: str) -> Array:
    """Pull a trefoil eight times, whose strands press on each other; return its vertices."""
    from knotgym.rope.model import Rope, RopeConfig

    rope, t = Rope(RopeConfig()), np.linspace(0, 2 * np.pi, 200, endpoint=False)
    flat = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
    curve = rope.from_curve(np.stack([*flat, -0.12 * np.sin(3 * t)], axis=1))
    simulation: Simulation = resolve_name(made)(1, rope, 1)
    simulation.set_qpos(rope.qpos(curve[None]))
    for k in range(8):
        pull = (-1) ** k * 0.2, 0.1 * k - 0.2, 0.0, 0.75, -0.5, 0.25
        simulation.act(np.array([pull], dtype=np.float32))
    return simulation.points[0].copy()


def _is_compiled(engine: str) -> bool:
    """Return whether numba's cache holds the kernels of an engine and of the crossing search."""
    from knotgym.topology import scan

    kernels: list[Any] = [scan, *map(resolve_name, ENGINES[engine].kernels)]
    return all(
        # a cache's files are named by module and function
        any(
            Path(kernel.stats.cache_path).glob(
                f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}-*.nbi"
            )
        )
        for kernel in kernels
    )


def compiling(*engines: str) -> tuple[str, float] | None:
    """Return what a first run with these engines waits for, and about how many seconds; or None."""
    return None if all(map(_is_compiled, engines)) else _COMPILING


def warn_of_compilation(engine: str) -> None:
    """Log that the first run has to wait for compilation: once for a process and its workers."""
    if engine not in _warned and not _is_compiled(engine) and _is_first(engine):
        _log.warning("%s, about %.0f s", *_COMPILING)
    _warned.add(engine)


def _is_first(engine: str) -> bool:
    """Return whether no process of this group, which a command and its workers are, asked yet."""
    from knotgym.topology import scan

    group = getattr(os, "getpgrp", os.getppid)()
    said = Path(scan.stats.cache_path).parent / f"compiling-{engine}-{group}"
    try:
        if said.exists() and time.time() - said.stat().st_mtime > 600:  # another group's
            said.unlink()
        said.parent.mkdir(parents=True, exist_ok=True)
        said.touch(exist_ok=False)
    except FileExistsError:
        return False
    except OSError:
        pass
    return True
