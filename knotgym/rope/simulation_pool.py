"""Simulations shared within a process: one for each number of ropes and each configuration."""

from __future__ import annotations

from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.simulation import Simulation

_simulations: dict[tuple[int, RopeConfig], Simulation] = {}


def simulation_of(count: int, config: RopeConfig) -> Simulation:
    """Return this process's simulation of `count` ropes, creating it on the first call.

    The caller must lay or restore every rope before use, and must be done with the simulation
    before it is requested again.
    """
    key = count, config
    if key not in _simulations:
        _simulations[key] = Simulation(count, Rope(config))
    return _simulations[key]
