"""The simulation engines by name, and simulations shared within a process."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from knotgym.common import InvalidInput, choice

if TYPE_CHECKING:
    from knotgym.rope.interface import Simulation
    from knotgym.rope.model import Rope, RopeConfig

MUJOCO, CHAIN = "mujoco", "chain"
ENGINES = (MUJOCO, CHAIN)  # the reference, and the fast solver of `rope.chain`

EngineName = Annotated[str, choice(*ENGINES)]  # type of a configuration's field

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
    if engine not in ENGINES:
        raise InvalidInput(f"no engine {engine!r}; there is {', '.join(ENGINES)}")
    if engine == CHAIN:
        from knotgym.rope.chain.chain_simulation import ChainSimulation

        return ChainSimulation(count, rope, threads)
    from knotgym.rope.mujoco_simulation import MujocoSimulation

    return MujocoSimulation(count, rope, threads)


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


def is_compiled(engine: str) -> bool:
    """Return whether numba's cache holds the kernels of an engine and of the crossing search."""
    from knotgym.topology import scan

    kernels = {"crossing_kernel.scan": scan}
    if engine == CHAIN:
        from knotgym.rope.chain.solver import advance

        kernels["solver.advance"] = advance
    return all(
        any(Path(kernel.stats.cache_path).glob(f"{name}-*.nbi")) for name, kernel in kernels.items()
    )


def warn_of_compilation(engine: str) -> None:
    """Log, once per process and engine, that the first run has to wait for compilation."""
    if engine not in _warned and not is_compiled(engine):
        _log.warning("compiling, in the first run only")
    _warned.add(engine)
