"""The simulations of a process: one of each size and rope, used again by whoever needs it next."""

from __future__ import annotations

from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.simulation import Simulation

_simulations: dict[tuple[int, RopeConfig], Simulation] = {}


def simulation_of(count: int, config: RopeConfig) -> Simulation:
    """This process's simulation of `count` ropes, made once.

    Whoever asks lays or restores every rope before use, and is done with it before the next asks.
    """
    key = count, config
    if key not in _simulations:
        _simulations[key] = Simulation(count, Rope(config))
    return _simulations[key]
