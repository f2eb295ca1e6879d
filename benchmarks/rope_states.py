"""Rope states for the other scripts: ropes that random macro-actions have tangled, as they come,
none chosen.
"""

from collections.abc import Iterator

import numpy as np

from knotgym.control.action_sequence import step_ropes
from knotgym.rope.macro_actions import MacroActionConfig, WaypointController, propose
from knotgym.rope.model import Array
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.topology.crossings import count_crossings

ROPES = 32
LONGEST = 60  # steps before a rope starts over


def tangled(
    count: int, rng: np.random.Generator, least: int = 1, most: int = 15
) -> Iterator[Array]:
    """Yield `count` configurations (beads, 3) with `least` to `most` crossings, at most every
    fourth step of a rope.
    """
    simulation, config = MujocoSimulation(ROPES, threads=0), MacroActionConfig()
    controller = WaypointController(ROPES, config)
    loop = np.repeat(simulation.rope.qpos(simulation.rope.loop())[None], ROPES, axis=0)
    step = given = 0
    while True:
        if step % LONGEST == 0:
            simulation.lay(loop)
            for rope in range(ROPES):
                controller.begin(rope, propose(simulation.points[rope], rng, config))
        controller.advance(simulation.points)
        for rope in np.flatnonzero(controller.idle).tolist():
            controller.begin(rope, propose(simulation.points[rope], rng, config))
        controller.advance(simulation.points)
        step_ropes(simulation, controller.beads, controller.forces(simulation.points))
        step += 1
        for points in simulation.points if step % 4 == 0 else ():
            if least <= count_crossings(points) <= most:
                yield points.copy()
                given += 1
                if given == count:
                    return
