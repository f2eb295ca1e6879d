"""The agent: pictures in, actions out, and nothing else.

Each step it reads where the rope lies, learns from it which bead its last pull moved, and goes on
with its plan, or plans anew: the planner of `control.planner`, in imagination. Heights can't be
read for sure, so it keeps several ropes that may be the one seen, and how a rope moves tells which.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.planner import PlannerConfig, plan
from knotgym.control.transition_graph import TransitionGraph
from knotgym.learn.imagination import Imagination, passed_through, state
from knotgym.learn.reader import Reader
from knotgym.learn.rope_model import BEADS, Dynamics
from knotgym.learn.whereabouts import Whereabouts
from knotgym.rendering.picture import draw
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

REACH = 2.0  # metres that an action's coordinate of 1 stands for
_TOGETHER = 25.0  # neighbouring beads that err alike
_ASTRAY = 0.5  # levels a pixel by which a rope led astray looks worse than a new reading
_ALIKE = 0.008  # metres in height, between ropes that count as one
_TOWS = np.array(
    [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
)  # forces of tows that are thought through
_ASKED = 2  # ropes that are asked which bead was pulled
_MISLED = 0.05  # how likely a code shown for sure is the goal, though the episode goes on
_SURPRISE = 0.0005  # how likely a bead is pulled that no place of the rope says would be


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
        ropes: kept at most, that may be the one seen.
        varied: ropes tried beside them after every pull, each a kept one with other heights.
        wave: metres by which heights are varied, about.
        varied_codes: ropes looked at for the codes that a reading may stand for.
        fresh: how likely it is that none of them is, and a new reading is better.
        rise: upward force of a probe, in units of the largest.
        blur: metres by which vertices foreseen and read differ, about.
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
    ropes: int = 24
    varied: int = 24
    wave: float = 0.008
    varied_codes: int = 30
    fresh: float = 0.05
    rise: float = 0.6
    blur: float = 0.003
    planner: PlannerConfig = PlannerConfig(batch_size=32, surrogate_rollouts=2)


@dataclass(eq=False)
class _Episode:
    """What is known of one episode."""

    rng: np.random.Generator
    horizon: int
    whereabouts: Whereabouts
    goals: dict[GaussCode, float] = field(default_factory=dict)  # what it may be, and how likely
    goal: GaussCode | None = None  # the likeliest
    ropes: Array = field(default_factory=lambda: np.zeros((1, BEADS, 3)))  # likeliest first
    velocities: Array = field(default_factory=lambda: np.zeros((1, BEADS, 3)))
    likely: Array = field(default_factory=lambda: np.ones(1))  # of the ropes, sums to 1
    named: Array | None = None  # the point of the world that the last action named
    force: Array = field(default_factory=lambda: np.zeros(3))
    bead: int = 0  # meant by it
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
        self._episodes[index] = _Episode(rng, horizon, Whereabouts(self.met, rng))

    def act(self, index: int, picture: NDArray[np.uint8]) -> tuple[NDArray[np.float32], str]:
        """Decide by a picture of rope and goal, uint8 (128, 256, 3): an action (6,), and why."""
        episode = self._episodes[index]
        size = picture.shape[0]
        if not episode.goals:
            goal = np.ascontiguousarray(picture[:, size:])
            episode.goals = self._codes(goal, *self.reader.read(goal), episode.rng)
        picture = np.ascontiguousarray(picture[:, :size])
        self._see(episode, picture)
        self._aim(episode, picture)
        move = self._decide(episode)
        episode.step += 1
        assert episode.named is not None
        action = np.concatenate([episode.named / REACH, episode.force])
        return np.clip(action, -1, 1).astype(np.float32), move

    def imagined(self, index: int) -> int:
        """Imagined actions of an episode."""
        return self._episodes[index].imagined

    def _codes(
        self, picture: NDArray[np.uint8], ropes: Array, likely: Array, rng: np.random.Generator
    ) -> dict[GaussCode, float]:
        """Codes that a picture may show, without chirality, and how likely each is.

        A reading is a millimetre off here and there, so a small kink may be missed or made up.
        """
        varied = self.reader.varied(picture, ropes, self.config.varied_codes, rng)
        codes: dict[GaussCode, float] = {}
        for code, share in zip(
            label_many(varied), np.repeat(likely, len(varied) // len(ropes)), strict=True
        ):
            codes[code.plain] = codes.get(code.plain, 0.0) + float(share)
        total = sum(codes.values())
        return {code: share / total for code, share in codes.items()}

    def _aim(self, episode: _Episode, picture: NDArray[np.uint8]) -> None:
        """Say which code is the goal: not the one shown now, for the episode would be over."""
        count = min(_ASKED, len(episode.ropes))
        shown = self._codes(picture, episode.ropes[:count], episode.likely[:count], episode.rng)
        for code in episode.goals:
            episode.goals[code] *= 1.0 - (1.0 - _MISLED) * shown.get(code, 0.0)
        goal = max(episode.goals, key=lambda code: episode.goals[code])
        if goal != episode.goal:
            episode.goal, episode.plan = goal, []

    def _see(self, episode: _Episode, picture: NDArray[np.uint8]) -> None:
        """Read the rope; if it was pulled, learn what moved."""
        read, likely = self.reader.read(picture)
        if episode.named is None:
            self._keep(episode, read, np.zeros_like(read), likely)
            return
        self._find_pulled(episode, read[0])
        rows = episode.rng.choice(len(episode.ropes), size=self.config.varied, p=episode.likely)
        varied = _waved(episode.ropes[rows], self.config.wave, episode.rng)
        before = np.concatenate([episode.ropes, varied])
        after, velocities = self.dynamics.step(
            before,
            np.concatenate([episode.velocities, episode.velocities[rows]]),
            np.full(len(before), episode.bead),
            np.tile(episode.force, (len(before), 1)),
        )
        middles = after.mean(axis=1)
        fit = self._fit(after - middles[:, None], read[0])
        prior = np.concatenate([episode.likely, np.full(len(rows), 1 / max(1, len(rows)))])
        carried = prior * np.exp(fit - fit.max())
        best = int(np.argmax(carried))
        episode.whereabouts.moved(middles[best])
        followed = self.reader.follow(picture, after - middles[:, None], after - before)
        fresh = self.config.fresh
        if _unlike(read[0], picture) + _ASTRAY < _unlike(followed[best], picture):
            fresh = 1 - fresh
        self._keep(
            episode,
            np.concatenate([followed, read]),
            np.concatenate([velocities, np.tile(velocities[best], (len(read), 1, 1))]),
            np.concatenate([(1 - fresh) * carried / carried.sum(), fresh * likely]),
        )

    def _find_pulled(self, episode: _Episode, read: Array) -> None:
        """Learn which bead the last action pulled, and so where the rope is."""
        assert episode.named is not None
        before = episode.ropes[0]
        fit = np.full(BEADS, -np.inf)
        for rope, speeds, likely in zip(
            episode.ropes[:_ASKED], episode.velocities, episode.likely, strict=False
        ):
            after, _ = self.dynamics.step(
                np.tile(rope, (BEADS, 1, 1)),
                np.tile(speeds, (BEADS, 1, 1)),
                np.arange(BEADS),
                np.tile(episode.force, (BEADS, 1)),
            )
            own = self._fit(after - after.mean(axis=1, keepdims=True), read)
            fit = np.logaddexp(fit, own + np.log(likely))
        likelihood = np.exp(fit - fit.max())
        shares = episode.whereabouts.shares(before, episode.named)
        episode.bead = int(np.argmax(likelihood * (shares + _SURPRISE)))
        episode.whereabouts.pulled(before, episode.named, likelihood)

    def _fit(self, foreseen: Array, read: Array) -> Array:
        """Logarithms of how likely a rope is read so, for each foreseen, (n,)."""
        off = ((foreseen[..., :2] - read[None, :, :2]) ** 2).sum(axis=2)
        blur = self.config.blur
        return -np.minimum(off, (4 * blur) ** 2).sum(axis=1) / (2 * blur**2 * _TOGETHER)

    def _keep(self, episode: _Episode, ropes: Array, velocities: Array, likely: Array) -> None:
        """Keep the likeliest of ropes, those that are alike as one."""
        kept: list[int] = []
        total = likely.copy()
        for row in np.argsort(-likely, kind="stable").tolist():
            apart = ropes[kept, :, 2] - ropes[row, :, 2]
            same = np.flatnonzero((apart**2).mean(axis=1) < _ALIKE**2)
            if len(same):
                total[kept[same[0]]] += likely[row]
            elif len(kept) < self.config.ropes:
                kept.append(row)
        kept.sort(key=lambda row: -total[row])
        episode.ropes, episode.velocities = ropes[kept], velocities[kept]
        episode.likely = total[kept] / total[kept].sum()

    def _decide(self, episode: _Episode) -> str:
        """Choose bead and force."""
        assert episode.goal is not None
        due = episode.step - episode.planned >= self.config.patience or not episode.plan
        if due and self._surety(episode, episode.plan) < self.config.sure:
            self._plan(episode)
            episode.planned = episode.step
        if episode.plan:
            bead, force, point = episode.plan.pop(0)
            if point is not None:
                shares = episode.whereabouts.shares(episode.ropes[0], point)
                episode.named, episode.force, episode.bead = point, force, int(shares.argmax())
                return "tow"
            move = "plan"
        else:
            bead, force = int(episode.rng.integers(BEADS)), episode.rng.uniform(-1, 1, 3)
            move = "lost"
        named, sure = episode.whereabouts.aim(episode.ropes[0], bead)
        if sure < self.config.named and episode.probes < self.config.probes:
            episode.probes += 1
            named = episode.whereabouts.probe(episode.ropes[0])
            shares = episode.whereabouts.shares(episode.ropes[0], named)
            out = (shares[:, None] * episode.ropes[0]).sum(axis=0) * (1, 1, 0)
            force = 0.6 * out / max(1e-6, np.linalg.norm(out)) + (0, 0, self.config.rise)
            move = "probe"
            episode.plan = []
        episode.named, episode.force, episode.bead = named, force, bead
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
                self._imagination,  # type: ignore[arg-type]
                state(episode.ropes[0], episode.velocities[0]),
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
        """The tow that is surest to straighten the rope, and how sure."""
        left = episode.horizon - episode.step
        tows = [[Pull(-1, force, REACH * force)] * left for force in _TOWS]
        sure = [self._surety(episode, tow) for tow in tows]
        best = int(np.argmax(sure))
        return tows[best], sure[best]

    def _surety(self, episode: _Episode, steps: list[Pull]) -> float:
        """The share of ropes, lying a little otherwise, that a plan leads to the goal."""
        if not steps:
            return -1.0
        assert episode.goal is not None
        rng = episode.rng
        rows = rng.choice(len(episode.ropes), size=self.config.copies, p=episode.likely)
        rows[0] = 0
        points, velocities = episode.ropes[rows], episode.velocities[rows]
        gains = np.exp(rng.normal(0, self.config.gain, (len(points), 1)))
        points[1:] = _waved(points[1:], self.config.doubt, rng)
        codes = label_many(points)
        reached, torn = np.zeros((2, len(points)), dtype=bool)
        place = episode.whereabouts.places.mean(axis=0)
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


def _waved(ropes: Array, size: float, rng: np.random.Generator) -> Array:
    """Ropes (n, BEADS, 3) with smooth changes of their heights, of about `size` metres."""
    number = rng.integers(1, 9, (len(ropes), 1))
    angle = number * 2 * np.pi * np.arange(BEADS) / BEADS + rng.uniform(0, 2 * np.pi, number.shape)
    changed = ropes.copy()
    changed[..., 2] += size * rng.normal(size=number.shape) * np.sqrt(2) * np.cos(angle)
    return changed


def _unlike(points: Array, picture: NDArray[np.uint8]) -> float:
    """How much the picture that points would give differs from the one seen, levels a pixel."""
    drawn = draw(points).astype(np.int16)
    return float(np.abs(drawn - picture).mean())
