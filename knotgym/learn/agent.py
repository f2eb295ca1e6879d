"""The agent: it sees pictures and returns actions.

At each step it updates its hypotheses of the rope's shape and position from the picture, infers
which bead its last action pulled, and either continues its plan or replans. Planning is that of
policy `planner`, in the chain engine.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import Count, NonNegative, Share, Whole, configuration
from knotgym.control.planning import BatchedSearch, PullSearch, shipped_guide
from knotgym.control.policy_config import PullPlannerConfig
from knotgym.learn.imagination import BEADS
from knotgym.learn.reader import Reader
from knotgym.learn.shape_hypotheses import HypothesesConfig, ShapeHypotheses, perturb_heights
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

REACH = 2.0  # metres for which an action's coordinate of 1 stands
# Force of a tow, in all three axes the largest; any direction straightens the rope equally well.
_TOW = np.ones(3)
# Probability that the goal is the code now shown although the episode continues (misread picture).
_MISREAD = 0.05


class PlannedPull(NamedTuple):
    """One step of a plan.

    Attributes:
        bead: bead to pull; -1 for the one nearest to `named`.
        force: float64 (3,), relative to the largest.
        named: float64 (3,), the point of the world to name instead of the bead's position.
    """

    bead: int
    force: Array
    named: Array | None = None


@configuration
class AgentConfig:
    """Planning budgets and thresholds.

    Attributes:
        budget: imagined actions per replanning, at most.
        episode_budget: imagined actions per episode; once spent, replanning gets `least_budget`.
        least_budget: imagined actions that every replanning may use.
        max_plans: plans per step; the one with the highest estimated success is kept.
        patience: steps for which a new plan is followed before it is checked again.
        enough: estimated success at which a plan is accepted without trying another.
        copies: perturbed hypotheses on which a plan's success is estimated.
        height_noise: standard deviation of those perturbations' heights, metres.
        bead_noise: standard deviation of the bead that is pulled around the intended one, beads.
        force_noise: standard deviation of the logarithm of the force.
        keep_plan: estimated success below which a plan is dropped for a new one.
        aim_worth: least worth of a named point (`PositionBelief.aim`) to pull a bead; else probe.
        max_probes: probing actions per episode, at most.
        probe_lift: upward force of a probe, relative to the largest.
        hypotheses: of the rope's shape.
        planner: of the imagined actions.
    """

    budget: Whole = 6000
    episode_budget: Whole = 40000
    least_budget: Whole = 1500
    max_plans: Count = 6
    patience: Count = 2
    enough: Share = 0.85
    copies: Count = 12
    height_noise: NonNegative = 0.008
    bead_noise: NonNegative = 1.0
    force_noise: NonNegative = 0.1
    keep_plan: Share = 0.3
    aim_worth: Share = 0.45
    max_probes: Whole = 3
    probe_lift: NonNegative = 0.6
    hypotheses: HypothesesConfig = HypothesesConfig()
    planner: PullPlannerConfig = PullPlannerConfig(batch_size=32)


@dataclass(eq=False)
class _Episode:
    """State of one episode.

    Attributes:
        goals: candidate goal codes and their weights, which need not sum to 1.
        goal: the most likely one.
        named: float64 (3,), the point that the last action named; None before the first action.
        force: float64 (3,), of the last action.
        step: actions taken.
        probes: probing actions taken.
        plan: pulls that remain.
        planned: step of the last replanning.
        imagined: imagined actions spent.
    """

    rng: np.random.Generator
    horizon: int
    hypotheses: ShapeHypotheses
    goals: dict[GaussCode, float] = field(default_factory=dict)
    goal: GaussCode | None = None
    named: Array | None = None
    force: Array = field(default_factory=lambda: np.zeros(3))
    step: int = 0
    probes: int = 0
    plan: list[PlannedPull] = field(default_factory=list)
    planned: int = 0
    imagined: int = 0


class Agent:
    """A controller from pictures that can act in several episodes in turn."""

    def __init__(self, reader: Reader, starts: Array, config: AgentConfig | None = None) -> None:
        """Compose an agent; `starts` are start positions met in training, float64 (n, 3)."""
        self.reader, self.starts = reader, starts
        self.config = config or AgentConfig()
        planner = self.config.planner
        self._planning = BatchedSearch(planner.batch_size)
        self._believed = ChainSimulation(max(self.config.copies, self.config.hypotheses.imagined))
        self._episodes: dict[int, _Episode] = {}

    def begin(self, index: int, rng: np.random.Generator, horizon: int) -> None:
        """Begin episode `index` of `horizon` steps; all of its random draws come from `rng`."""
        hypotheses = ShapeHypotheses(
            self.reader, self._believed, self.starts, self.config.hypotheses, rng
        )
        self._episodes[index] = _Episode(rng, horizon, hypotheses)

    def act(self, index: int, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Choose an action from a picture of rope and goal.

        Args:
            index: of the episode.
            picture: uint8 (SIZE, 2 SIZE, 3), the rope on the left and the goal on the right.

        Returns:
            The action, float32 (6,): the point that it names, and the force.
        """
        episode = self._episodes[index]
        size = picture.shape[0]
        if not episode.goals:
            goal = np.ascontiguousarray(picture[:, size:])
            episode.goals = episode.hypotheses.read_codes(goal)
        rope = np.ascontiguousarray(picture[:, :size])
        # before the first action there is nothing to predict from
        if episode.named is None:
            episode.hypotheses.start(rope)
        else:
            episode.hypotheses.update(rope, episode.named, episode.force)
        self._update_goal(episode, rope)
        self._choose_pull(episode)
        episode.step += 1
        assert episode.named is not None
        action = np.concatenate([episode.named / REACH, episode.force])
        return np.clip(action, -1, 1).astype(np.float32)

    def imagined(self, index: int) -> int:
        """Return the number of imagined actions that an episode has spent."""
        return self._episodes[index].imagined

    def _update_goal(self, episode: _Episode, picture: NDArray[np.uint8]) -> None:
        """Lower the weight of goal codes that the rope shows now: the episode would be over."""
        shown = episode.hypotheses.code_probabilities(picture)
        # Bayes' rule for "the episode continues": its likelihood is _MISREAD if the rope shows the
        # goal's code and 1 if not, averaged over the codes that the rope may show.
        for code in episode.goals:
            episode.goals[code] *= 1.0 - (1.0 - _MISREAD) * shown.get(code, 0.0)
        goal = max(episode.goals, key=lambda code: episode.goals[code])
        if goal != episode.goal:
            episode.goal, episode.plan = goal, []

    def _choose_pull(self, episode: _Episode) -> None:
        """Set the episode's next named point and force."""
        config, hypotheses = self.config, episode.hypotheses
        towing = bool(episode.plan) and episode.plan[0].named is not None
        due = episode.step - episode.planned >= config.patience or not episode.plan
        # A tow takes many steps, and interrupting or turning it starts it over, so it is never
        # replaced.
        if due and not towing and self._success_rate(episode, episode.plan) < config.keep_plan:
            self._replan(episode)
            episode.planned = episode.step
        if episode.plan:
            bead, force, point = episode.plan.pop(0)
            if point is not None:
                episode.named, episode.force = point, force
                return
        else:
            bead, force = int(episode.rng.integers(BEADS)), episode.rng.uniform(-1, 1, 3)
        rope, position = hypotheses.ropes[0], hypotheses.position
        named, worth = position.aim(rope, bead)
        if worth < config.aim_worth and episode.probes < config.max_probes:
            # The position is too uncertain to name that bead: pull where the outcome tells most
            # about it, away from the middle (in expectation over the bead pulled) and up.
            episode.probes += 1
            named = position.most_informative(rope)
            probabilities = position.bead_probabilities(rope, named)
            out = (probabilities[:, None] * rope).sum(axis=0) * (1, 1, 0)
            force = 0.6 * out / max(1e-6, np.linalg.norm(out)) + (0, 0, config.probe_lift)
            episode.plan = []
        episode.named, episode.force = named, force

    def _replan(self, episode: _Episode) -> None:
        """Make up to `max_plans` plans and keep the one with the highest estimated success."""
        assert episode.goal is not None
        best, highest = list[PlannedPull](), -1.0
        if not episode.goal.visits:  # the goal is a plain loop, to which towing leads
            best = [PlannedPull(-1, _TOW, REACH * _TOW)] * (episode.horizon - episode.step)
            highest = self._success_rate(episode, best)
        # the episode's budget is a soft limit: every replanning may still use `least_budget`
        left = max(
            self.config.least_budget,
            min(self.config.budget, self.config.episode_budget - episode.imagined),
        )
        for _ in range(self.config.max_plans):
            if highest >= self.config.enough or left < self.config.planner.batch_size:
                break
            ropes, velocities = episode.hypotheses.ropes[:1], episode.hypotheses.velocities[:1]
            self._believed.lay_points(ropes, velocities, [0])
            state = self._believed.states([0])[0]
            search = PullSearch(episode.goal, shipped_guide(), self.config.planner, episode.rng)
            found = search.plan(state, ropes[0], episode.horizon - episode.step, left)
            ((_, made),) = self._planning.run([found], self.config.planner.batch_size)
            episode.imagined += made.spent
            left -= made.spent
            pulls = [
                PlannedPull(bead, force)
                for bead, force in zip(
                    made.beads.tolist(), made.forces.astype(np.float64), strict=True
                )
            ]
            # a plan that doesn't reach the goal is still better than none, which scores -1
            success_rate = self._success_rate(episode, pulls) if made.solved else -0.5
            if success_rate > highest and pulls:
                best, highest = pulls, success_rate
        episode.plan = best

    def _success_rate(self, episode: _Episode, pulls: list[PlannedPull]) -> float:
        """Estimate a plan's success rate on perturbed hypotheses; -1 for an empty plan."""
        if not pulls:
            return -1.0
        assert episode.goal is not None
        config, rng = self.config, episode.rng
        points, velocities = episode.hypotheses.sample(config.copies)
        # one factor per copy for the whole plan: a force that is off is off at every step
        gains = np.exp(rng.normal(0, config.force_noise, (len(points), 1)))
        # copy 0 stays the most likely hypothesis itself
        points[1:] = perturb_heights(points[1:], config.height_noise, rng)
        chain, copies = self._believed, np.arange(len(points))
        chain.lay_points(points, velocities, copies)
        reached = np.zeros(len(points), dtype=bool)
        middle = episode.hypotheses.position.positions.mean(axis=0)
        for bead, force, named in pulls:
            # a pull by bead misses by a bead or so; a pull by point takes the bead nearest to it in
            # each copy, with the copies at the mean of the position belief
            if named is None:
                off = np.rint(rng.normal(0, config.bead_noise, len(points))).astype(np.int64)
                beads = (bead + off) % BEADS
            else:
                off = chain.points[copies] + middle - named
                beads = np.linalg.norm(off, axis=2).argmin(axis=1)
            chain.step(beads, chain.max_force * gains * force, copies)
            reached |= [code.matches(episode.goal) for code in label_many(chain.points[copies])]
            if reached.all():
                break
        return float(reached.mean())
