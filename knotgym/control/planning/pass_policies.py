"""Policies that act in macro-actions without a plan of their own, and policies that mix others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidPolicy
from knotgym.control.planning.batched_search import Orders, Search, Trial
from knotgym.control.planning.passes import PassPlan, random_pass
from knotgym.control.planning.planners import SLOTS, ChoosesPulls, Ids, PassPlanner, PassPlayer
from knotgym.control.sampler import Player, Policy, Pulls
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import LONGEST, Array, MacroAction, Pass, WaypointFollower, quantized
from knotgym.topology import GaussCode

_WANDERING = 0.5  # share of noisy episodes that begin with a random pass; not measured


@dataclass(frozen=True)
class Scripted(ChoosesPulls):
    """Random macro-actions, one after another."""

    name: str = "scripted"

    def player(self, batch: EpisodeBatch) -> ScriptedPlayer:
        """Return a player for the lanes of a batch."""
        return ScriptedPlayer(batch)


class ScriptedPlayer(Player):
    """`Scripted` at work; see `Player`.

    Attributes:
        moves: the macro-action under way in each lane.
        begun: bool (lanes,), whether its first pull was the last one chosen.
    """

    def __init__(self, batch: EpisodeBatch) -> None:
        self._batch, self._follower = batch, WaypointFollower(batch.count)
        self._rngs: dict[int, np.random.Generator] = {}
        self.moves: dict[int, MacroAction] = {}
        self.begun = np.zeros(batch.count, bool)
        self.planned = np.zeros(batch.count, np.int64)

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        self._follower.release(ids)
        self._rngs |= dict(zip(ids.tolist(), rngs, strict=True))

    def act(self, ids: Ids) -> Pulls:
        points, follower = self._batch.simulation.points, self._follower
        idle = ids[follower.arrive(points, ids)]
        # drawn lane by lane, each from its own generator: who else is idle changes nothing
        new = {k: MacroAction.drawn(points[k], self._rngs[k]) for k in idle.tolist()}
        if new:
            follower.begin(idle, [*new.values()])
            follower.arrive(points, idle)
        self.moves |= new
        self.begun[ids] = np.isin(ids, idle)
        return Pulls(ids, follower.beads[ids], follower.forces(points, ids))


@dataclass(frozen=True)
class Noisy(ChoosesPulls):
    """A `PassPlanner` with some pulls replaced by random ones, after which it looks again.

    Half of the episodes begin with a random pass, so that learners see more than tidy ropes.

    Attributes:
        inner: the planner.
        noise: share of pulls that are random, in [0, 1].
    """

    inner: PassPlanner = PassPlanner()
    noise: float = 0.3
    name: str = "noisy"

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player for the lanes of a batch."""
        return _NoisyPlayer(self, batch)


class _NoisyPlayer(Player):
    def __init__(self, policy: Noisy, batch: EpisodeBatch) -> None:
        self._inner, self._batch, self._noise = policy.inner.player(batch), batch, policy.noise
        self._rngs: dict[int, np.random.Generator] = {}
        self._drawn = np.full(batch.count, -1)  # the step of which it was drawn whether it is noisy
        self._noisy, self._wandering = np.zeros((2, batch.count), bool)
        self.planned = self._inner.planned

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        own, inner = zip(*(rng.spawn(2) for rng in rngs), strict=True)
        self._inner.begin(ids, inner)
        self._drawn[ids] = -1
        beads = self._batch.simulation.points.shape[1]
        for index, rng in zip(ids.tolist(), own, strict=True):
            self._rngs[index] = rng
            # The first draws of an episode: whether it wanders, and where to.
            self._wandering[index] = rng.random() < _WANDERING
            if self._wandering[index]:
                self._inner.lead(index, random_pass(beads, rng))

    def act(self, ids: Ids) -> Pulls:
        # a lane that waits for its search is asked again at the same step
        new = ids[self._drawn[ids] != self._batch.steps[ids]]
        self._drawn[new] = self._batch.steps[new]
        self._noisy[new] = [self._rngs[index].random() < self._noise for index in new.tolist()]
        noisy = ids[self._noisy[ids]]
        # a random pull leaves the rope where no plan foresaw it
        self._inner.replan(noisy)
        count = self._batch.simulation.points.shape[1]
        beads, forces = np.zeros(len(noisy), np.int64), np.zeros((len(noisy), 3), np.float32)
        for row, index in enumerate(noisy.tolist()):
            beads[row] = self._rngs[index].integers(count)
            forces[row] = quantized(self._rngs[index].uniform(-1, 1, 3))
        inner = self._inner.act(ids[~self._noisy[ids]])
        # nobody chose the random pass: it is none of the macro-actions that learners imitate
        assert inner.macros is not None
        chosen = (inner.macros[:, 0] > 0) & (self._batch.steps[inner.ids] > 0)
        self._wandering[np.concatenate([noisy, inner.ids[chosen]])] = False
        inner.macros[self._wandering[inner.ids]] = 0
        return _together([Pulls(noisy, beads, forces), inner])


@dataclass(frozen=True)
class Play(ChoosesPulls):
    """A `PassPlanner` on its way to one goal after another, in endless tasks.

    The first goal is the episode's. Whenever one is reached, another is drawn: half the time a code
    of the task's goals, half the time one of its starts, so ropes are tied and untied in turn.
    Where a search finds nothing, another goal is drawn, after a random pass: of a dozen, the one
    that leaves the fewest crossings.

    Attributes:
        inner: the planner.
    """

    inner: PassPlanner = PassPlanner()
    name: str = "play"

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task; it must be endless, and its actions must be pulls."""
        if not task.endless:
            raise InvalidPolicy(
                "policy play goes on after every goal, so the task must be endless; set"
                " task.endless, and a task.horizon such as 500"
            )
        return super().compatible_task(task)

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player for the lanes of a batch."""
        return PlayPlayer(self.inner, batch)


class _Simplest(NamedTuple):
    """The pass, of some, that leaves the fewest crossings, and the pulls simulated."""

    move: Pass
    spent: int


class PlayPlayer(PassPlayer):
    def __init__(self, policy: PassPlanner, batch: EpisodeBatch) -> None:
        super().__init__(policy, batch)
        self._rngs: dict[int, np.random.Generator] = {}
        self._sides = [batch.side_codes(side) for side in ("start", "goal")]

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        own, inner = zip(*(rng.spawn(2) for rng in rngs), strict=True)
        super().begin(ids, inner)
        self._rngs |= dict(zip(ids.tolist(), own, strict=True))

    def settle(self, ids: Ids) -> NDArray[np.bool_]:
        """Draw new goals for ropes that show theirs; none lies still."""
        codes = zip(ids.tolist(), self.batch.codes_of(ids), strict=True)
        reached = [index for index, code in codes if code.matches(self.goals[index])]
        for index in reached:
            self._draw_goal(index)
        self.replan(np.array(reached, np.int64))
        return np.zeros(len(ids), bool)

    def decided(self, index: int, found: PassPlan | _Simplest) -> None:
        """Go on after a search."""
        if isinstance(found, PassPlan):
            super().decided(index, found)
        else:
            self.lead(index, found.move)
            self._draw_goal(index)

    def give_up(self, index: int) -> None:
        """Search for a random pass that leaves few crossings."""
        rng, beads = self._rngs[index], self.batch.simulation.points.shape[1]
        # as many as a search has slots: all are simulated side by side, for the price of little
        # more than one
        passes = [random_pass(beads, rng) for _ in range(SLOTS)]
        (state,), _ = self.desk.in_chain(self.batch.simulation, np.array([index]))
        self.desk.ask(self, index, _simplest(state, passes, self.goals[index]), SLOTS)

    def _draw_goal(self, index: int) -> None:
        rng, (code,) = self._rngs[index], self.batch.codes_of(np.array([index]))
        # what is shown already would be reached without a pull
        sides = [[goal for goal in side if not code.matches(goal)] for side in self._sides]
        # a side whose only code is shown, such as the plain loop, has none left
        goals = [side for side in sides if side]
        drawn = goals[int(rng.integers(len(goals)))]
        self.goals[index] = drawn[int(rng.integers(len(drawn)))]


def _simplest(state: Array, passes: list[Pass], goal: GaussCode) -> Search[_Simplest]:
    """Try passes side by side."""
    left, spent = dict[int, int](), 0
    orders = Orders({k: Trial(state, move, LONGEST, goal) for k, move in enumerate(passes)})
    while len(left) < len(passes):
        _, reports = yield orders
        left |= {slot: report.code.nx for slot, report in reports}
        spent += sum(report.pulls for _, report in reports)
        orders = Orders({})
    # of equals the first drawn
    return _Simplest(passes[min(left, key=lambda slot: (left[slot], slot))], spent)


@dataclass(frozen=True)
class Mixed:
    """Draws one of several policies for each episode when it begins.

    Attributes:
        policies: the policies.
        shares: how likely each is, up to a factor.
    """

    policies: tuple[Policy, ...]
    shares: tuple[float, ...]
    name: str = "mixed"

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task with what all of the policies need."""
        for policy in self.policies:
            task = policy.compatible_task(task)
        return task

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player for the lanes of a batch."""
        return _MixedPlayer(self, batch)


class _MixedPlayer(Player):
    def __init__(self, policy: Mixed, batch: EpisodeBatch) -> None:
        self._players = [one.player(batch) for one in policy.policies]
        self._policies, self._shares = policy.policies, np.array(policy.shares) / sum(policy.shares)
        self._chosen = np.zeros(batch.count, np.int64)
        self.names = [""] * batch.count

    @property
    def planned(self) -> NDArray[np.int64]:  # type: ignore[override]
        """Pulls simulated for the episode in each lane."""
        return np.choose(self._chosen, [player.planned for player in self._players])

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            # the policy is drawn first, then the same generator is that policy's
            self._chosen[index] = rng.choice(len(self._players), p=self._shares)
            self.names[index] = self._policies[self._chosen[index]].name
        for number, player in enumerate(self._players):
            own = self._chosen[ids] == number
            if own.any():
                player.begin(ids[own], [rngs[row] for row in np.flatnonzero(own).tolist()])

    def act(self, ids: Ids) -> Pulls:
        own = [ids[self._chosen[ids] == number] for number in range(len(self._players))]
        acting = zip(self._players, own, strict=True)
        return _together([player.act(some) for player, some in acting if len(some)])


def _together(parts: list[Pulls]) -> Pulls:
    """Join pulls in different lanes."""
    macros = [
        np.zeros((len(one.ids), 4), np.int64) if one.macros is None else one.macros for one in parts
    ]
    ids = np.concatenate([one.ids for one in parts])
    # lanes in increasing order, as `rollouts` checks
    order = np.argsort(ids)
    beads, forces = (np.concatenate([one[k] for one in parts])[order] for k in (1, 2))
    return Pulls(ids[order], beads, forces, np.concatenate(macros)[order])
