"""Many searches side by side, on the ropes of one chain simulation.

The chain engine steps a hundred ropes in little more time than eight. A search that tries one thing
after another can't use that alone, so searches share the ropes. A search is a generator with so
many *slots*, each a rope of its own. It yields `Orders`: what to try in which slots; slots without
an order go on with theirs. It is sent what became of its trials, in the order of its slots. What a
search finds doesn't depend on its company.

After a change run `pytest tests/control/planning/test_batched_search.py`: what a search finds must
not depend on its company.
"""

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids
from knotgym.rope import (
    ActionView,
    ChainSimulation,
    Haul,
    MacroAction,
    Pass,
    Rope,
    TowBound,
    WaypointFollower,
)
from knotgym.topology import GaussCode, label_many

Result = TypeVar("Result")
LONGEST = ActionView.LONGEST
_NEVER = 1 << 30


class Trial(NamedTuple):
    """What to try from a state.

    Attributes:
        state: of the chain engine.
        move: it ends with its last waypoint; a haul with its last pull.
        pulls: most pulls that it may take.
        goal: compared without chirality; where it is shown, a trial that isn't watched is over.
        bound: region in which the rope's centre must stay; None for no limit.
        watch: report every change of code; otherwise only the end is reported.
    """

    state: Array
    move: Pass | MacroAction | Haul
    pulls: int
    goal: GaussCode
    bound: TowBound | None = None
    watch: bool = False


class Report(NamedTuple):
    """What became of a trial.

    Attributes:
        state: of the chain engine, now.
        points: float64 (beads, 3), metres.
        code: with chirality.
        pulls: taken so far.
        over: whether the trial has ended.
        lost: whether it ended because the simulation blew up or the rope left its bound.
        beads, forces: the pulls, int64 (pulls,) and float32 (pulls, 3) in units of the largest
            force; empty if the trial isn't watched.
    """

    state: Array
    points: Array
    code: GaussCode
    pulls: int
    over: bool
    lost: bool
    beads: NDArray[np.int64]
    forces: NDArray[np.float32]


class Orders(NamedTuple):
    """Trials by slot. The search is sent reports when one has news, or after `wake` pulls."""

    trials: dict[int, Trial]
    wake: int = _NEVER


Reports = tuple[int, list[tuple[int, Report]]]  # pulls since the orders; reports with their slots
Search = Generator[Orders, Reports, Result]


@dataclass(eq=False)
class _Job:
    """A search and the ropes that are its slots."""

    key: Any
    search: Search[Any]
    ropes: list[int]
    wake: int = _NEVER
    pulls: int = 0  # since the last orders


@dataclass(eq=False)
class _Lane:
    """A rope's trial, with the code last seen, how many pulls it took, and, if watched, which."""

    trial: Trial
    code: GaussCode
    pulls: int = 0
    lost: bool = False
    beads: list[int] = field(default_factory=list)
    forces: list[NDArray[np.float32]] = field(default_factory=list)


class BatchedSearch:
    """Runs searches side by side.

    Attributes:
        ropes: the simulation.
    """

    def __init__(self, count: int, rope: Rope | None = None) -> None:
        """Make `count` ropes to search in."""
        self.ropes = ChainSimulation(count, rope)
        self._follower = WaypointFollower(count)
        self._lanes, self._going = dict[int, _Lane](), set[int]()  # by rope; ropes under way
        self._free, self._jobs = [*range(count)], dict[int, _Job]()  # jobs by their ropes
        self._waiting = deque[tuple[Any, int, Search[Any]]]()

    def add(self, key: Any, search: Search[Any], slots: int = 1) -> None:
        """Queue a search; `tick` will return its key and result."""
        self._waiting.append((key, slots, search))

    def run(
        self, searches: Iterable[Search[Result]], slots: int = 1
    ) -> Iterator[tuple[int, Result]]:
        """Run searches to their ends; yield the number and result of each as it ends."""
        waiting = enumerate(searches)
        while True:
            # No more are drawn from the iterable than could begin at once: each holds the state
            # that it starts from.
            while len(self._waiting) < self.ropes.count and (item := next(waiting, None)):
                self.add(*item, slots)
            if not self._waiting and not self._jobs:
                return
            yield from self.tick()

    @staticmethod
    def try_pass(
        state: Array, move: Pass, goal: GaussCode, pulls: int = LONGEST, bound: Any = None
    ) -> Search[Report]:
        """Try a pass and return where it led; the arguments are those of `Trial`."""
        _, ((_, landing),) = yield Orders({0: Trial(state, move, min(LONGEST, pulls), goal, bound)})
        return landing

    def tick(self) -> list[tuple[Any, Any]]:
        """Begin searches that have room, take a pull in every slot; return keys and results."""
        new = list[tuple[_Job, Reports | None]]()
        # In the order in which they came, even if a later one would fit: which runs when changes
        # only the time, never a result.
        while self._waiting and len(self._free) >= self._waiting[0][1]:
            key, slots, search = self._waiting.popleft()
            job = _Job(key, search, [self._free.pop() for _ in range(slots)])
            self._jobs |= dict.fromkeys(job.ropes, job)
            new.append((job, None))
        ended = self._go_on(new)
        if self._going:
            news = self._pull(np.array(sorted(self._going)))
            jobs = [*dict.fromkeys(self._jobs.values())]
            for job in jobs:
                job.pulls += 1
            due = [rope for job in jobs if job.pulls >= job.wake for rope in job.ropes[:1]]
            # all reports come before any search goes on, which may change the ropes
            ended += self._go_on(self._reports(news, due))
        return ended

    def drop(self, key: Any) -> None:
        """Forget a search that is queued or under way."""
        self._waiting = deque(queued for queued in self._waiting if queued[0] != key)
        for job in {job for job in self._jobs.values() if job.key == key}:
            self._leave(job)

    def _go_on(self, woken: list[tuple[_Job, Reports | None]]) -> list[tuple[Any, Any]]:
        """Send reports to searches, until each wants a pull to be taken, or ends."""
        ended = []
        while woken:
            begun = dict[int, Trial]()
            for job, reports in woken:
                try:
                    # The first thing sent to a generator must be None; after that, what became of
                    # its trials.
                    orders = job.search.send(reports)  # type: ignore[arg-type]
                except StopIteration as end:
                    self._leave(job)
                    ended.append((job.key, end.value))
                else:
                    job.wake, job.pulls = orders.wake, 0
                    begun |= {job.ropes[slot]: trial for slot, trial in orders.trials.items()}
            # Trials that are over without a pull are reported at once, so that no search waits a
            # tick for nothing.
            woken = self._reports(self._begin(begun), []) if begun else []
        return ended

    def _leave(self, job: _Job) -> None:
        self._going.difference_update(job.ropes)
        self._free += job.ropes
        for rope in job.ropes:
            del self._jobs[rope]

    def _begin(self, begun: dict[int, Trial]) -> list[int]:
        """Begin trials, by rope; return those that are over without a pull."""
        ropes, follower = self.ropes, self._follower
        ids = np.array(sorted(begun))
        trials = [begun[rope] for rope in ids.tolist()]
        # all that begin together, as one rope alone takes nearly as long as many
        ropes.restore(np.array([trial.state for trial in trials]), ids)
        passes = {rope: trial.move for rope, trial in begun.items() if isinstance(trial.move, Pass)}
        if passes:
            follower.begin_passes(np.array([*passes]), [*passes.values()], ropes.points)
        codes = label_many(ropes.points[ids])
        for rope, trial, code in zip(ids.tolist(), trials, codes, strict=True):
            if isinstance(trial.move, MacroAction):
                follower.begin(np.array([rope]), [trial.move])
            self._lanes[rope] = _Lane(trial, code)
        follower.release(ids[[isinstance(trial.move, Haul) for trial in trials]])
        # A bead may be at all of its waypoints already. A watched trial ends by a pull at the
        # earliest, as its report holds the pulls.
        arrived = zip(ids.tolist(), trials, follower.arrive(ropes.points, ids), strict=True)
        over = [rope for rope, trial, at in arrived if (at or trial.pulls < 1) and not trial.watch]
        self._going |= {*ids.tolist()} - {*over}
        return over

    def _pull(self, ids: Ids) -> list[int]:
        """Pull all ropes that are under way; return those with news."""
        ropes, follower = self.ropes, self._follower
        beads, forces = follower.beads[ids], follower.forces(ropes.points, ids)
        lanes = [self._lanes[rope] for rope in ids.tolist()]
        for row, lane in enumerate(lanes):
            # hauls pull two beads in turn, so no waypoint leads them
            if isinstance(lane.trial.move, Haul):
                beads[row], forces[row] = lane.trial.move.pull(lane.pulls)
        stable = ropes.step(beads, forces.astype(np.float64) * ropes.max_force, ids).tolist()
        arrived, points = follower.arrive(ropes.points, ids).tolist(), ropes.points[ids]
        news = list[int]()
        for row, (rope, code) in enumerate(zip(ids.tolist(), label_many(points), strict=True)):
            lane, trial = lanes[row], lanes[row].trial
            lane.pulls += 1
            lane.lost = not stable[row]
            if trial.bound is not None:
                lane.lost |= bool(trial.bound.exceeded(points[[row]])[0])
            over = lane.lost or lane.pulls >= trial.pulls
            over |= arrived[row] and not isinstance(trial.move, Haul)
            if trial.watch:
                lane.beads.append(int(beads[row]))
                lane.forces.append(forces[row])
            else:
                # only where the goal is shown does anybody want to know before the end
                over |= code.visits == trial.goal.visits
            if over or (trial.watch and code != lane.code):
                news.append(rope)
            if over:
                self._going.remove(rope)
            lane.code = code
        return news

    def _reports(self, news: list[int], due: list[int]) -> list[tuple[_Job, Reports | None]]:
        """Reports on ropes with news, by their searches; empty ones for searches that are due."""
        ropes, told = self.ropes, dict[int, Report]()
        for rope, state in zip(news, ropes.states(news) if news else (), strict=True):
            lane, points = self._lanes[rope], ropes.points[rope].copy()
            facts = lane.pulls, rope not in self._going, lane.lost
            forces = np.array(lane.forces, np.float32).reshape(-1, 3)
            beads = np.array(lane.beads, np.int64)
            told[rope] = Report(state, points, lane.code, *facts, beads, forces)
        # each search once, however many of its ropes have news
        woken = [*dict.fromkeys(self._jobs[rope] for rope in (*news, *due))]
        return [
            (job, (job.pulls, [(k, told[r]) for k, r in enumerate(job.ropes) if r in told]))
            for job in woken
        ]
