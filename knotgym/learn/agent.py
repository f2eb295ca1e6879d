"""The agent: pictures in, actions out, and nothing else.

Each step it reads where the rope lies, learns from it which bead its last pull moved, and goes on
with its plan, or plans anew: the planner of `control.planner`, in imagination.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.planner import plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import TransitionGraph
from knotgym.learn.belief import BeliefConfig, RopeBelief, waved
from knotgym.learn.imagination import Imagination, passed_through, state
from knotgym.learn.reader import Reader
from knotgym.learn.rope_model import BEADS, Dynamics
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

REACH = 2.0  # metres that an action's coordinate of 1 stands for
_TOW = np.ones(3)  # force of a tow; any direction straightens as well as another
_MISLED = 0.05  # how likely a code shown for sure is the goal, though the episode goes on


class Pull(NamedTuple):
    """One step of a plan.

    Attributes:
        bead: pulled; -1 for the one nearest to `named`.
        force: (3,), in units of the largest.
        named: the point of the world to name, (3,), where that isn't the bead's.
    """

    bead: int
    force: Array
    named: Array | None = None


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """How hard to think.

    Attributes:
        budget: imagined actions that are planned with at one step.
        episode_budget: at all of an episode's; then a step gets `least_budget`.
        tries: plans made at most at one step, of which the surest is taken.
        patience: steps that a plan is kept to, however unsure.
        enough: share of the copies that a plan must lead to the goal to be taken at once.
        copies: imagined ropes, each a little different, on which a plan is tried.
        doubt: metres by which their heights differ, about.
        slip: beads by which the bead pulled differs, standard deviation.
        gain: that of the logarithm by which forces differ.
        sure: share of them that a plan must lead to the goal to be gone on with.
        named: how well a bead must be named before it is pulled.
        probes: pulls at most that are spent on finding where the rope is.
        rise: upward force of a probe, in units of the largest.
        belief: what is thought possible.
        planner: of imagination.
    """

    budget: int = 1500
    episode_budget: int = 12000
    least_budget: int = 500
    tries: int = 6
    patience: int = 2
    enough: float = 0.85
    copies: int = 12
    doubt: float = 0.008
    slip: float = 1.0
    gain: float = 0.1
    sure: float = 0.3
    named: float = 0.45
    probes: int = 3
    rise: float = 0.6
    belief: BeliefConfig = BeliefConfig()
    planner: PlannerConfig = PlannerConfig(batch_size=32, surrogate_rollouts=2)


@dataclass(eq=False)
class _Episode:
    """What is known of one episode."""

    rng: np.random.Generator
    horizon: int
    belief: RopeBelief
    goals: dict[GaussCode, float] = field(default_factory=dict)  # what it may be, and how likely
    goal: GaussCode | None = None  # the likeliest
    named: Array | None = None  # the point of the world that the last action named
    force: Array = field(default_factory=lambda: np.zeros(3))
    step: int = 0
    probes: int = 0
    plan: list[Pull] = field(default_factory=list)
    planned: int = 0  # the step at which the plan was made
    imagined: int = 0


class Agent:
    """Acts in any number of episodes, one picture at a time."""

    def __init__(
        self,
        reader: Reader,
        dynamics: Dynamics,
        graph: TransitionGraph,
        met: Array,
        config: AgentConfig | None = None,
    ) -> None:
        self.reader, self.dynamics, self.graph, self.met = reader, dynamics, graph, met
        self.config = config or AgentConfig()
        self._imagination = Imagination(dynamics, self.config.planner.batch_size)
        self._episodes: dict[int, _Episode] = {}

    def begin(self, index: int, rng: np.random.Generator, horizon: int) -> None:
        """Episode `index` begins, of `horizon` steps; every draw for it comes from `rng`."""
        belief = RopeBelief(self.reader, self.dynamics, self.met, self.config.belief, rng)
        self._episodes[index] = _Episode(rng, horizon, belief)

    def act(self, index: int, picture: NDArray[np.uint8]) -> tuple[NDArray[np.float32], str]:
        """Decide by a picture of rope and goal, uint8 (128, 256, 3): an action (6,), and why."""
        episode = self._episodes[index]
        size = picture.shape[0]
        if not episode.goals:
            goal = np.ascontiguousarray(picture[:, size:])
            episode.goals = episode.belief.read_codes(goal)
        rope = np.ascontiguousarray(picture[:, :size])
        if episode.named is None:
            episode.belief.see(rope)
        else:
            episode.belief.see_pulled(rope, episode.named, episode.force)
        self._aim(episode, rope)
        move = self._decide(episode)
        episode.step += 1
        assert episode.named is not None
        action = np.concatenate([episode.named / REACH, episode.force])
        return np.clip(action, -1, 1).astype(np.float32), move

    def imagined(self, index: int) -> int:
        """Imagined actions of an episode."""
        return self._episodes[index].imagined

    def _aim(self, episode: _Episode, picture: NDArray[np.uint8]) -> None:
        """Say which code is the goal: not the one shown now, for the episode would be over."""
        shown = episode.belief.shown(picture)
        for code in episode.goals:
            episode.goals[code] *= 1.0 - (1.0 - _MISLED) * shown.get(code, 0.0)
        goal = max(episode.goals, key=lambda code: episode.goals[code])
        if goal != episode.goal:
            episode.goal, episode.plan = goal, []

    def _decide(self, episode: _Episode) -> str:
        """Choose bead and force."""
        assert episode.goal is not None
        towing = bool(episode.plan) and episode.plan[0].named is not None
        due = episode.step - episode.planned >= self.config.patience or not episode.plan
        # a tow takes its time, and one broken off or turned takes it again
        if due and not towing and self._surety(episode, episode.plan) < self.config.sure:
            self._plan(episode)
            episode.planned = episode.step
        if episode.plan:
            bead, force, point = episode.plan.pop(0)
            if point is not None:
                episode.named, episode.force = point, force
                return "tow"
            move = "plan"
        else:
            bead, force = int(episode.rng.integers(BEADS)), episode.rng.uniform(-1, 1, 3)
            move = "lost"
        rope, whereabouts = episode.belief.ropes[0], episode.belief.whereabouts
        named, sure = whereabouts.aim(rope, bead)
        if sure < self.config.named and episode.probes < self.config.probes:
            episode.probes += 1
            named = whereabouts.probe(rope)
            out = (whereabouts.shares(rope, named)[:, None] * rope).sum(axis=0) * (1, 1, 0)
            force = 0.6 * out / max(1e-6, np.linalg.norm(out)) + (0, 0, self.config.rise)
            move = "probe"
            episode.plan = []
        episode.named, episode.force = named, force
        return move

    def _plan(self, episode: _Episode) -> None:
        """Make plans and keep the surest."""
        assert episode.goal is not None
        best, surest = self._tow(episode) if not episode.goal.visits else (list[Pull](), -1.0)
        left = max(
            self.config.least_budget,
            min(self.config.budget, self.config.episode_budget - episode.imagined),
        )
        for _ in range(self.config.tries):
            if surest >= self.config.enough or left < self.config.planner.batch_size:
                break
            made = plan(
                self._imagination,
                state(episode.belief.ropes[0], episode.belief.velocities[0]),
                episode.goal,
                self.graph,
                self.config.planner,
                episode.rng,
                steps=episode.horizon - episode.step,
                budget=left,
            )
            episode.imagined += made.spent
            left -= made.spent
            steps = [Pull(int(one[0]), one[3:].astype(np.float64)) for one in made.actions]
            sure = self._surety(episode, steps) if made.solved else -0.5
            if sure > surest and steps:
                best, surest = steps, sure
        episode.plan = best

    def _tow(self, episode: _Episode) -> tuple[list[Pull], float]:
        """A tow that straightens the rope, and how surely."""
        tow = [Pull(-1, _TOW, REACH * _TOW)] * (episode.horizon - episode.step)
        return tow, self._surety(episode, tow)

    def _surety(self, episode: _Episode, steps: list[Pull]) -> float:
        """The share of ropes, lying a little otherwise, that a plan leads to the goal."""
        if not steps:
            return -1.0
        assert episode.goal is not None
        rng = episode.rng
        points, velocities = episode.belief.drawn(self.config.copies)
        gains = np.exp(rng.normal(0, self.config.gain, (len(points), 1)))
        points[1:] = waved(points[1:], self.config.doubt, rng)
        codes = label_many(points)
        reached, torn = np.zeros((2, len(points)), dtype=bool)
        place = episode.belief.whereabouts.places.mean(axis=0)
        for bead, force, named in steps:
            if named is None:
                off = np.rint(rng.normal(0, self.config.slip, len(points))).astype(np.int64)
                beads = (bead + off) % BEADS
            else:
                beads = np.linalg.norm(points + place - named, axis=2).argmin(axis=1)
            points, velocities = self.dynamics.step(points, velocities, beads, gains * force)
            before, codes = codes, label_many(points)
            torn |= [passed_through(*pair) for pair in zip(before, codes, strict=True)]
            reached |= ~torn & [code.matches(episode.goal) for code in codes]
            if (reached | torn).all():
                break
        return float(reached.mean())
