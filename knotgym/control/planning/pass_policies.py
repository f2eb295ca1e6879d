"""Players that act in macro-actions without a plan of their own, and players that mix others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids
from knotgym.control.basic_policies import RandomPlayer
from knotgym.control.planning.batched_search import LONGEST, Orders, Search, Trial
from knotgym.control.planning.passes import PassPlan
from knotgym.control.planning.planners import SLOTS, PassPlayer
from knotgym.control.policy_config import MIXED, PolicyConfig
from knotgym.control.sampler import Player, Pulls
from knotgym.envs import EpisodeBatch
from knotgym.rope import MacroAction, Pass, WaypointFollower, quantized
from knotgym.topology import GaussCode

_PREFIXED = 0.5  # share of noisy episodes that begin with a random pass; not measured


class ScriptedPlayer(Player):
    """Random macro-actions, one after another: the policy `scripted`."""

    def __init__(self, batch: EpisodeBatch) -> None:
        self._batch, self._follower = batch, WaypointFollower(batch.count)
        self._rngs: dict[int, np.random.Generator] = {}
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
        return Pulls(ids, follower.beads[ids], follower.forces(points, ids))


class NoisyPlayer(Player):
    """A `PassPlayer` with some pulls replaced by random ones, after which it looks again: `noisy`.

    Half of the episodes begin with a random pass, so that learners see more than tidy ropes.
    """

    def __init__(self, config: PolicyConfig, batch: EpisodeBatch) -> None:
        self._inner, self._batch, self._noise = PassPlayer(config, batch), batch, config.noise
        self._rngs: dict[int, np.random.Generator] = {}
        self._drawn = np.full(batch.count, -1)  # the step of which it was drawn whether it is noisy
        self._noisy, self._in_prefix = np.zeros((2, batch.count), bool)
        self.planned = self._inner.planned

    @classmethod
    def varied(cls, config: PolicyConfig, batch: EpisodeBatch) -> NoisyPlayer:
        """Make a player without random pulls: `varied`."""
        return cls(replace(config, noise=0.0), batch)

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        drawing, inner = zip(*(rng.spawn(2) for rng in rngs), strict=True)
        self._inner.begin(ids, inner)
        self._drawn[ids] = -1
        beads = self._batch.simulation.points.shape[1]
        for index, rng in zip(ids.tolist(), drawing, strict=True):
            self._rngs[index] = rng
            # The first draws of an episode: whether it wanders, and where to.
            self._in_prefix[index] = rng.random() < _PREFIXED
            if self._in_prefix[index]:
                self._inner.lead(index, Pass.drawn(beads, rng))

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
        self._in_prefix[np.concatenate([noisy, inner.ids[chosen]])] = False
        inner.macros[self._in_prefix[inner.ids]] = 0
        return _together([Pulls(noisy, beads, forces), inner])


class _Simplest(NamedTuple):
    """The pass, of some, that leaves the fewest crossings, and the pulls simulated."""

    move: Pass
    spent: int


class PlayPlayer(PassPlayer):
    """A `PassPlayer` on its way to one goal after another, in endless tasks: the policy `play`.

    The first goal is the episode's. Whenever one is reached, another is drawn: half the time a code
    of the task's goals, half the time one of its starts, so ropes are tied and untied in turn.
    Where a search finds nothing, another goal is drawn, after a random pass: of a dozen, the one
    that leaves the fewest crossings.
    """

    def __init__(self, config: PolicyConfig, batch: EpisodeBatch) -> None:
        super().__init__(config, batch)
        self._rngs: dict[int, np.random.Generator] = {}
        self._sides = [batch.side_codes(side) for side in ("start", "goal")]

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        drawing, inner = zip(*(rng.spawn(2) for rng in rngs), strict=True)
        super().begin(ids, inner)
        self._rngs |= dict(zip(ids.tolist(), drawing, strict=True))

    def _settle(self, ids: Ids) -> NDArray[np.bool_]:
        """Draw new goals for ropes that show theirs; none lies still."""
        codes = zip(ids.tolist(), self.batch.codes_of(ids), strict=True)
        reached = [index for index, code in codes if code.matches(self.goals[index])]
        for index in reached:
            self._draw_goal(index)
        self.replan(np.array(reached, np.int64))
        return np.zeros(len(ids), bool)

    def _decided(self, index: int, plan: PassPlan | _Simplest) -> None:
        """Go on after a search."""
        if isinstance(plan, PassPlan):
            super()._decided(index, plan)
        else:
            self.lead(index, plan.move)
            self._draw_goal(index)

    def _give_up(self, index: int) -> None:
        """Search for a random pass that leaves few crossings."""
        rng, beads = self._rngs[index], self.batch.simulation.points.shape[1]
        # as many as a search has slots: all are simulated side by side, for the price of little
        # more than one
        passes = [Pass.drawn(beads, rng) for _ in range(SLOTS)]
        (state,), _ = self.searches.in_chain(self.batch.simulation, np.array([index]))
        search = _simplest(state, passes, self.goals[index])
        self.searches.start(index, search, self._decided, SLOTS)

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


class MixedPlayer(Player):
    """One of the policies MIXED for each episode, drawn when it begins: the policy `mixed`."""

    def __init__(self, config: PolicyConfig, batch: EpisodeBatch) -> None:
        self._players: list[Player] = [RandomPlayer(batch), ScriptedPlayer(batch)]
        self._players += [NoisyPlayer(config, batch), PassPlayer(config, batch)]
        self._shares = np.array(config.shares) / sum(config.shares)
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
            self.names[index] = MIXED[self._chosen[index]]
        for number, player in enumerate(self._players):
            played = self._chosen[ids] == number
            if played.any():
                player.begin(ids[played], [rngs[row] for row in np.flatnonzero(played).tolist()])

    def act(self, ids: Ids) -> Pulls:
        lanes = [ids[self._chosen[ids] == number] for number in range(len(self._players))]
        acting = zip(self._players, lanes, strict=True)
        return _together([player.act(some) for player, some in acting if len(some)])


def _together(parts: list[Pulls]) -> Pulls:
    """Join pulls in different lanes."""
    macros = [
        np.zeros((len(part.ids), 4), np.int64) if part.macros is None else part.macros
        for part in parts
    ]
    ids = np.concatenate([part.ids for part in parts])
    # lanes in increasing order, as `rollouts` checks
    order = np.argsort(ids, kind="stable")
    beads, forces = (np.concatenate([part[k] for part in parts])[order] for k in (1, 2))
    return Pulls(ids[order], beads, forces, np.concatenate(macros)[order])
