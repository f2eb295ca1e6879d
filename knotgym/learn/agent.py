"""The policy that sees pictures and returns actions.

At each step its player updates its hypotheses of the rope's shape and position from the picture,
infers which bead its last action pulled, and either continues its plan or replans. Planning is that
of policy `planner`, in the chain engine.

After a change run what `shape_hypotheses` says.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, InvalidPolicy
from knotgym.control import BatchedSearch, PassValues, Player, PullPlannerConfig, Pulls, PullSearch
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.learn.card import PRETRAINED
from knotgym.learn.checkpoint import Learned, load_reader
from knotgym.learn.colour_reading import BEADS, SIZE
from knotgym.learn.shape_hypotheses import MOST_IMAGINED, REACH, ShapeHypotheses, perturb_heights
from knotgym.rope import ChainSimulation
from knotgym.topology import GaussCode, label_many

# Force of a tow, in all three axes the largest; any direction straightens the rope equally well.
_TOW = np.ones(3)
# Probability that the goal is the code now shown although the episode continues (misread picture).
_MISREAD = 0.05
# Budgets and thresholds were chosen without comparison. After a change `pretrained` must score as
# docs/benchmark.md says, in about as many CPU seconds.
_PLANNER = PullPlannerConfig(batch_size=32)  # of the imagined actions
# Imagined actions of a replanning and of an episode, at most; once the latter are spent, every
# replanning still gets the last number.
_BUDGET, _EPISODE_BUDGET, _LEAST_BUDGET = 6000, 40_000, 1500
_MOST_PLANS = 6  # per step; the one with the highest estimated success is kept
_PATIENCE = 2  # steps for which a new plan is followed before it is checked again
_ENOUGH = 0.85  # estimated success at which a plan is accepted without trying another
_KEEP_PLAN = 0.3  # estimated success below which a plan is dropped for a new one
# Perturbed hypotheses on which a plan's success is estimated: their number, and the standard
# deviations of heights (metres), of the bead around the intended one (beads), and of the logarithm
# of the force.
_COPIES, _HEIGHT_NOISE, _BEAD_NOISE, _FORCE_NOISE = 12, 0.008, 1.0, 0.1
_AIM_WORTH = 0.45  # least worth of a named point (`PositionBelief.aim`) to pull a bead; else probe
_MOST_PROBES, _PROBE_LIFT = 3, 0.6  # probes per episode; upward force of one, of the largest


_READABLE = {  # settings of a task whose pictures the reader can read
    **{"beads": BEADS, "views": "top", "depth": False, "camera": "orthographic"},
    **{"appearance": "published", "image_size": SIZE, "hold": 1},
}


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


@dataclass(eq=False)
class _Episode:
    """State of one episode.

    Attributes:
        hypotheses: of its rope, and of its goal.
        goal: the most likely code of the goal.
        named: float64 (3,), the point that the last action named; None before the first action.
        force: float64 (3,), of the last action.
        step: actions taken.
        probes: probing actions taken.
        plan: pulls that remain.
        replanned_at: step of the last replanning.
        imagined: imagined actions spent.
    """

    rng: np.random.Generator
    horizon: int
    hypotheses: ShapeHypotheses
    goal: GaussCode | None = None
    named: Array | None = None
    force: Array = field(default_factory=lambda: np.zeros(3))
    step: int = 0
    probes: int = 0
    plan: list[PlannedPull] = field(default_factory=list)
    replanned_at: int = 0
    imagined: int = 0


class PicturePlayer:
    """Acts in the lanes of a batch, of which it reads nothing but the horizon and the pictures."""

    def __init__(self, learned: Learned, batch: EpisodeBatch) -> None:
        self._learned, self._batch = learned, batch
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self._planning = BatchedSearch(_PLANNER.batch_size)
        self._believed = ChainSimulation(max(_COPIES, MOST_IMAGINED))
        self._episodes: dict[int, _Episode] = {}

    def begin(self, ids: NDArray[np.int64], rngs: Sequence[np.random.Generator]) -> None:
        self.planned[ids] = 0
        reader, starts = self._learned
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            hypotheses = ShapeHypotheses(reader, self._believed, starts, rng)
            self._episodes[index] = _Episode(rng, self._batch.task.horizon, hypotheses)

    def act(self, ids: NDArray[np.int64]) -> Pulls:
        chosen = [self._act(self._episodes[k], self._batch.rgb(k)) for k in ids.tolist()]
        actions = np.stack(chosen)
        self.planned[ids] = [self._episodes[index].imagined for index in ids.tolist()]
        # The policy names a point, as an action does: which bead that is, the simulation decides
        # and the policy must infer.
        beads, _ = self._batch.simulation.read_actions(actions, ids)
        return Pulls(ids, beads, actions[:, 3:])

    def _act(self, episode: _Episode, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Choose an action from a picture of rope and goal.

        Args:
            episode: that it is of.
            picture: uint8 (SIZE, 2 SIZE, 3), the rope on the left and the goal on the right.

        Returns:
            The action, float32 (6,): the point that it names, and the force.
        """
        # before the first action there is nothing to predict from
        rope = episode.hypotheses.observe(picture, episode.named, episode.force)
        self._update_goal(episode, rope)
        self._choose_pull(episode)
        episode.step += 1
        assert episode.named is not None
        action = np.concatenate([episode.named / REACH, episode.force])
        return np.clip(action, -1, 1).astype(np.float32)

    def _update_goal(self, episode: _Episode, picture: NDArray[np.uint8]) -> None:
        """Lower the weight of goal codes that the rope shows now: the episode would be over."""
        shown = episode.hypotheses.codes(picture, current=True)
        # Bayes' rule for "the episode continues": its likelihood is _MISREAD if the rope shows the
        # goal's code and 1 if not, averaged over the codes that the rope may show.
        goals = episode.hypotheses.goals
        for code in goals:
            goals[code] *= 1.0 - (1.0 - _MISREAD) * shown.get(code, 0.0)
        goal = max(goals, key=lambda code: goals[code])
        if goal != episode.goal:
            episode.goal, episode.plan = goal, []

    def _choose_pull(self, episode: _Episode) -> None:
        """Set the episode's next named point and force."""
        hypotheses = episode.hypotheses
        towing = bool(episode.plan) and episode.plan[0].named is not None
        due = episode.step - episode.replanned_at >= _PATIENCE or not episode.plan
        # A tow takes many steps, and interrupting or turning it starts it over, so it is never
        # replaced.
        if due and not towing and self._success_rate(episode, episode.plan) < _KEEP_PLAN:
            self._replan(episode)
            episode.replanned_at = episode.step
        if episode.plan:
            bead, force, point = episode.plan.pop(0)
            if point is not None:
                episode.named, episode.force = point, force
                return
        else:
            bead, force = int(episode.rng.integers(BEADS)), episode.rng.uniform(-1, 1, 3)
        rope, position = hypotheses.ropes[0], hypotheses.position
        named, worth = position.aim(rope, bead)
        if worth < _AIM_WORTH and episode.probes < _MOST_PROBES:
            # The position is too uncertain to name that bead: pull where the outcome tells most
            # about it, away from the middle (in expectation over the bead pulled) and up.
            episode.probes += 1
            named = position.most_informative(rope)
            probabilities = position.bead_probabilities(rope, named)
            out = (probabilities[:, None] * rope).sum(axis=0) * (1, 1, 0)
            force = 0.6 * out / max(1e-6, np.linalg.norm(out)) + (0, 0, _PROBE_LIFT)
            episode.plan = []
        episode.named, episode.force = named, force

    def _replan(self, episode: _Episode) -> None:
        """Make up to _MOST_PLANS plans and keep the one with the highest estimated success."""
        assert episode.goal is not None
        best, highest = list[PlannedPull](), -1.0
        if not episode.goal.visits:  # the goal is a plain loop, to which towing leads
            best = [PlannedPull(-1, _TOW, REACH * _TOW)] * (episode.horizon - episode.step)
            highest = self._success_rate(episode, best)
        # the episode's budget is a soft limit: every replanning may still use _LEAST_BUDGET
        left = max(_LEAST_BUDGET, min(_BUDGET, _EPISODE_BUDGET - episode.imagined))
        for _ in range(_MOST_PLANS):
            if highest >= _ENOUGH or left < _PLANNER.batch_size:
                break
            ropes, velocities = episode.hypotheses.ropes[:1], episode.hypotheses.velocities[:1]
            self._believed.set_points(ropes, velocities, [0])
            state = self._believed.states([0])[0]
            search = PullSearch(episode.goal, PassValues.of_split(), _PLANNER, episode.rng)
            planning = search.plan(state, ropes[0], episode.horizon - episode.step, left)
            ((_, made),) = self._planning.run([planning], _PLANNER.batch_size)
            episode.imagined += made.spent
            left -= made.spent
            forces = made.forces.astype(np.float64)
            pulls = [*map(PlannedPull, made.beads.tolist(), forces)]
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
        rng = episode.rng
        points, velocities = episode.hypotheses.sample(_COPIES)
        # one factor per copy for the whole plan: a force that is off is off at every step
        gains = np.exp(rng.normal(0, _FORCE_NOISE, (len(points), 1)))
        # copy 0 stays the most likely hypothesis itself
        points[1:] = perturb_heights(points[1:], _HEIGHT_NOISE, rng)
        chain, copies = self._believed, np.arange(len(points))
        chain.set_points(points, velocities, copies)
        reached = np.zeros(len(points), dtype=bool)
        middle = episode.hypotheses.position.positions.mean(axis=0)
        for bead, force, named in pulls:
            # a pull by bead misses by a bead or so; a pull by point takes the bead nearest to it in
            # each copy, with the copies at the mean of the position belief
            if named is None:
                off = np.rint(rng.normal(0, _BEAD_NOISE, len(points))).astype(np.int64)
                beads = (bead + off) % BEADS
            else:
                off = chain.points[copies] + middle - named
                beads = np.linalg.norm(off, axis=2).argmin(axis=1)
            chain.step(beads, chain.max_force * gains * force, copies)
            reached |= [code.matches(episode.goal) for code in label_many(chain.points[copies])]
            if reached.all():
                break
        return float(reached.mean())


class PicturePolicy:
    """Chooses actions from the pictures of its episodes.

    Args:
        folder: of a checkpoint, or "pretrained", which ships with the package.

    Attributes:
        name: of the policy.

    Raises:
        InvalidFile: there is no checkpoint that this version can read.
    """

    def __init__(self, folder: str) -> None:
        self.name = PRETRAINED if folder == PRETRAINED else "learned"
        self._learned = load_reader(folder)

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task; raise InvalidPolicy if the reader can't read its pictures."""
        return require_readable(task, self.name)

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player for the lanes of a batch."""
        return PicturePlayer(self._learned, batch)


def require_readable(task: TaskConfig, policy: str, action: str = "pull") -> TaskConfig:
    """Return the task if the reader can read its pictures, and it has an action view.

    Raises:
        InvalidPolicy: it doesn't.
    """
    values = {**vars(task), "views": ",".join(task.views)}
    differing = [
        f"{name} {values[name]} instead of {needed}"
        for name, needed in {**_READABLE, "action": action}.items()
        if values[name] != needed
    ]
    if differing:
        raise InvalidPolicy(
            f"policy {policy} can't act in this task, which has {', '.join(differing)}"
        )
    return task
