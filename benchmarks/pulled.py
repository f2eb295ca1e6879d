"""Episodes for the benchmarks of datasets: ropes pulled about."""

import numpy as np

from knotgym.datasets.trajectory import Episode
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.topology.crossings import label_many

EPISODES, STEPS = 50, 50


def pulled_about(rng: np.random.Generator) -> list[Episode]:
    """Episodes in which a bead is led across the rope, each for eight actions; a rope's goal is
    where the next one ends.
    """
    simulation = MujocoSimulation(EPISODES, threads=0)
    start_qpos, points, actions = simulation.qpos(), [simulation.points.copy()], []
    for step in range(STEPS):
        if step % 8 == 0:
            beads = rng.integers(100, size=EPISODES)
            over = (
                simulation.points.mean(axis=1)
                - simulation.points[np.arange(EPISODES), beads]
                + rng.normal(0, 0.05, (EPISODES, 3))
            )
            over *= 0.2 / np.abs(over).max(axis=1, keepdims=True)
        over[:, 2] = 0.1 if step % 8 < 4 else -0.1
        actions.append(simulation.actions(beads, over))
        simulation.act(actions[-1])
        points.append(simulation.points.copy())
    lain, acted, last = (
        np.array(points).swapaxes(0, 1),
        np.array(actions).swapaxes(0, 1),
        np.arange(STEPS) == STEPS - 1,
    )
    episodes = []
    for k in range(EPISODES):
        codes = label_many(lain[k])
        episodes.append(
            Episode(
                start_qpos=start_qpos[k],
                points=lain[k],
                goal_points=lain[k - 1, -1],
                actions=acted[k],
                rewards=np.where(last, -5.0, 0.0),
                terminations=np.zeros(STEPS, dtype=bool),
                truncations=last,
                gauss_code=np.array([str(code) for code in codes]),
                gauss_code_chiral=np.array([code.chiral for code in codes]),
                crossings=np.array([code.nx for code in codes]),
                bead=np.full(STEPS + 1, -1),
                force=np.zeros((STEPS + 1, 3)),
                applied_share=np.ones(STEPS + 1),
                is_success=np.zeros(STEPS + 1, dtype=bool),
                simulation_failed=np.zeros(STEPS + 1, dtype=bool),
                goal_gauss_code="",
                policy="across",
            )
        )
    return episodes
