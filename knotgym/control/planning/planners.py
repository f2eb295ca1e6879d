"""The two planners at work: `PassPlayer` (policy expert) and `PullPlayer` (policy planner).

Both search in the chain engine, whichever engine an episode has. All searches of a player run side
by side. A lane whose next move is being searched for waits while the others go on, so neither
simulation stands still, and no episode can tell what runs beside it.

After a change run

    knotgym evaluate --policy expert --task tie --nx 2,3 --engine chain --episodes 128

All episodes of nx 2 and 94 % of nx 3 must succeed, and with `--policy planner` all of both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, InvalidPolicy
from knotgym.control.planning.batched_search import LONGEST, BatchedSearch, Search
from knotgym.control.planning.passes import PassPlan, PassSearch, PassValues, TriedPass
from knotgym.control.policy_config import PolicyConfig, PullPlannerConfig
from knotgym.control.sampler import Player, Pulls
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import VIEWS, ChainSimulation, Pass, Simulation, WaypointFollower, simulation_of
from knotgym.topology import GaussCode, label

if TYPE_CHECKING:
    from knotgym.control.planning.pulls import PullPlan

SLOTS = 12  # most slots that a search of a policy of passes takes
# The next two are about speed, and no result depends on them. Why these, no record says; the CPU
# time of `knotgym collect --policy expert --engine chain` would tell.
_FEW = 8  # lanes; fewer don't wait for each other
_SPARE = 2  # ropes to search in, per rope of the batch
# share of the limit on towing that passes go to, as engines differ a little; not measured
_TOWING = 0.9


def chooses_pulls(task: TaskConfig) -> TaskConfig:
    """Return the task.

    Raises:
        InvalidPolicy: its actions are of another view than pulls.
    """
    if not VIEWS[task.action].is_plain:
        raise InvalidPolicy(
            f"this policy chooses pulls, so its action must be 'pull', got {task.action!r}"
        )
    return task


class LaneSearches:
    """The searches for the lanes of a batch.

    Attributes:
        search: in which they run.
        check: one rope of the episodes' engine, in which what was found is acted out before it
            counts.
        thinking: bool (lanes,), whether a lane waits for its search.
        planned: int64 (lanes,), pulls simulated for the episode in a lane.
    """

    def __init__(self, batch: EpisodeBatch, slots: int) -> None:
        """Make ropes for searches, each of which takes at most so many slots."""
        # twice as many ropes as lanes: while some searches end, others begin, and none waits for
        # room
        rope, count = batch.simulation.rope, batch.count
        self.search = BatchedSearch(max(_SPARE * count, slots), rope)
        self.check = simulation_of(1, rope.config, batch.simulation.engine)
        self.thinking, self.planned = np.zeros(count, bool), np.zeros(count, np.int64)
        self._callbacks: dict[int, Callable[[int, Any], None]] = {}
        self._follower = WaypointFollower(1)
        self._at_rest: ChainSimulation | None = None

    def forget(self, ids: Ids) -> None:
        """Drop the searches for some lanes."""
        # only searches under way: another episode's result must not arrive in this one
        for index in ids[self.thinking[ids]].tolist():
            self.search.drop(index)
        self.thinking[ids] = False

    def start(
        self, index: int, search: Search[Any], decided: Callable[[int, Any], None], slots: int = 1
    ) -> None:
        """Begin a search for a lane; `decided` will be called with the lane and the result."""
        self.thinking[index], self._callbacks[index] = True, decided
        self.search.add(index, search, slots)

    def tick(self) -> None:
        """Simulate a pull in every search that is under way."""
        for index, result in self.search.tick():
            self.thinking[index] = False
            self.planned[index] += result.spent
            self._callbacks[index](index, result)

    def in_chain(self, simulation: Simulation, ids: Ids) -> tuple[Array, Array]:
        """States in the chain engine, and points (n, beads, 3), of ropes of any engine.

        Those of another engine are at rest: velocities fade within 20 ms.
        """
        if isinstance(simulation, ChainSimulation):
            return simulation.states(ids), simulation.points[ids].copy()
        if self._at_rest is None:
            self._at_rest = ChainSimulation(len(self.thinking), simulation.rope)
        rows = np.arange(len(ids))
        # laid at rest, as the velocities of another engine mean nothing here
        self._at_rest.set_qpos(simulation.qpos(ids), rows)
        return self._at_rest.states(rows), self._at_rest.points[rows]

    def act_out(self, state: Array, goal: GaussCode, move: Pass) -> tuple[Array, int]:
        """Carry a pass out in the episodes' engine, from a state of it; see `PassSearch`."""
        check, follower, rope = self.check, self._follower, np.zeros(1, np.int64)
        check.restore(state[None])
        follower.begin_passes(rope, [move], check.points)
        pulls = 0
        while pulls < LONGEST and not follower.arrive(check.points, rope)[0]:
            forces = follower.forces(check.points, rope).astype(np.float64)
            stable = check.step(follower.beads, forces * check.max_force)[0]
            pulls += 1
            if not stable or label(check.points[0]).matches(goal):
                break
        return check.points[0], pulls


class PullPlayer(Player):
    """Leads ropes to their goals by plans of pulls: the policy `planner`.

    Each episode has a budget of simulated pulls for all its plans together. Once it is used up, the
    rope is left alone.
    """

    def __init__(
        self, config: PullPlannerConfig, batch: EpisodeBatch, searches: LaneSearches | None = None
    ) -> None:
        """Take settings, the lanes, and the searches, which others may use too."""
        self._config, self._batch = config, batch
        self._searches = searches = searches or LaneSearches(batch, config.batch_size)
        self._values = PassValues.of_split(batch.task.split)
        self._rngs: dict[int, np.random.Generator] = {}
        self._plans: dict[int, list[tuple[int, NDArray[np.float32]]]] = {}  # the next pull is last
        self._spent = np.zeros(batch.count, np.int64)  # pulls simulated for the episode's plans
        self.planned = searches.planned

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        self._searches.forget(ids)
        self.planned[ids] = 0
        self._rngs |= dict(zip(ids.tolist(), rngs, strict=True))
        self._plans |= {index: [] for index in ids.tolist()}
        self._spent[ids] = 0  # budgets are an episode's own

    def act(self, ids: Ids) -> Pulls:
        self.look(ids)
        self._searches.tick()
        ready = ids[~self._searches.thinking[ids]]
        return Pulls(ready, *self.pulls(ready))

    def look(self, ids: Ids) -> None:
        """Begin searches where a plan is over and budget is left."""
        batch, config = self._batch, self._config
        for index in ids[~self._searches.thinking[ids]].tolist():
            used_up = self._spent[index] + config.batch_size > config.budget
            # a rope that shows its goal is left alone until it has held it
            if self._plans[index] or batch.shown[index] or used_up:
                continue
            (goal,) = batch.goals_of(np.array([index]))
            # imported here, as the expert seldom needs it
            from knotgym.control.planning.pulls import PullSearch

            # the budget left is that of the episode, whatever its earlier plans spent
            settings = self._rngs[index], int(batch.hold[index]), batch.tow_bound(index)
            search = PullSearch(goal, self._values, config, *settings)
            state = batch.simulation.states([index])[0]
            left = int(batch.task.horizon - batch.steps[index])
            budget = int(config.budget - self._spent[index])
            in_chain = partial(self._searches.in_chain, ids=np.zeros(1, np.int64))
            made = search.checked(self._searches.check, in_chain, state, left, budget)
            self._searches.start(index, made, self._decided, config.batch_size)

    def _decided(self, index: int, plan: PullPlan) -> None:
        """Follow a plan that a search has found."""
        self._plans[index] = [*zip(plan.beads.tolist(), plan.forces, strict=True)][::-1]
        self._spent[index] += plan.spent

    def pulls(self, ids: Ids) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The next pulls of plans; no force where there is no plan."""
        beads, forces = np.zeros(len(ids), np.int64), np.zeros((len(ids), 3), np.float32)
        for row, index in enumerate(ids.tolist()):
            if self._plans[index]:
                beads[row], forces[row] = self._plans[index].pop()
        return beads, forces


class PassPlayer(Player):
    """Leads ropes to their goals by passes, the same state and goal, the same pass: `expert`.

    Each pass is acted out until its end, the goal, or LONGEST pulls. Where the rope then lies
    exactly as the search foresaw, which in the chain engine it does, the next pass that was found
    follows; otherwise it searches again. So what it does is a function of the rope's state, which a
    network can learn. Where a search finds nothing, a `PullPlayer` acts until the episode ends.

    Attributes:
        goals: the code that each lane is led to.
    """

    def __init__(self, config: PolicyConfig, batch: EpisodeBatch) -> None:
        self._config, self.batch, count = config.expert, batch, batch.count
        self._values = PassValues.of_split(batch.task.split)
        self.searches = LaneSearches(batch, max(SLOTS, config.planner.batch_size))
        # in the last resort the planner of pulls may simulate less than where it is the policy
        least = min(config.planner.budget, config.expert.last_resort)
        self._last_resort = PullPlayer(replace(config.planner, budget=least), batch, self.searches)
        self._by_pulls = np.zeros(count, bool)  # whether the last resort acts
        self._follower = WaypointFollower(count)
        self._moves, self._taken = np.zeros((count, 3), np.int64), np.zeros(count, np.int64)
        # passes that were found: the one under way, and those after it
        self._plans: dict[int, list[TriedPass]] = {}
        self.goals = [GaussCode(())] * count
        self.planned = self.searches.planned

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        self._last_resort.begin(ids, rngs)
        self.replan(ids)
        for index, goal in zip(ids.tolist(), self.batch.goals_of(ids), strict=True):
            self.goals[index] = goal

    def act(self, ids: Ids) -> Pulls:
        points, follower = self.batch.simulation.points, self._follower
        passing = ids[~self._by_pulls[ids] & ~self.searches.thinking[ids]]
        # first, as a rope that shows its goal needs no further pass
        settled = self._settle(passing)
        # Waypoints that were reached are passed before anything is decided, so that a pass that is
        # over leads to a search in this very action.
        over = follower.arrive(points, passing) | (self._taken[passing] >= LONGEST)
        self._search(self._without_plan(passing[over & ~settled]))
        self._last_resort.look(ids[self._by_pulls[ids]])
        self.searches.tick()
        # Many pulls together take less time: most of many ropes wait until searches are done.
        while 4 * np.count_nonzero(self.searches.thinking[ids]) > len(ids) > _FEW:
            self.searches.tick()
        ready = ids[~self.searches.thinking[ids]]
        beads, forces = follower.beads[ready], follower.forces(points, ready)
        macros = np.column_stack([self._taken[ready] == 0, self._moves[ready]])
        idle = follower.idle[ready]  # the goal is shown: without force the rope settles
        by_pulls = self._by_pulls[ready]
        beads[idle], macros[idle | by_pulls] = 0, 0  # single pulls are part of no pass
        self._taken[ready] += 1
        if by_pulls.any():
            beads[by_pulls], forces[by_pulls] = self._last_resort.pulls(ready[by_pulls])
        return Pulls(ready, beads, forces, macros)

    def replan(self, ids: Ids) -> None:
        """Look again before the next action of some lanes."""
        self.searches.forget(ids)
        for index in ids.tolist():
            self._plans.pop(index, None)
        self._by_pulls[ids] = False
        self._follower.release(ids)

    def lead(self, index: int, move: Pass) -> None:
        """Carry out a pass in a lane, whichever planner chose it."""
        points, ids = self.batch.simulation.points, np.array([index])
        self._moves[index], self._taken[index] = move, 0
        self._follower.begin_passes(ids, [move], points)
        # a bead may be at its first waypoint already, where a pull towards it would be lost
        self._follower.arrive(points, ids)

    def _settle(self, ids: Ids) -> NDArray[np.bool_]:
        """End the passes of ropes that show their goals; return which should lie still."""
        shown = self.batch.shown[ids]
        self._follower.release(ids[shown])
        return shown

    def _decided(self, index: int, plan: PassPlan) -> None:
        """Go on after a search."""
        if plan.passes:
            self._follow(index, plan.passes)
        else:
            self._give_up(index)

    def _give_up(self, index: int) -> None:
        """Go on after a search that found nothing."""
        self._by_pulls[index] = True
        self._last_resort.look(np.array([index]))

    def _follow(self, index: int, plan: list[TriedPass]) -> None:
        self._plans[index] = plan
        self.lead(index, plan[0].move)

    def _without_plan(self, ids: Ids) -> Ids:
        """Go on to the next passes of plans that hold; return the lanes that have none."""
        points, left = self.batch.simulation.points, list[int]()
        for index in ids.tolist():
            plan = self._plans.pop(index, [])
            # to the bit: the chain engine lands exactly where its search did; another engine
            # doesn't, and searches again
            if len(plan) > 1 and np.array_equal(plan[0].landing.points, points[index]):
                self._follow(index, plan[1:])
            else:
                left.append(index)
        return np.array(left, np.int64)

    def _search(self, ids: Ids) -> None:
        """Begin searches for the next passes of some lanes."""
        simulation = self.batch.simulation
        states, points = self.searches.in_chain(simulation, ids) if len(ids) else ((), ())
        real_states = simulation.states(ids) if len(ids) else ()
        # where the chain engine counts, acting a pass out would repeat what the search did
        is_chain = isinstance(simulation, ChainSimulation)
        for index, state, rope, real in zip(ids.tolist(), states, points, real_states, strict=True):
            goal, bound = self.goals[index], self.batch.tow_bound(index, _TOWING)
            act_out = None if is_chain else partial(self.searches.act_out, real, goal)
            search = PassSearch(self._values, goal, self._config, bound, act_out)
            self.searches.start(index, search.run(state, rope), self._decided)
