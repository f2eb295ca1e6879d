"""The agent: pictures in, actions out, and nothing else.

Each step it reads where the rope lies, learns from it which bead its last pull moved, and goes on
with its plan, or plans anew: the planner of `control.planner`, in imagination.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from knotgym.control.planner import PlannerConfig, plan
from knotgym.control.transition_graph import TransitionGraph
from knotgym.learn.imagination import Imagination, state
from knotgym.learn.reader import PIXEL, Reader
from knotgym.learn.rope_model import BEADS, Dynamics
from knotgym.learn.whereabouts import Whereabouts
from knotgym.rendering.picture import draw
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

REACH = 2.0  # metres that an action's coordinate of 1 stands for
_BLUR = 1.5 * PIXEL  # metres by which foreseen and read beads differ, about
_TOGETHER = 25.0  # neighbouring beads that err alike
_MOST = 24  # beads that a pull may have moved, that are thought through


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """How hard to think.

    Attributes:
        budget: imagined actions of one plan.
        episode_budget: of all an episode's plans; then plans get `least_budget`.
        tries: plans made, of which the surest is taken.
        patience: steps that a plan is kept to, however unsure.
        enough: share of the copies that a plan must lead to the goal to be taken at once.
        copies: imagined ropes, each a little different, on which a plan is tried.
        sure: share of them that a plan must lead to the goal to be gone on with.
        named: how well a bead must be named before it is pulled.
        probes: pulls at most that are spent on finding where the rope is.
        tow: step from which a rope that shall be plain is towed straight, plan or none.
        planner: of imagination.
    """

    budget: int = 1500
    episode_budget: int = 6000
    least_budget: int = 160
    tries: int = 2
    patience: int = 2
    enough: float = 0.5
    copies: int = 6
    sure: float = 0.2
    named: float = 0.45
    probes: int = 3
    tow: int = 20
    planner: PlannerConfig = PlannerConfig(batch_size=32, surrogate_rollouts=2)


@dataclass(eq=False)
class _Episode:
    """What is known of one episode."""

    rng: np.random.Generator
    horizon: int
    whereabouts: Whereabouts
    goal: GaussCode | None = None
    points: Array = field(default_factory=lambda: np.zeros((BEADS, 3)))
    velocities: Array = field(default_factory=lambda: np.zeros((BEADS, 3)))
    named: Array | None = None  # the point of the world that the last action named
    force: Array = field(default_factory=lambda: np.zeros(3))
    bead: int = 0  # meant by it
    step: int = 0
    probes: int = 0
    plan: list[tuple[int, Array]] = field(default_factory=list)
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
        self._goals: dict[bytes, GaussCode] = {}

    def begin(self, index: int, rng: np.random.Generator, horizon: int) -> None:
        """Episode `index` begins, of `horizon` steps; every draw for it comes from `rng`."""
        self._episodes[index] = _Episode(rng, horizon, Whereabouts(self.met, rng))

    def act(self, index: int, picture: NDArray[np.uint8]) -> tuple[NDArray[np.float32], str]:
        """Decide by a picture of rope and goal, uint8 (128, 256, 3): an action (6,), and why."""
        episode = self._episodes[index]
        size = picture.shape[0]
        if episode.goal is None:
            episode.goal = self._goal(np.ascontiguousarray(picture[:, size:]))
        self._see(episode, np.ascontiguousarray(picture[:, :size]))
        move = self._decide(episode)
        episode.step += 1
        assert episode.named is not None
        action = np.concatenate([episode.named / REACH, episode.force])
        return np.clip(action, -1, 1).astype(np.float32), move

    def imagined(self, index: int) -> int:
        """Imagined actions of an episode."""
        return self._episodes[index].imagined

    def _goal(self, picture: NDArray[np.uint8]) -> GaussCode:
        key = picture.tobytes()
        if key not in self._goals:
            self._goals[key] = label(self.reader.read(picture[None])[0]).plain
        return self._goals[key]

    def _see(self, episode: _Episode, picture: NDArray[np.uint8]) -> None:
        """Read the rope; if it was pulled, learn what moved."""
        read = self.reader.read(picture[None])[0]
        if episode.named is None:
            episode.points = read
            return
        before = episode.points
        shares = episode.whereabouts.shares(before, episode.named)
        beads = np.argsort(-shares, kind="stable")[:_MOST]
        beads = beads[shares[beads] > 0]
        many = (len(beads), 1, 1)
        after, velocities = self.dynamics.step(
            np.tile(before, many),
            np.tile(episode.velocities, many),
            beads,
            np.tile(episode.force, (len(beads), 1)),
        )
        middles = after.mean(axis=1)
        after -= middles[:, None]
        off = (after[..., :2] - read[None, :, :2]) ** 2
        fit = -np.minimum(off.sum(axis=2), (4 * _BLUR) ** 2).sum(axis=1) / (
            2 * _BLUR**2 * _TOGETHER
        )
        likelihood = np.zeros(BEADS)
        likelihood[beads] = np.exp(fit - fit.max())
        episode.whereabouts.pulled(before, episode.named, likelihood)
        best = int(np.argmax(fit + np.log(shares[beads])))
        episode.whereabouts.moved(middles[best])
        followed = self.reader.follow(picture[None], after[best][None])[0]
        episode.points = min((followed, read), key=lambda points: _unlike(points, picture))
        episode.velocities = velocities[best]
        if beads[best] != episode.bead:
            episode.bead = int(beads[best])

    def _decide(self, episode: _Episode) -> str:
        """Choose bead and force."""
        assert episode.goal is not None
        if not episode.goal.visits and episode.step >= self.config.tow:
            episode.named, episode.force = np.full(3, REACH), np.ones(3)
            return "tow"
        due = episode.step - episode.planned >= self.config.patience or not episode.plan
        if due and self._surety(episode, episode.plan) < self.config.sure:
            self._plan(episode)
            episode.planned = episode.step
        if episode.plan:
            bead, force = episode.plan.pop(0)
            move = "plan"
        else:
            bead, force = int(episode.rng.integers(BEADS)), episode.rng.uniform(-1, 1, 3)
            move = "lost"
        named, sure = episode.whereabouts.aim(episode.points, bead)
        if sure < self.config.named and episode.probes < self.config.probes:
            episode.probes += 1
            named = episode.whereabouts.probe(episode.points)
            shares = episode.whereabouts.shares(episode.points, named)
            out = (shares[:, None] * episode.points).sum(axis=0) * (1, 1, 0)
            force = 0.6 * out / max(1e-6, np.linalg.norm(out))
            move = "probe"
            episode.plan = []
        episode.named, episode.force, episode.bead = named, force, bead
        return move

    def _plan(self, episode: _Episode) -> None:
        """Make plans and keep the surest."""
        assert episode.goal is not None
        best, surest = list[tuple[int, Array]](), -1.0
        for _ in range(self.config.tries):
            made = plan(
                self._imagination,  # type: ignore[arg-type]
                state(episode.points, episode.velocities),
                episode.goal,
                self.graph,
                self.config.planner,
                episode.rng,
                steps=episode.horizon - episode.step,
                budget=max(
                    self.config.least_budget,
                    min(self.config.budget, self.config.episode_budget - episode.imagined),
                ),
            )
            episode.imagined += made.spent
            steps = [(int(one[0]), one[3:].astype(np.float64)) for one in made.actions]
            sure = self._surety(episode, steps) if made.solved else -0.5
            if sure > surest and steps:
                best, surest = steps, sure
            if surest >= self.config.enough or episode.imagined > self.config.episode_budget:
                break
        episode.plan = best

    def _surety(self, episode: _Episode, steps: list[tuple[int, Array]]) -> float:
        """The share of ropes, lying a little otherwise, that a plan leads to the goal."""
        if not steps:
            return -1.0
        assert episode.goal is not None
        rng, many = episode.rng, (self.config.copies, 1, 1)
        points, velocities = np.tile(episode.points, many), np.tile(episode.velocities, many)
        waves = np.cos(
            2 * np.pi * np.arange(BEADS) / BEADS * rng.integers(1, 6, (len(points), 1))
            + rng.uniform(0, 7, (len(points), 1))
        )
        points[1:, :, 2] += (0.006 * waves)[1:]
        reached = np.zeros(len(points), dtype=bool)
        for bead, force in steps:
            beads = (bead + np.rint(rng.normal(0, 0.7, len(points))).astype(np.int64)) % BEADS
            beads[0] = bead
            points, velocities = self.dynamics.step(
                points, velocities, beads, np.tile(force, (len(points), 1))
            )
            reached |= [code.matches(episode.goal) for code in label_many(points)]
        return float(reached.mean())


def _unlike(points: Array, picture: NDArray[np.uint8]) -> float:
    """How much the picture that points would give differs from the one seen, levels a pixel."""
    drawn = draw(points).astype(np.int16)
    return float(np.abs(drawn - picture).mean())
