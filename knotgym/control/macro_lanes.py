"""Passes on many ropes at once, in the lanes of one chain simulation.

The chain engine steps a hundred ropes in little more time than eight. A search that tries one pass
after another can't use that alone, so hundreds of searches run side by side: each is a generator
that yields a `Trial` and is sent its `Landing`. What a search finds doesn't depend on its company.
"""

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import LONGEST, Pass, WaypointController, pass_straight
from knotgym.rope.model import Array, Rope
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

Result = TypeVar("Result")


class Trial(NamedTuple):
    """A pass to try.

    Attributes:
        state: of the chain engine.
        move: the pass; it ends with its last waypoint, or at the goal.
        goal: compared without chirality.
        pulls: actions that it may take.
        bound: region in which the rope's centre must stay; None for no limit.
    """

    state: Array
    move: Pass
    goal: GaussCode
    pulls: int = LONGEST
    bound: TowBound | None = None


class Landing(NamedTuple):
    """Where a trial ended.

    Attributes:
        state: at rest.
        points: float64 (beads, 3), metres.
        code: with chirality.
        pulls: actions taken.
        towed: whether the rope left the trial's bound, where the trial ended.
    """

    state: Array
    points: Array
    code: GaussCode
    pulls: int
    towed: bool = False


Search = Generator[Trial, Landing, Result]


@dataclass(eq=False)
class _Lane(Generic[Result]):
    """A search, its number, and the trial under way with the actions taken so far."""

    number: int
    search: Search[Result]
    trial: Trial | None = None
    pulls: int = 0


class MacroLanes:
    """Runs searches side by side, one rope each.

    Attributes:
        simulation: the ropes.
        spent: actions simulated so far.
    """

    def __init__(
        self, count: int, config: MacroActionConfig, rope: Rope | None = None, threads: int = 1
    ) -> None:
        self.simulation = ChainSimulation(count, rope, threads)
        self.spent = 0
        self._config = config
        self._controller = WaypointController(count, config)

    def run(self, searches: Iterable[Search[Result]]) -> Iterator[tuple[int, Result]]:
        """Yield the number of each search and what it returns, as they end."""
        waiting = enumerate(searches)
        free = list(range(self.simulation.count))
        lanes: dict[int, _Lane[Result]] = {}
        while True:
            while free and (item := next(waiting, None)) is not None:
                index = free.pop(0)
                lanes[index] = _Lane(*item)
                yield from self._go_on(index, None, lanes, free)
            if not lanes:
                return
            ids = np.array(sorted(lanes))
            stable = self._pull(ids)
            codes = label_many(self.simulation.points[ids])
            idle = self._controller.idle
            for row, index in enumerate(ids.tolist()):
                lane = lanes[index]
                assert lane.trial is not None
                lane.pulls += 1
                reached = codes[row].matches(lane.trial.goal)
                bound = lane.trial.bound
                towed = bound is not None and bound.exceeded(self.simulation.points[[index]])[0]
                over = idle[index] or lane.pulls >= lane.trial.pulls
                if over or reached or towed or not stable[row]:
                    outcome = self._outcome(index, codes[row], lane.pulls, bool(towed))
                    yield from self._go_on(index, outcome, lanes, free)

    def at_rest(self, qpos: Array) -> tuple[Array, Array]:
        """States and points, float64 (n, beads, 3), of ropes laid at qpos (n, nq); n lanes."""
        ids = np.arange(len(qpos))
        self.simulation.lay(qpos, ids)
        return self.simulation.states(ids), self.simulation.points[ids]

    def _pull(self, ids: np.ndarray) -> np.ndarray:
        """Take one action in each lane of `ids`; return which ropes stayed finite."""
        simulation, controller = self.simulation, self._controller
        forces = controller.forces(simulation.points)[ids] * simulation.max_force
        stable = simulation.step(controller.beads[ids], forces, ids)
        self.spent += len(ids)
        controller.advance(simulation.points)
        return stable

    def _go_on(
        self,
        index: int,
        outcome: Landing | None,
        lanes: dict[int, _Lane[Result]],
        free: list[int],
    ) -> Iterator[tuple[int, Result]]:
        """Send a lane's search an outcome, until a trial takes an action or the search ends."""
        lane, controller = lanes[index], self._controller
        while True:
            try:
                trial = next(lane.search) if outcome is None else lane.search.send(outcome)
            except StopIteration as stop:
                del lanes[index]
                free.append(index)
                yield lane.number, stop.value
                return
            self.simulation.restore(trial.state[None], [index])
            points = self.simulation.points[index]
            controller.begin(index, pass_straight(points, *trial.move, self._config), points)
            lane.trial, lane.pulls = trial, 0
            if trial.pulls > 0 and not controller.idle[index]:
                return
            outcome = self._outcome(index, label_many(points[None])[0], 0)

    def _outcome(self, index: int, code: GaussCode, pulls: int, towed: bool = False) -> Landing:
        state = self.simulation.at_rest([index])[0]
        return Landing(state, self.simulation.points[index].copy(), code, pulls, towed)
