"""The expert: a policy that plans in the chain engine and checks its plans in MuJoCo.

Each episode has a budget of simulated actions for all its plans together. Once it is used up, the
expert goes on without looking ahead, with macro-actions chosen by guidance alone.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.control.action_sequence import ActionSequence
from knotgym.control.checked_plan import plan_checked
from knotgym.control.guidance import Towards
from knotgym.control.planner import REST, Plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy import Choice, Effort, Policy
from knotgym.control.transition_graph import TransitionGraph, shipped_transition_graph
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.rope.engines import CHAIN, simulation_of
from knotgym.rope.macro_actions import WaypointController

BLIND = "blind"  # first word of the reason for an action that no plan contains


@dataclass(eq=False)
class _Progress:
    """The expert's state in one episode.

    Attributes:
        rng: the episode's generator.
        plan: the plan being carried out; None to replan before the next action.
        step: actions of the plan already taken.
        spent: actions simulated for all plans so far.
        seconds: wall time of all plans so far.
        kind: kind of the macro-action under way without a plan.
    """

    rng: np.random.Generator
    plan: Plan | None = None
    step: int = 0
    spent: int = 0
    seconds: float = 0.0
    kind: str = ""


class Expert(Policy):
    """Policy that leads every rope to its goal code."""

    def __init__(
        self, config: PlannerConfig | None = None, graph: TransitionGraph | None = None
    ) -> None:
        """Take the planner's settings, and the graph of distances; None for the one that ships."""
        self.config = config or PlannerConfig()
        self._graph = graph
        self._progress: dict[int, _Progress] = {}
        self._controller = WaypointController(0, self.config.macro_actions)

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        if len(self._controller.beads) != episodes.count:
            self._controller = WaypointController(episodes.count, self.config.macro_actions)
        self._controller.release(index)
        self._progress[index] = _Progress(rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), []
        for row, index in enumerate(ids.tolist()):
            progress = self._progress[index]
            if progress.plan is None or progress.step >= len(progress.plan.pulls):
                began = time.perf_counter()
                left = int(episodes.config.horizon - episodes.steps[index])
                progress.plan, progress.step = self._plan(episodes, index, progress, left), 0
                progress.seconds += time.perf_counter() - began
                progress.spent += progress.plan.spent
            if progress.step < len(progress.plan.pulls):
                actions[row] = _action(episodes, index, progress.plan.pulls, progress.step)
                moves.append(progress.plan.moves[progress.step])
                progress.step += 1
            else:
                actions[row] = self._act_without_plan(episodes, index, progress)
                moves.append(f"{BLIND} {progress.kind}")
        return Choice(actions, moves)

    def replan(self, index: int) -> None:
        """Drop the current plan; the next action is planned afresh."""
        self._progress[index].plan = None
        self._controller.release(index)

    def advise(
        self, episodes: EpisodeBatch, index: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], Effort]:
        """Return the first action, float32 (6,), of a plan made as if the episode began here.

        Any earlier plan of the episode is dropped. The second value is what planning cost.
        """
        self.begin(episodes, index, rng)
        progress, began = self._progress[index], time.perf_counter()
        made = self._plan(episodes, index, progress, steps=episodes.config.horizon)
        effort = Effort(made.spent, time.perf_counter() - began)
        if len(made.pulls):
            return _action(episodes, index, made.pulls, 0), effort
        return self._act_without_plan(episodes, index, progress), effort

    def name(self, index: int) -> str:
        return "planner"

    def effort(self, index: int) -> Effort:
        progress = self._progress[index]
        return Effort(progress.spent, progress.seconds)

    def _plan(self, episodes: EpisodeBatch, index: int, progress: _Progress, steps: int) -> Plan:
        engine, rope = episodes.simulation.engine, episodes.simulation.rope.config
        # where the rope shows the goal already, only the rest of the hold is still to be planned
        hold, held = episodes.config.hold, int(episodes.held[index])
        return plan_checked(
            simulation_of(self.config.batch_size, rope, CHAIN),
            simulation_of(1, rope, engine),
            episodes.simulation.states([index])[0],
            episodes.goals[index],
            self._graph_used(),
            self.config,
            progress.rng,
            steps=steps,
            hold=max(1, hold - held) if held else hold,
            budget=self.config.budget - progress.spent,
            bound=episodes.tow_bound(index),
        )

    def _act_without_plan(
        self, episodes: EpisodeBatch, index: int, progress: _Progress
    ) -> NDArray[np.float32]:
        simulation = episodes.simulation
        points = simulation.points
        if episodes.codes[index].matches(episodes.goals[index]):
            progress.kind = REST
            return simulation.actions([0], np.zeros((1, 3)), [index])[0]
        self._controller.advance(points)
        if self._controller.idle[index]:
            graph = self._graph_used()
            distances = graph.distances(episodes.goals[index], episodes.codes[index])
            towards = Towards(graph.steps(episodes.codes[index], distances))
            macro_action = towards.propose(points[index], self.config, progress.rng)
            progress.kind = macro_action.kind
            self._controller.begin(index, macro_action)
            self._controller.advance(points)
        forces = self._controller.forces(points)[[index]] * simulation.rope.config.max_force
        return simulation.actions(self._controller.beads[[index]], forces, [index])[0]

    def _graph_used(self) -> TransitionGraph:
        if self._graph is None:
            self._graph = shipped_transition_graph(self.config.graph)
        return self._graph


def _action(
    episodes: EpisodeBatch, index: int, pulls: ActionSequence, step: int
) -> NDArray[np.float32]:
    """The action, float32 (6,), that makes one pull of a plan."""
    forces = pulls.forces[[step]].astype(np.float64) * episodes.simulation.max_force
    return episodes.simulation.actions(pulls.beads[[step]], forces, [index])[0]
