"""Macro-actions on many ropes at once, in the lanes of one chain simulation.

The chain engine steps 64 ropes in little more time than a few. A search that tries one macro-action
after another can't use that alone, so hundreds of searches run side by side: each is a generator
that yields a `Trial` and is sent its `Outcome`. What a search finds doesn't depend on its company.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from typing import NamedTuple, TypeVar

import numpy as np

from knotgym.rope.actions import quantized
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.rope.macro_actions import MacroActionConfig, WaypointController, pass_straight
from knotgym.rope.model import Array, Rope
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

LONGEST = 10  # pulls of a macro-action at most
Result = TypeVar("Result")


class Pass(NamedTuple):
    """A macro-action without chance: lead `bead` over (+1) or under (-1) the bead `target`."""

    bead: int
    target: int
    side: int


class Trial(NamedTuple):
    """A macro-action to try from a state of the chain engine, for at most `pulls` actions."""

    state: Array
    move: Pass
    pulls: int = LONGEST


class Outcome(NamedTuple):
    """Where a trial ended: at the first change of code, or with the macro-action.

    Attributes:
        state: at rest, float64 (states,).
        points: float64 (beads, 3), metres.
        code: with chirality.
        pulls: actions taken.
    """

    state: Array
    points: Array
    code: GaussCode
    pulls: int


Search = Generator[Trial, Outcome, Result]


class MacroLanes:
    """Runs searches side by side, one rope each."""

    def __init__(
        self, count: int, config: MacroActionConfig, rope: Rope | None = None, threads: int = 1
    ) -> None:
        self.simulation = ChainSimulation(count, rope, threads)
        self._config = config
        self._controller = WaypointController(count, config)
        self.spent = 0  # actions simulated

    def run(self, searches: Iterable[Search[Result]]) -> Iterator[tuple[int, Result]]:
        """Yield the number of each search and what it returns, as they end."""
        waiting = enumerate(searches)
        lanes: dict[int, tuple[int, Search[Result]]] = {}
        free = list(range(self.simulation.count))[::-1]
        pulls = np.zeros(self.simulation.count, dtype=np.int64)
        limits = pulls.copy()
        codes: dict[int, GaussCode] = {}

        def resume(lane: int, outcome: Outcome | None) -> tuple[int, Result] | None:
            """Go on with a lane's search until a trial needs an action, or the search ends."""
            number, search = lanes[lane]
            try:
                while True:
                    trial = next(search) if outcome is None else search.send(outcome)
                    self.simulation.restore(trial.state[None], [lane])
                    points = self.simulation.points[lane]
                    self._controller.begin(lane, pass_straight(points, *trial.move, self._config))
                    self._controller.advance_one(lane, points)
                    codes[lane] = label_many(points[None])[0]
                    pulls[lane], limits[lane] = 0, trial.pulls
                    if not self._controller.idle[lane] and trial.pulls > 0:
                        return None
                    outcome = self._outcome(lane, codes[lane], 0)
            except StopIteration as stop:
                del lanes[lane]
                free.append(lane)
                return number, stop.value

        while True:
            while free:
                try:
                    item = next(waiting)
                except StopIteration:
                    break
                lane = free.pop()
                lanes[lane] = item
                ended = resume(lane, None)
                if ended is not None:
                    yield ended
            if not lanes:
                return
            ids = np.array(sorted(lanes))
            simulation = self.simulation
            forces = quantized(self._controller.forces(simulation.points)[ids])
            stable = simulation.step(
                self._controller.beads[ids], forces * simulation.max_force, ids
            )
            self.spent += len(ids)
            pulls[ids] += 1
            self._controller.advance(simulation.points)
            over = self._controller.idle | (pulls >= limits)
            shown = label_many(simulation.points[ids])
            for row, lane in enumerate(ids.tolist()):
                if over[lane] or shown[row] != codes[lane] or not stable[row]:
                    outcome = self._outcome(lane, shown[row], int(pulls[lane]))
                    ended = resume(lane, outcome)
                    if ended is not None:
                        yield ended

    def _outcome(self, lane: int, code: GaussCode, pulls: int) -> Outcome:
        return Outcome(
            self.simulation.at_rest([lane])[0],
            self.simulation.points[lane].copy(),
            code,
            pulls,
        )
