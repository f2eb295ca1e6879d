"""Policies that need neither a plan nor a model, and policies that combine others."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidPolicy
from knotgym.control.demonstrator import Demonstrator, DemonstratorConfig, random_pass
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy import NO_MACRO, Choice, Effort, Policy, UnplannedPolicy
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.actions import choices, quantized
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import WaypointController, propose
from knotgym.topology.gauss import GaussCode

NOISE = "noise"  # reason for a random pull
_DRAWN = 12  # random passes are tried; the simplest is made
_WANDERING = 0.5  # share of noisy episodes that begin with a random pass


class RandomPolicy(UnplannedPolicy):
    """Uniform actions of the task's view."""

    def __init__(self) -> None:
        super().__init__("random")

    def suited(self, task: TaskConfig) -> TaskConfig:
        return task

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        rngs = [self._rngs[int(index)] for index in ids]
        if episodes.config.action == "pull":
            actions = np.stack([uniform_action(rng) for rng in rngs])
        else:
            counts = choices(episodes.config.action, episodes.simulation.points.shape[1])
            actions = np.stack([rng.integers(counts) for rng in rngs])
        return Choice(actions, [""] * len(ids))


class ConstantPolicy(UnplannedPolicy):
    """The same action at every step, which tows the rope."""

    def __init__(self, action: ArrayLike = (1.0,) * 6) -> None:
        """Take `action`, (6,) in [-1, 1]."""
        super().__init__("constant")
        self._action = np.asarray(action, dtype=np.float32)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        return Choice(np.tile(self._action, (len(ids), 1)), [""] * len(ids))


class ScriptedPolicy(UnplannedPolicy):
    """Random macro-actions, one after another."""

    def __init__(self, config: MacroActionConfig) -> None:
        super().__init__("scripted")
        self._config = config
        self._controller = WaypointController(0, config)
        self._kinds: dict[int, str] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        if len(self._controller.beads) != episodes.count:  # the first episode of a new batch
            self._controller = WaypointController(episodes.count, self._config)
        self._controller.release(index)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        simulation = episodes.simulation
        self._controller.advance(simulation.points)
        idle = self._controller.idle
        for index in ids.tolist():
            if idle[index]:
                points = simulation.points[index]
                macro_action = propose(points, self._rngs[index], self._config)
                self._kinds[index] = macro_action.kind
                self._controller.begin(index, macro_action)
        self._controller.advance(simulation.points)
        forces = self._controller.forces(simulation.points)[ids] * simulation.rope.config.max_force
        actions = simulation.actions(self._controller.beads[ids], forces, ids)
        return Choice(actions, [self._kinds[index] for index in ids.tolist()])


class NoisyPolicy(UnplannedPolicy):
    """The demonstrator with some pulls replaced by random ones, after which it looks again.

    Half of the episodes begin with a random pass, so that learners see more than tidy ropes. The
    reason for such a pull is NOISE, for a pull of the random pass `demonstrator.RANDOM`.
    """

    def __init__(self, name: str, inner: Demonstrator, noise: float) -> None:
        super().__init__(name)
        self._inner, self._noise = inner, noise

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        noise_rng, inner_rng = rng.spawn(2)
        super().begin(episodes, index, noise_rng)
        self._inner.begin(episodes, index, inner_rng)
        if noise_rng.random() < _WANDERING:
            beads = episodes.simulation.points.shape[1]
            self._inner.begin_with(episodes, index, random_pass(beads, noise_rng))

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        noisy = np.array([self._rngs[int(index)].random() < self._noise for index in ids])
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), [NOISE] * len(ids)
        macros = np.tile(NO_MACRO, (len(ids), 1))
        planned = np.flatnonzero(~noisy)
        if len(planned):
            chosen = self._inner.act(episodes, ids[planned])
            actions[planned], macros[planned] = chosen.actions, chosen.macros
            for row, why in zip(planned, chosen.moves, strict=True):
                moves[row] = why
        for row in np.flatnonzero(noisy):
            index = int(ids[row])
            self._inner.replan(index)
            actions[row] = random_pull(episodes, index, self._rngs[index])
        return Choice(actions, moves, macros)

    def effort(self, index: int) -> Effort:
        return self._inner.effort(index)


class PlayPolicy(Demonstrator):
    """The demonstrator on its way to one goal after another, in endless tasks.

    The first goal is the episode's. Whenever one is reached, another is drawn: half the time a code
    of the task's goals, half the time one of its starts, so ropes are tied and untied in turn.
    Where a look finds no way, another goal is drawn, after a random pass: of a dozen, the one that
    leaves the fewest crossings. The reason for an action ends in the goal sought, as in "choice 1
    to 1+,1-".
    """

    def __init__(self, config: DemonstratorConfig, planner: PlannerConfig) -> None:
        super().__init__(config, planner)
        self._rngs: dict[int, np.random.Generator] = {}
        self._sought: dict[int, GaussCode] = {}

    def suited(self, task: TaskConfig) -> TaskConfig:
        if not task.endless:
            raise InvalidPolicy(
                "policy play goes on after every goal, so the task must be endless; give --endless,"
                " and a task.horizon such as 500"
            )
        return super().suited(task)

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._rngs[index], inner_rng = rng.spawn(2)
        self._sought[index] = episodes.goals[index]
        super().begin(episodes, index, inner_rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        for index in ids.tolist():
            if episodes.codes[index].matches(self._sought[index]):
                self._draw_goal(episodes, index)
                self.replan(index)
        chosen = super().act(episodes, ids)
        moves = [
            f"{move} to {self._sought[index]}".rstrip()
            for move, index in zip(chosen.moves, ids.tolist(), strict=True)
        ]
        return chosen._replace(moves=moves)

    def goal(self, episodes: EpisodeBatch, index: int) -> GaussCode:
        return self._sought[index]

    def give_up(self, episodes: EpisodeBatch, index: int) -> None:
        rng, beads = self._rngs[index], episodes.simulation.points.shape[1]
        passes = [random_pass(beads, rng) for _ in range(_DRAWN)]
        self.begin_with(episodes, index, self.simplest(episodes, index, passes))
        self._draw_goal(episodes, index)

    def name(self, index: int) -> str:
        return "play"

    def _draw_goal(self, episodes: EpisodeBatch, index: int) -> None:
        rng, code = self._rngs[index], episodes.codes[index]
        sides = [
            [goal for goal in episodes.side_codes(side) if not code.matches(goal)]
            for side in ("start", "goal")
        ]
        # a side whose only code is shown, such as the plain loop, has none left
        goals = [side for side in sides if side]
        drawn = goals[int(rng.integers(len(goals)))]
        self._sought[index] = drawn[int(rng.integers(len(drawn)))]


class MixedPolicy(Policy):
    """Draws one of several policies for each episode when it begins."""

    def __init__(self, policies: list[Policy], shares: tuple[float, ...]) -> None:
        self._policies, self._shares = policies, np.array(shares) / sum(shares)
        self._chosen: dict[int, Policy] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._chosen[index] = self._policies[rng.choice(len(self._policies), p=self._shares)]
        self._chosen[index].begin(episodes, index, rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), [""] * len(ids)
        macros = np.tile(NO_MACRO, (len(ids), 1))
        for policy in self._policies:
            own = np.flatnonzero([self._chosen[int(index)] is policy for index in ids])
            if len(own):
                chosen = policy.act(episodes, ids[own])
                actions[own] = chosen.actions
                if chosen.macros is not None:
                    macros[own] = chosen.macros
                for row, reason in zip(own, chosen.moves, strict=True):
                    moves[row] = reason
        return Choice(actions, moves, macros)

    def name(self, index: int) -> str:
        return self._chosen[index].name(index)

    def effort(self, index: int) -> Effort:
        return self._chosen[index].effort(index)


def uniform_action(rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw an action uniformly from [-1, 1]^6, float32 (6,)."""
    return rng.uniform(-1, 1, 6).astype(np.float32)


def random_pull(
    episodes: EpisodeBatch, index: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Draw a pull of any bead with a quantized force, as an action float32 (6,)."""
    simulation = episodes.simulation
    bead = rng.integers(simulation.points.shape[1], size=1)
    force = quantized(rng.uniform(-1, 1, (1, 3))) * simulation.max_force
    pull: NDArray[np.float32] = simulation.actions(bead, force, [index])[0]
    return pull
