"""The demonstrator: the same state and goal, the same macro-action.

At a state it goes through the passes that lead nearer to the goal, in one order for the diagram and
the goal (`pass_counts`), and takes the first that begins a way to the goal. Ways are found in the
chain engine, depth first, with the rope at rest at every choice. Each pass is acted out until its
end, the goal, or LONGEST pulls; then it searches again. So what it does is a function of where the
rope lies, which a network can learn; `planner` is a better player and a worse teacher.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import Count, Whole, configuration
from knotgym.control.expert import Expert
from knotgym.control.macro_lanes import Landing, MacroLanes, Search, Trial
from knotgym.control.pass_counts import DiagramValues, shipped_values, templates
from knotgym.control.planner import REST
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy import NO_MACRO, Choice, Effort, Policy
from knotgym.control.seen_diagrams import seen_diagram
from knotgym.control.transition_counts import ArcCoordinates
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import LONGEST, Pass, WaypointController, pass_straight
from knotgym.rope.model import Array
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode

PLANNER = "planner"  # first word of the reason for an action of the planner's
RANDOM = "random pass"  # reason for a pass that nobody chose
_LANES = 64  # ropes of the chain engine in which searches are simulated
_BOUNDED = 4  # times as many candidates where the rope's centre must stay in a region
_TOWING = 0.9  # share of the limit on towing that searches go to: engines differ a little
_CLOSE = 8  # fewest beads along the rope between the two of a random pass


@configuration
class DemonstratorConfig:
    """Settings of the demonstrator.

    Attributes:
        candidates: passes tried at a state, at most; four times as many where towing is limited.
        budget: actions simulated for a search, at most.
        steps: actions of a way, at most.
        last_resort: actions that the planner may simulate for an episode without a way.
        macro_actions: settings of the passes.
    """

    candidates: Count = 12
    budget: Count = 2000
    steps: Count = 50
    last_resort: Whole = 2000
    macro_actions: MacroActionConfig = MacroActionConfig()


class Decision(NamedTuple):
    """A pass on the way to a goal.

    Attributes:
        points: float64 (beads, 3), metres: where the rope lay at rest.
        code: with chirality.
        move: the pass.
        rank: number of passes tried there, this one included.
        landing: where it led.
    """

    points: Array
    code: GaussCode
    move: Pass
    rank: int
    landing: Landing


class Tried(NamedTuple):
    """A pass that a search simulated.

    Attributes:
        points: float64 (beads, 3), metres: where the rope lay at rest; the same array for all
            passes tried there.
        move: the pass.
    """

    points: Array
    move: Pass


class FoundWay(NamedTuple):
    """What a search found.

    Attributes:
        way: decisions on the way to the goal; empty if none was found.
        spent: actions simulated.
        tried: all passes simulated, also where they led into a dead end.
    """

    way: list[Decision]
    spent: int
    tried: list[Tried]


@dataclass(eq=False)
class _DepthFirst:
    """A depth-first search from one state.

    Attributes:
        values: order of the passes.
        goal: compared without chirality.
        config: settings.
        bound: region in which the rope's centre must stay; None for no limit.
        spent: actions simulated.
        tried: passes simulated.
    """

    values: DiagramValues
    goal: GaussCode
    config: DemonstratorConfig
    bound: TowBound | None
    spent: int = 0
    tried: list[Tried] = field(default_factory=list)

    def way(self, state: Array, points: Array, steps: int) -> Search[list[Decision] | None]:
        """Find the first way to the goal, depth first; None if there is none within the limits."""
        crossings = find_crossings(points)
        diagram = seen_diagram(points, crossings)
        # The chance that the goal can be reached from here, as counted; only passes that raise it
        # are followed, so a way never comes back to a diagram.
        here = self.values.reach(self.goal, diagram)
        # many passes tow the rope, and the order doesn't know which
        candidates = self.config.candidates * (1 if self.bound is None else _BOUNDED)
        ordered = islice(passes_in_order(self.values, self.goal, points), candidates)
        for rank, (move, _) in enumerate(ordered, 1):
            if self.spent >= self.config.budget:
                return None
            # A generator yields what it wants simulated, so that many searches share the lanes.
            pulls = min(LONGEST, steps)
            outcome: Landing = yield Trial(state, move, self.goal, pulls, self.bound)
            self.spent += outcome.pulls
            decision = Decision(points, diagram.code, move, rank, outcome)
            self.tried.append(Tried(points, move))
            # The goal may be shown before the pass is over, which then ends there; see `Trial`.
            if not outcome.towed and outcome.code.matches(self.goal):
                return [decision]
            left = steps - outcome.pulls
            if left > 0 and not outcome.towed and outcome.code != diagram.code:
                there = seen_diagram(outcome.points, find_crossings(outcome.points))
                if self.values.reach(self.goal, there) > here:
                    # Depth first: all ways through this landing come before the next pass from
                    # here.
                    rest = yield from self.way(outcome.state, outcome.points, left)
                    if rest is not None:
                        return [decision, *rest]
        return None


def passes_in_order(
    values: DiagramValues, goal: GaussCode, points: Array
) -> Iterator[tuple[Pass, float]]:
    """Yield the passes that lead a rope nearer to a goal, in their order, each once.

    Beside each stands what it is worth, in (0, 1]; see `DiagramValues`.
    """
    crossings = find_crossings(points)
    diagram = seen_diagram(points, crossings)
    arcs = ArcCoordinates(crossings, len(points))
    known: set[Pass] = set()
    for choice in values.order(goal, diagram):
        template = templates(diagram.nx)[choice.template]
        # Several templates may name the same two beads where arcs are short; and both beads may
        # be the same.
        move = template.on(arcs, choice.element, diagram.nx, len(points))
        if move not in known and move.bead != move.target:
            known.add(move)
            yield move, choice.value


def find_way(
    values: DiagramValues,
    goal: GaussCode,
    config: DemonstratorConfig,
    state: Array,
    points: Array,
    bound: TowBound | None = None,
) -> Search[FoundWay]:
    """Search for the demonstrator's way from a state at rest; see `MacroLanes.run`."""
    search = _DepthFirst(values, goal, config, bound)
    way = yield from search.way(state, points, config.steps)
    return FoundWay(way or [], search.spent, search.tried)


@dataclass(eq=False)
class _Acting:
    """The demonstrator's state in one episode.

    Attributes:
        move: the pass being acted out; None before a search.
        pulls: actions taken of it.
        why: the reason for it.
        taken_over: whether the planner acts until the end.
        effort: cost of the searches so far.
    """

    move: Pass | None = None
    pulls: int = 0
    why: str = ""
    taken_over: bool = False
    effort: Effort = Effort()


class Demonstrator(Policy):
    """Policy that leads every rope to its goal code.

    Where a search finds no way, the planner takes over until the episode ends. It says so in the
    reasons for its actions.
    """

    def __init__(
        self,
        config: DemonstratorConfig | None = None,
        planner: PlannerConfig | None = None,
        values: DiagramValues | None = None,
    ) -> None:
        """Take settings, those of the planner, and values; None for those that ship."""
        self.config = config or DemonstratorConfig()
        self._values = values
        planner = planner or PlannerConfig()
        # in the last resort the planner may simulate less than where it is the policy
        least = min(planner.budget, self.config.last_resort)
        self._planner = Expert(replace(planner, budget=least))
        self._progress: dict[int, _Acting] = {}
        self._controller = WaypointController(0, self.config.macro_actions)
        self._lanes: MacroLanes | None = None

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        if len(self._controller.beads) != episodes.count:
            self._controller = WaypointController(episodes.count, self.config.macro_actions)
        self._progress[index] = _Acting()
        self._planner.begin(episodes, index, rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        simulation, controller = episodes.simulation, self._controller
        # Waypoints that were reached are passed before anything is decided, so that a pass that
        # is over leads to a search in this very action.
        controller.advance(simulation.points)
        searching = [index for index in ids.tolist() if self._is_over(episodes, index)]
        # Searches depend on the rope alone, so how many are made together changes nothing.
        for first in range(0, len(searching), _LANES):
            self._search(episodes, np.array(searching[first : first + _LANES]))
        forces = controller.forces(simulation.points)[ids] * simulation.max_force
        actions = simulation.actions(controller.beads[ids], forces, ids)
        moves, macros = [], np.tile(NO_MACRO, (len(ids), 1))
        for row, index in enumerate(ids.tolist()):
            progress = self._progress[index]
            if progress.taken_over:
                chosen = self._planner.act(episodes, ids[[row]])
                actions[row], why = chosen.actions[0], f"{PLANNER} {chosen.moves[0]}"
            elif progress.move is None:
                # the goal is shown: a pull without force lets the rope settle
                actions[row] = simulation.actions([0], np.zeros((1, 3)), [index])[0]
                why = REST
            else:
                # what a dataset stores as `infos/macro_*`: whether a pass begins here, and which
                macros[row] = (progress.pulls == 0, *progress.move)
                progress.pulls += 1
                why = progress.why
            moves.append(why)
        return Choice(actions, moves, macros)

    def replan(self, index: int) -> None:
        """Look again before the next action."""
        progress = self._progress[index]
        progress.move, progress.taken_over = None, False
        self._planner.replan(index)

    def begin_with(self, episodes: EpisodeBatch, index: int, move: Pass) -> None:
        """Act out a pass of somebody else's choice before the first search."""
        self._start(episodes, index, move, RANDOM)

    def simplest(self, episodes: EpisodeBatch, index: int, passes: list[Pass]) -> Pass:
        """Return the first of the passes that leave an episode's rope with the fewest crossings."""
        assert self._lanes is not None  # a search came before
        goal = self.goal(episodes, index)
        (state,), _ = self._lanes.at_rest(episodes.simulation.qpos([index]))
        left = dict(self._lanes.run(_crossings_left(state, move, goal) for move in passes))
        return passes[min(left, key=lambda number: (left[number], number))]

    def goal(self, episodes: EpisodeBatch, index: int) -> GaussCode:
        """Return the goal code that an episode is led to."""
        return episodes.goals[index]

    def give_up(self, episodes: EpisodeBatch, index: int) -> None:
        """Go on after a search that found no way."""
        self._progress[index].taken_over = True
        self._controller.release(index)

    def name(self, index: int) -> str:
        return "expert"

    def effort(self, index: int) -> Effort:
        return self._progress[index].effort.plus(self._planner.effort(index))

    def _is_over(self, episodes: EpisodeBatch, index: int) -> bool:
        """Tell whether an episode needs a search; where the goal is shown, the rope rests."""
        progress = self._progress[index]
        if progress.taken_over:
            return False
        if episodes.codes[index].matches(self.goal(episodes, index)):
            progress.move = None
            return False
        over = progress.pulls >= LONGEST or bool(self._controller.idle[index])
        return progress.move is None or over

    def _bound(self, episodes: EpisodeBatch, index: int) -> TowBound | None:
        bound = episodes.tow_bound(index)
        return bound and replace(bound, limit=_TOWING * bound.limit)

    def _search(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> None:
        """Find the next pass of some episodes, side by side."""
        began = time.perf_counter()
        if self._lanes is None:
            rope = episodes.simulation.rope
            self._lanes = MacroLanes(_LANES, self.config.macro_actions, rope)
        values = self._values or shipped_values(episodes.config.split)
        # Searches begin from the rope at rest in the chain engine, whichever engine the episode
        # has: velocities fade within 20 ms, and a search must not depend on them.
        states, points = self._lanes.at_rest(episodes.simulation.qpos(ids))
        searches = [
            find_way(
                values,
                self.goal(episodes, index),
                self.config,
                states[row],
                points[row],
                self._bound(episodes, index),
            )
            for row, index in enumerate(ids.tolist())
        ]
        found = dict(self._lanes.run(searches))
        seconds = (time.perf_counter() - began) / len(ids)
        for row, index in enumerate(ids.tolist()):
            way, spent, _ = found[row]
            progress = self._progress[index]
            progress.effort = progress.effort.plus(Effort(spent, seconds))
            if way:
                self._start(episodes, index, way[0].move, f"choice {way[0].rank}")
            else:
                self.give_up(episodes, index)

    def _start(self, episodes: EpisodeBatch, index: int, move: Pass, why: str) -> None:
        progress, points = self._progress[index], episodes.simulation.points[index]
        progress.move, progress.pulls, progress.why = move, 0, why
        macro_action = pass_straight(points, *move, self.config.macro_actions)
        self._controller.begin(index, macro_action, points)


def _crossings_left(state: Array, move: Pass, goal: GaussCode) -> Search[int]:
    outcome = yield Trial(state, move, goal)
    return outcome.code.nx


def random_pass(beads: int, rng: np.random.Generator) -> Pass:
    """Draw a pass over or under any bead that isn't close along the rope."""
    bead, apart = int(rng.integers(beads)), int(rng.integers(_CLOSE, beads - _CLOSE + 1))
    return Pass(bead, (bead + apart) % beads, (-1, 1)[int(rng.integers(2))])
