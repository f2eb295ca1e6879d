"""Plan pulls: the search of the policy `planner`.

This is a best-first search with random choices. A pool holds the states met so far, grouped by
code. Each iteration picks a state from the pool, preferring codes that are near the goal (see
`Guide`), and applies one macro-action to it, on several ropes side by side. The macro-action is
random or like a pass of the expert's table. Ropes with many crossings may be hauled instead. Every
state with a new code joins the pool.

Plans are made in the chain engine, some forty times as fast as MuJoCo, and acted out once in the
engine that counts. Where the two part, the search goes on from the state nearest to the goal that
was reached there, or begins again. Engines are deterministic, bit for bit, so what was checked
holds.

After a change run `pytest tests/control/planning`, and what `planners` says with `--policy
planner`: all episodes of nx 2 and 3 must succeed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array
from knotgym.control.planning.batched_search import Orders, Report, Search, Trial
from knotgym.control.planning.passes import PassValues
from knotgym.control.planning.sights import Sight, first_goal
from knotgym.control.policy_config import PullPlannerConfig
from knotgym.rope import Haul, MacroAction, Simulation, TowBound
from knotgym.topology import GaussCode, images, label

# Hauls, tried on the hard unknots of notes/drawing.md: without them 0 of 64 Culprits came undone.
# Other values of these six numbers weren't measured.
_HARD_NX = 7  # they are allowed from so many crossings on, where guidance knows very little
_HAULED_NX = 3  # a hard rope is hauled only from states of at least this many crossings
_HAULS = 0.6  # share of a hard rope's macro-actions that are hauls
_FAILURES = 2  # plans from one state that may lead no nearer to the goal, until it begins again
# The next ten were set by hand when the planner was written, and no record says what others gave.
# They decide what is tried first, so another value finds other plans, with more or fewer simulated
# pulls, and recorded episodes of `planner` no longer repeat. None can make a plan wrong, as each is
# acted out before it counts. Half and twice the first two: of 24 ties of nx 3 in the chain engine
# all are solved, with 687 to 818 simulated pulls an episode; 931 with these.
_GREED = 4.0  # exponent of the preference for codes near the goal
_STRIDE = 6.0  # pulls that a change of code is expected to take
_LEAST_STRIDE = 2  # and takes at least: a state too late for that is dropped
_UNKNOWN_HOPS = 2  # changes of code to the goal where no path is known
_PATIENCE = 10.0  # delay, in pulls, that makes a state e times less likely to be chosen
_WEARINESS = 10.0  # macro-actions from a code that halve its probability to be chosen again
_KEPT = 6  # states of a code, at most
_TRY_COST = 2.0  # pulls that each try of a state counts for when the worst one is dropped
_STUCK = 24  # macro-actions from a code after which other configurations that show it are kept, too
_LONGEST = 10  # pulls of a macro-action, at most
# Pulls simulated for the first plan; twice as many after each from the root that finds none. One
# of more than so many begins again, as other draws may do better.
_LOOK, _LONGEST_LOOK = 4000, 20_000
# Guidance, tried at tie nx 3 in the chain, 64 episodes, all solved: 544 pulls simulated for an
# episode; 685 with 20 passes for the second, 735 with twice the third. A first of 1 would never
# leave a code for which the table knows only passes that fail.
_GUIDED = 0.8  # share of macro-actions that are passes of the table, where it has any
_BEST = 8  # passes of a rope that are drawn from, by what they are worth
_UNIT = 10.0  # distance at which the chance to reach the goal is 1 / e
# Where no way is known, only the order counts: what codes of so many crossings are farther by.
_STRANGE = 30.0
_GOALS_KEPT = 128  # goals whose distances are kept, a megabyte or two each


class Guide:
    """Distances from codes to one goal, and macro-actions towards it.

    The table says how likely passes lead from a diagram to a goal. The planner of pulls knows codes
    alone, so a code stands for that of its diagrams from which the chance is highest. Chances
    multiply along a way, so minus their logarithms add up, as distances do. A code from which no
    way is known counts as farther than all from which one is, and the farther the more crossings
    differ.
    """

    def __init__(self, values: PassValues, goal: GaussCode) -> None:
        """Take the table and a goal, which is compared without chirality."""
        self._values, self._goal = values, goal
        first, self._image = first_goal(goal)
        chances = values.chances(first)
        self._best = dict[GaussCode, float]()
        for node, index in values.moves.index.items():
            self._best[node.code] = max(self._best.get(node.code, 0.0), float(chances[index]))
        known = [chance for chance in self._best.values() if chance > 0]
        self._farthest = _UNIT * -math.log(min(known, default=1.0))

    def distance(self, code: GaussCode) -> float:
        """The distance from a code with chirality to the goal, at least 0."""
        chance = self._chance(code)
        if chance:
            return _UNIT * -math.log(chance)
        return self._farthest + _STRANGE * max(1, abs(code.nx - self._goal.nx))

    def hops(self, code: GaussCode, unknown: int) -> int:
        """About how many passes lead to the goal, if each works half the time."""
        chance = self._chance(code)
        if chance == 1.0:
            return 0
        return max(1, round(-math.log2(chance))) if chance else unknown

    def propose(self, points: Array, rng: np.random.Generator) -> MacroAction:
        """Draw a macro-action for a rope: like one of the table's passes, or any.

        Args:
            points: float64 (beads, 3), metres: where the rope lies.
            rng: source of all draws.
        """
        if rng.random() < _GUIDED:
            (sight,) = Sight.of(points[None])
            moves = [*islice(self._values.passes(self._goal, sight), _BEST)]
            if moves:
                move, _ = moves[_drawn_index(np.array([worth for _, worth in moves]), rng)]
                return MacroAction.passing(points, move, rng)
        return MacroAction.drawn(points, rng)

    def _chance(self, code: GaussCode) -> float:
        """The chance to reach the goal; 0 if none is known, 1 if the code is the goal's."""
        if code.matches(self._goal):
            return 1.0
        return self._best.get(_image_of(code, self._image), 0.0)


@lru_cache(maxsize=100_000)
def _image_of(code: GaussCode, number: int) -> GaussCode:
    return images(code)[number]


@lru_cache(maxsize=_GOALS_KEPT)
def _guide_to(goal: GaussCode, values: PassValues) -> Guide:
    """Return the guide to a goal, which is given without chirality."""
    return Guide(values, goal)


@dataclass(eq=False)
class _Node:
    """A state in a tree of states.

    Attributes:
        state, points, code: where it is.
        steps: pulls from the root to here.
        before: its parent; None at the root.
        beads, forces: the pulls from there.
        tries: macro-actions that began here.
    """

    state: Array
    points: Array
    code: GaussCode
    steps: int = 0
    before: _Node | None = None
    beads: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    forces: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    tries: int = 0


class PullPlan(NamedTuple):
    """Pulls to a goal, or to the state nearest to it.

    Attributes:
        beads, forces: int64 (T,) and float32 (T, 3), in units of the largest force.
        solved: whether the goal is reached.
        spent: pulls simulated to find them.
    """

    beads: NDArray[np.int64]
    forces: NDArray[np.float32]
    solved: bool
    spent: int


@dataclass(eq=False)
class _Met:
    """A code that was met.

    Attributes:
        distance: to the goal.
        left: estimated pulls to the goal.
        length: estimated pulls of an episode through it.
        weight: that it has when a code is drawn.
        nodes: states that show it.
        tries: macro-actions from states of the code.
    """

    distance: float
    left: float
    length: float = 0.0
    weight: float = 0.0
    nodes: list[_Node] = field(default_factory=list)
    tries: int = 0


class _Pool:
    """The states met so far, grouped by code.

    Attributes:
        met: the codes, in the order in which they were met.
    """

    def __init__(self, guide: Guide, nx_as_hops: bool) -> None:
        """Take a guide, and whether crossings stand for hops that aren't known."""
        self._guide, self._nx_as_hops = guide, nx_as_hops
        self.met = dict[GaussCode, _Met]()
        self._shortest = math.inf  # of the lengths

    def add(self, node: _Node, most: float = math.inf) -> None:
        """Add a state, unless the goal can't be reached through it within `most` pulls.

        If its code now has too many states, drop the one latest and tried most often.
        """
        code = node.code
        hops = self._guide.hops(code, code.nx if self._nx_as_hops else _UNKNOWN_HOPS)
        # optimistic: every change of code that is left takes the fewest pulls it can
        if node.steps + _LEAST_STRIDE * hops > most:
            return
        if code not in self.met:
            self.met[code] = _Met(self._guide.distance(code), _STRIDE * hops)
        met = self.met[code]
        met.nodes.append(node)
        if len(met.nodes) > _KEPT:
            met.nodes.remove(max(met.nodes, key=lambda node: node.steps + _TRY_COST * node.tries))
        # computed again, since the state dropped may have been the earliest
        met.length = min(node.steps for node in met.nodes) + met.left
        self._weigh(met)

    def _weigh(self, met: _Met) -> None:
        """Set a code's weight again."""
        # It falls with the distance to the goal (greed), with how often it was tried (weariness),
        # and with the estimated length of an episode through it (patience). Lengths are compared to
        # the shortest one, which keeps the exponentials from underflowing.
        # Python's powers and exponentials, because NumPy's round by processor.
        worth = (1 + met.distance) ** -_GREED / (1 + met.tries / _WEARINESS)
        met.weight = worth * math.exp((self._shortest - met.length) / _PATIENCE)

    def choose(self, rng: np.random.Generator) -> _Node:
        """Draw a code, then a state that shows it, and count the try."""
        every = [*self.met.values()]
        if (shortest := min(met.length for met in every)) != self._shortest:
            self._shortest = shortest
            for met in every:
                self._weigh(met)
        met = every[_drawn_index(np.array([met.weight for met in every]), rng)]
        # among the code's states: early ones, and ones tried less often
        fresh = [math.exp(-node.steps / _PATIENCE) / (1 + node.tries) for node in met.nodes]
        node = met.nodes[_drawn_index(np.array(fresh), rng)]
        node.tries, met.tries = node.tries + 1, met.tries + 1
        self._weigh(met)
        return node

    def nearest(self) -> _Node:
        """The state nearest to the goal; of these the earliest."""
        every = (node for met in self.met.values() for node in met.nodes)
        return min(every, key=lambda node: (self._guide.distance(node.code), node.steps))


@dataclass(eq=False)
class PullSearch:
    """A search for pulls to a goal; it takes `config.batch_size` slots, see `BatchedSearch`.

    Attributes:
        goal: compared without chirality.
        values: the table of passes; an empty one guides by numbers of crossings alone.
        config: settings.
        rng: source of all random choices.
        hold: number of consecutive states that must show the goal.
        bound: region in which the rope's centre must stay; None for no limit.
    """

    goal: GaussCode
    values: PassValues
    config: PullPlannerConfig
    rng: np.random.Generator
    hold: int = 1
    bound: TowBound | None = None

    def checked(
        self,
        check: Simulation,
        in_chain: Callable[[Simulation], tuple[Array, Array]],
        state: Array,
        steps: int,
        budget: int,
    ) -> Search[PullPlan]:
        """Find pulls that were acted out in the engine that counts.

        Args:
            check: one rope of that engine; overwritten, also between the trials of this search.
            in_chain: from it, its state in the chain engine, and its points (1, beads, 3).
            state: of that rope, to start from.
            steps: most pulls of the plan.
            budget: most pulls to simulate, of both engines.
        """
        check.restore(state[None])
        root = here = best = _node_of(check)
        far = _guide_to(self.goal.plain, self.values).distance
        spent, failures, look, most = 0, 0, _LOOK, self.config.batch_size
        while spent + most <= budget and steps > 0:
            check.restore(here.state[None])
            left = min(look, budget - spent)
            (chain_state,), (points,) = in_chain(check)
            made = yield from self.plan(chain_state, points, steps - here.steps, left)
            spent += made.spent
            if not made.solved and spent + most <= budget:
                # too few pulls are left from here, or the goal is hard to find
                look = look if here.steps else min(2 * look, _LONGEST_LOOK)
                here, failures = root, 0
                continue
            nodes, solved = self._act_out(check, here, made, steps - here.steps)
            spent += len(nodes)
            if solved:
                return _plan_to(nodes[-1], True, spent)
            nearest = min(nodes, key=lambda node: (far(node.code), node.steps), default=here)
            best = min(best, nearest, key=lambda node: (far(node.code), node.steps))
            nearer = far(nearest.code) < far(here.code)
            here, failures = (nearest, 0) if nearer else (here, failures + 1)
            if failures == _FAILURES or here.steps + _LEAST_STRIDE > steps:
                here, failures = root, 0
        return _plan_to(best, False, spent)

    def plan(self, state: Array, points: Array, steps: int, budget: int) -> Search[PullPlan]:
        """Find pulls in the chain engine alone, to the goal or else to the state nearest to it.

        Args:
            state, points: of the chain engine: where the rope lies.
            steps, budget: as of `checked`.
        """
        goal, rng, count = self.goal, self.rng, self.config.batch_size
        root = _Node(state, points, label(points))
        guide = _guide_to(goal.plain, self.values)
        far = guide.distance
        # Hauls take crossings out. Where they are allowed few paths are known, and each crossing is
        # taken for a change of code to go.
        hauling = root.code.nx >= _HARD_NX and root.code.nx > goal.nx
        pool = _Pool(guide, hauling)
        pool.add(root)
        # by slot: where its macro-action began, the code seen last
        begun, shown, spent = dict[int, _Node](), dict[int, GaussCode](), 0
        trials: dict[int, Trial] = {}

        def _begin(slot: int) -> None:
            """Choose a state and a macro-action."""
            at = begun[slot] = pool.choose(rng)
            move: MacroAction | Haul
            if hauling and at.code.nx >= _HAULED_NX and rng.random() < _HAULS:
                move = Haul.drawn(len(at.points), rng)
                longest = move.steps
            else:
                move, longest = guide.propose(at.points, rng), _LONGEST
            pulls, shown[slot] = max(1, min(longest, steps - at.steps)), at.code
            trials[slot] = Trial(at.state, move, pulls, goal, self.bound, watch=True)

        def _is_worth_keeping(slot: int, report: Report) -> bool:
            """Tell whether a state should join the pool.

            States at which the code changes do, and so do the ends of macro-actions. But an end
            with the code that it began with is kept only if that code is stuck: then another
            configuration with the same code may be a better start. Along a haul, only states nearer
            to the goal than its start are kept.
            """
            at, code = begun[slot], report.code
            if isinstance(trials[slot].move, Haul):
                return report.over or far(code) < far(at.code)
            if code != shown[slot]:
                return True
            return report.over and (pool.met[at.code].tries > _STUCK or code != at.code)

        while spent + count <= budget and steps > 0:
            free = [slot for slot in range(count) if slot not in begun]
            for slot in free:
                _begin(slot)
            orders = Orders({slot: trials[slot] for slot in free}, (budget - spent) // count)
            ticks, reports = yield orders
            spent += ticks * count
            for slot, report in reports:
                at, over = begun[slot], report.over
                # lost: unstable, or out of bounds; nothing from there on is of use
                if not report.lost and _is_worth_keeping(slot, report):
                    node = _Node(*report[:3], at.steps + report.pulls, at, *report[-2:])
                    if node.code.matches(goal):
                        return _plan_to(node, True, spent)
                    pool.add(node, steps)
                    # progress is worth a fresh choice rather than the rest of this macro-action
                    over |= far(node.code) < far(at.code)
                shown[slot] = report.code
                if over:
                    del begun[slot]
        return _plan_to(pool.nearest(), False, spent)

    def _act_out(
        self, check: Simulation, here: _Node, made: PullPlan, steps: int
    ) -> tuple[list[_Node], bool]:
        """Act a plan out, until it shows the goal or has had `steps` pulls.

        Returns the states on the way, and whether the last `hold` of them show the goal.
        """
        check.restore(here.state[None])
        nodes, shown = list[_Node](), 0
        while shown < self.hold and len(nodes) < (steps if shown else min(steps, len(made.beads))):
            bead, force = np.zeros(1, np.int64), np.zeros((1, 3), np.float32)  # a rest
            if not shown:
                at = slice(len(nodes), len(nodes) + 1)
                bead, force = made.beads[at], made.forces[at]
            stable = check.step(bead, force.astype(np.float64) * check.max_force)[0]
            if not stable or (self.bound is not None and self.bound.exceeded(check.points)[0]):
                break
            here = _node_of(check, here, bead, force)
            shown = shown + 1 if here.code.matches(self.goal) else 0
            nodes.append(here)
        return nodes, shown == self.hold


def _node_of(check: Simulation, before: _Node | None = None, *pull: NDArray[np.generic]) -> _Node:
    """The state of a simulation of one rope, after a pull."""
    points, steps = check.points[0].copy(), before.steps + 1 if before else 0
    return _Node(check.states()[0], points, label(points), steps, before, *pull)  # type: ignore[arg-type]


def _plan_to(node: _Node, solved: bool, spent: int) -> PullPlan:
    """Collect the pulls from the root to a node, following the parents back."""
    line: list[_Node] = [node]
    while line[-1].before is not None:
        line.append(line[-1].before)
    pulls = [node.beads for node in line[::-1]], [node.forces for node in line[::-1]]
    return PullPlan(np.concatenate(pulls[0]), np.concatenate(pulls[1]), solved, spent)


def _drawn_index(weights: Array, rng: np.random.Generator) -> int:
    """Draw an index with probability proportional to its weight."""
    # `Generator.choice` draws the same index from the same number of the stream, but its checks of
    # the arguments take far longer.
    shares = (weights / weights.sum()).cumsum()
    # divided again, as `choice` does: rounding may leave the last sum a little off 1
    return int((shares / shares[-1]).searchsorted(rng.random(), side="right"))
