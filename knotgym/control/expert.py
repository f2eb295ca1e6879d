"""The expert: plans in the simulator from the very state a rope is in, and pulls what the plan
says.

Each episode has a budget of simulated actions for all its plans together. When no plan is left to
be had, the expert goes on without looking ahead, by macro-actions that are like those that led
towards the goal before.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import WaypointController
from knotgym.control.planner import REST, Plan, PlannerConfig, guided, plan
from knotgym.control.policies import Choice, Effort
from knotgym.control.transition_graph import TransitionGraph, shipped_transition_graph
from knotgym.episode_batch import EpisodeBatch
from knotgym.simulation import Simulation

BLIND = "blind"  # begins the reason of a pull without a plan


@dataclass(eq=False)
class _Mind:
    """What the expert holds of one episode."""

    rng: np.random.Generator
    plan: Plan | None = None
    step: int = 0
    spent: int = 0
    seconds: float = 0.0
    kind: str = ""


class Expert:
    """Leads every rope to its goal code; a `policies.Policy`."""

    def __init__(
        self, config: PlannerConfig | None = None, graph: TransitionGraph | None = None
    ) -> None:
        """Args:
        config: how hard to plan.
        graph: distances between codes, by default the one that comes with the package.
        """
        self.config = config or PlannerConfig()
        self._atlas = graph
        self._simulation: Simulation | None = None
        self._minds: dict[int, _Mind] = {}
        self._controller = WaypointController(0)

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        if len(self._controller.beads) != episodes.count:
            self._controller = WaypointController(episodes.count)
        self._controller.release(index)
        self._minds[index] = _Mind(rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), []
        for k, i in enumerate(ids.tolist()):
            mind = self._minds[i]
            if mind.plan is None or mind.step >= len(mind.plan.actions):
                began = time.perf_counter()
                mind.plan, mind.step = self._planned(episodes, i, mind), 0
                mind.seconds += time.perf_counter() - began
                mind.spent += mind.plan.spent
            if mind.step < len(mind.plan.actions):
                actions[k] = mind.plan.actions[mind.step]
                moves.append(mind.plan.moves[mind.step])
                mind.step += 1
            else:
                actions[k] = self._blind(episodes, i, mind)
                moves.append(f"{BLIND} {mind.kind}")
        return Choice(actions, moves)

    def forget(self, index: int) -> None:
        """Plan anew before the next action."""
        self._minds[index].plan = None
        self._controller.release(index)

    def name(self, index: int) -> str:
        return "expert"

    def effort(self, index: int) -> Effort:
        mind = self._minds[index]
        return Effort(mind.spent, mind.seconds)

    def _planned(self, episodes: EpisodeBatch, index: int, mind: _Mind) -> Plan:
        if self._simulation is None:
            self._simulation = Simulation(self.config.batch_size, episodes.simulation.rope)
        state = episodes.simulation.states([index])[0]
        left = int(episodes.config.horizon - episodes.steps[index])
        hold = (
            max(1, int(episodes.config.hold - episodes.held[index]))
            if episodes.held[index]
            else episodes.config.hold
        )
        budget = self.config.budget - mind.spent
        return plan(
            self._simulation,
            state,
            episodes.goals[index],
            self._used(),
            self.config,
            mind.rng,
            steps=left,
            hold=hold,
            budget=budget,
        )

    def _blind(self, episodes: EpisodeBatch, index: int, mind: _Mind) -> NDArray[np.float32]:
        simulation = episodes.simulation
        points = simulation.points
        if episodes.codes[index].matches(episodes.goals[index]):
            mind.kind = REST
            return simulation.actions([0], np.zeros((1, 3)), [index])[0]
        self._controller.advance(points)
        if self._controller.idle[index]:
            distances = self._used().distances(episodes.goals[index])
            macro_action = guided(points[index], self._used(), distances, mind.rng)
            mind.kind = macro_action.kind
            self._controller.begin(index, macro_action)
            self._controller.advance(points)
        forces = self._controller.forces(points)[[index]] * simulation.rope.config.max_force
        return simulation.actions(self._controller.beads[[index]], forces, [index])[0]

    def _used(self) -> TransitionGraph:
        if self._atlas is None:
            self._atlas = shipped_transition_graph()
        return self._atlas
