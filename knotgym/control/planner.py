"""Planning in the simulator: steps that lead a rope from the very state it is in to a Gauss code.

A pool of states met is kept by their codes. Copies of the rope set out from states whose codes are
near the goal, as the transition graph tells, each through one macro-action: the most promising of
several whose surrogate rollouts are looked at, some of them like those that made a change towards
the goal before; or any. A rope of many crossings may be hauled instead. Every new code on the way
joins the pool. MuJoCo repeats itself bit for bit from an integration state, so a plan that reaches
the goal here reaches it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from knotgym.control.action_sequence import Ropes, step_ropes
from knotgym.control.guidance import Promises, Towards, most_promising
from knotgym.control.macro_actions import (
    Haul,
    WaypointController,
    cumulative_shares,
    propose,
    propose_haul,
)
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import Distances, TransitionGraph
from knotgym.rope.model import Array
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

REST = "rest"  # the kind of a step with no force, by which a code is held
HAUL = "haul"  # the kind of a haul's steps
HARD_NX = 7  # crossings from which a rope may be hauled: beyond them guidance knows next to nothing
HAULED_NX = 3  # crossings from which hauls set out, then; fewer are undone otherwise
HAULS = 0.6  # share of a hard rope's macro-actions that are hauls
ANEW = 20_000  # simulated actions after which a search begins anew: other draws may have more luck


@dataclass(eq=False)
class Node:
    """A state met.

    Attributes:
        state: integration state, float64.
        code: shown, with chirality.
        steps: from the state planned from.
        before: the node that the last macro-action set out from, None at the root.
        kind: of that macro-action.
        actions: of that macro-action up to here, float32 (k, 6).
        tries: macro-actions that set out from here.
    """

    state: Array
    code: GaussCode
    steps: int = 0
    before: Node | None = None
    kind: str = ""
    actions: tuple[NDArray[np.float32], ...] = ()
    tries: int = 0


@dataclass(frozen=True, eq=False)
class Plan:
    """T actions and why.

    Attributes:
        actions: float32 (T, 6).
        moves: the reason for each, as `reason`.
        solved: they end in the goal.
        spent: simulated actions that planning took.
    """

    actions: NDArray[np.float32]
    moves: tuple[str, ...]
    solved: bool
    spent: int


class _Pool:
    """States met, by their codes, and how promising it is to set out from each code."""

    def __init__(self, distances: Distances, config: PlannerConfig, *, nx_as_hops: bool) -> None:
        self._distances, self._config, self._nx_as_hops = distances, config, nx_as_hops
        self._rows: dict[GaussCode, int] = {}
        self._nodes: list[list[Node]] = []  # by row, as what follows
        self._far = np.empty(0)
        self._tries = np.empty(0, dtype=np.int64)
        self._earliest = np.empty(0, dtype=np.int64)
        self._left = np.empty(0)  # steps to the goal, about

    def __iter__(self) -> Iterator[Node]:
        return itertools.chain.from_iterable(self._nodes)

    def hops(self, code: GaussCode) -> int:
        """Changes of code from here to the goal, about."""
        self._distances(code)  # a code just met may get its hops now
        unknown = code.nx if self._nx_as_hops else self._config.unknown_hops
        return self._distances.hops.get(code, unknown)

    def add(self, node: Node) -> None:
        """Put a state in; of too many with one code the longest and most tried goes."""
        row = self._row(node.code)
        nodes = self._nodes[row]
        nodes.append(node)
        if len(nodes) > self._config.kept:
            cost = self._config.try_cost
            nodes.remove(max(nodes, key=lambda node: node.steps + cost * node.tries))
        self._earliest[row] = min([node.steps for node in nodes])

    def tries(self, code: GaussCode) -> int:
        """How often a state with this code was set out from."""
        return int(self._tries[self._rows[code]]) if code in self._rows else 0

    def choose(self, rng: np.random.Generator) -> Node:
        """Draw a code, near and early ones more often, then a state that shows it."""
        config = self._config
        late = self._earliest + self._left
        weights = (
            (1 + self._far) ** -config.greed
            / (1 + self._tries / config.weariness)
            * np.exp(-(late - late.min()) / config.patience)
        )
        row = _drawn(weights, rng)
        nodes = self._nodes[row]
        fresh = [np.exp(-node.steps / config.patience) / (1 + node.tries) for node in nodes]
        node = nodes[_drawn(np.array(fresh), rng)]
        node.tries += 1
        self._tries[row] += 1
        return node

    def _row(self, code: GaussCode) -> int:
        """The row of a code, which may be new."""
        if code not in self._rows:
            self._rows[code] = len(self._nodes)
            self._nodes.append([])
            self._far = np.append(self._far, self._distances(code))
            self._tries = np.append(self._tries, 0)
            self._earliest = np.append(self._earliest, 0)
            self._left = np.append(self._left, self._config.stride * self.hops(code))
        return self._rows[code]


@dataclass(eq=False)
class _Branch:
    """A copy of the rope under way from a node."""

    node: Node
    kind: str
    code: GaussCode
    haul: Haul | None = None
    actions: list[NDArray[np.float32]] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """From the state planned from."""
        return self.node.steps + len(self.actions)


def plan(
    simulation: Ropes,
    state: Array,
    goal: GaussCode,
    graph: TransitionGraph,
    config: PlannerConfig,
    rng: np.random.Generator,
    *,
    steps: int,
    hold: int = 1,
    budget: int | None = None,
    bound: TowBound | None = None,
    met: Callable[[Node], object] | None = None,
    hauling: bool = False,
) -> Plan:
    """Find steps that lead to the goal code.

    Args:
        simulation: at least `config.batch_size` ropes, whose states are overwritten.
        state: integration state to set out from.
        goal: compared without chirality.
        graph: knows distances; an empty one guides by crossings alone.
        config: how hard to try.
        rng: decides what is tried.
        steps: that there are.
        hold: consecutive states that shall show the goal.
        budget: simulated actions, instead of the configuration's; after ANEW of them the search
            begins anew.
        bound: where the rope's centre must stay; None for anywhere.
        met: called with every state as it is met, the goal's last.
        hauling: a rope of HARD_NX crossings or more, and more than the goal has, may be hauled too.

    Returns:
        The first plan found that reaches the goal; for want of one, the plan to the state nearest
        to it.
    """
    limit = config.budget if budget is None else budget
    spent, nearest = 0, list[Node]()
    while True:
        search = _Search(
            simulation, state, goal, graph, config, rng, steps, hold, bound, met, hauling
        )
        reached = search.run(min(ANEW, limit - spent))
        spent += search.spent
        if reached is not None:
            return _plan_to(reached, True, spent)
        nearest.append(min(search.pool, key=search.far))
        if spent + config.batch_size > limit or not search.spent:
            break
    return _plan_to(min(nearest, key=search.far), False, spent)


def reason(before: GaussCode, after: GaussCode, kind: str) -> str:
    """Name what a macro-action did to a code, and its kind: "R1+ curl", "R2- pass".

    R1 and R2, + or -, are one or two crossings more or less; "slide" moves the base bead past
    crossings; R3 keeps number and writhe of three crossings or more; what is left is "other", and
    "none" where the code is the same.

    >>> reason(GaussCode.parse(""), GaussCode.parse("1+a,1-a"), "curl")
    'R1+ curl'
    """
    more = after.nx - before.nx
    if before == after:
        move = "none"
    elif abs(more) in (1, 2):
        move = f"R{abs(more)}{'+' if more > 0 else '-'}"
    elif more == 0 and any(before.rebased(k) == after for k in range(2 * before.nx)):
        move = "slide"
    else:
        move = "R3" if more == 0 and before.nx >= 3 and before.writhe == after.writhe else "other"
    return f"{move} {kind}"


class _Search:
    """One plan in the making."""

    def __init__(
        self,
        simulation: Ropes,
        state: Array,
        goal: GaussCode,
        graph: TransitionGraph,
        config: PlannerConfig,
        rng: np.random.Generator,
        steps: int,
        hold: int,
        bound: TowBound | None,
        met: Callable[[Node], object] | None,
        hauling: bool,
    ) -> None:
        self.simulation, self.goal, self.graph = simulation, goal, graph
        self.config, self.rng = config, rng
        self.steps, self.hold, self.bound, self.met = steps, hold, bound, met
        simulation.restore(state[None], [0])
        self.root = Node(state, label_many(simulation.points[:1])[0])
        self.distances = graph.distances(goal, self.root.code)
        nx = self.root.code.nx
        self.hauling = hauling and nx >= HARD_NX and nx > goal.nx
        self.pool = _Pool(self.distances, config, nx_as_hops=self.hauling)
        self.pool.add(self.root)
        self.towards: dict[GaussCode, Towards] = {}
        self.promises: Promises = Counter()
        self.controller = WaypointController(simulation.count, config.macro_actions)
        self.branches: dict[int, _Branch] = {}  # by the rope of the simulation
        self.spent = 0

    def run(self, budget: int) -> Node | None:
        """Search until the goal is reached or the budget spent; the node that reaches it."""
        count = self.config.batch_size
        while self.spent + count <= budget and self.steps > 0:
            for row in range(count):
                if row not in self.branches:
                    self.branches[row] = self._set_out(row)
            reached = self._step()
            if reached is not None:
                return reached
        return None

    def far(self, node: Node) -> tuple[float, int]:
        """How far a state's code is from the goal, and after how many steps it was met."""
        return self.distances(node.code), node.steps

    def _step(self) -> Node | None:
        """Take one step of every branch; the node at which the goal has been held, if any is."""
        count, simulation, controller = self.config.batch_size, self.simulation, self.controller
        controller.advance(simulation.points)
        beads = controller.beads[:count].copy()
        forces = controller.forces(simulation.points)[:count]
        for row, branch in self.branches.items():
            if branch.haul is not None:
                beads[row], forces[row] = branch.haul.pull(len(branch.actions))
        actions, held = step_ropes(simulation, beads, forces, np.arange(count))
        self.spent += count
        held &= self._allowed(np.arange(count))
        codes = label_many(simulation.points[:count])
        controller.advance(simulation.points)
        idle = controller.idle
        for row in range(count):
            if not held[row]:
                del self.branches[row]
                continue
            branch, code = self.branches[row], codes[row]
            branch.actions.append(actions[row])
            ended = (bool(idle[row]) and branch.haul is None) or self._is_over(branch)
            if self._is_worth_keeping(branch, code, ended):
                node = self._keep(row, branch, code)
                if code.matches(self.goal):
                    reached = self._hold_goal(row, node)
                    if reached is not None:
                        return reached
                    ended = True
                ended |= self.distances(code) < self.distances(branch.node.code)
            branch.code = code
            if ended:
                del self.branches[row]
        return None

    def _allowed(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which ropes of the simulation lie where they may."""
        if self.bound is None:
            return np.ones(len(rows), dtype=bool)
        return ~self.bound.exceeded(self.simulation.points[rows])

    def _is_over(self, branch: _Branch) -> bool:
        """Whether the branch, or the episode, has no step left."""
        longest = self.config.longest if branch.haul is None else branch.haul.steps
        return len(branch.actions) >= longest or branch.steps >= self.steps

    def _is_worth_keeping(self, branch: _Branch, code: GaussCode, ended: bool) -> bool:
        """Whether the state joins the pool: a code just changed, or a macro-action's end.

        An end with the code that the branch set out from counts only where that code is stuck: then
        the same code, lying otherwise, is worth setting out from. What a haul passes through
        counts only where it is nearer to the goal than where it set out.
        """
        if branch.haul is not None:
            return ended or self.distances(code) < self.distances(branch.node.code)
        if code != branch.code:
            return True
        stuck = self.pool.tries(branch.node.code) > self.config.stuck
        return ended and (stuck or code != branch.node.code)

    def _set_out(self, row: int) -> _Branch:
        """Choose a state and a macro-action, and lay a rope there."""
        node = self.pool.choose(self.rng)
        self.simulation.restore(node.state[None], [row])
        points = self.simulation.points[row]
        if self.hauling and node.code.nx >= HAULED_NX and self.rng.random() < HAULS:
            return _Branch(node, HAUL, node.code, propose_haul(len(points), self.rng))
        if self.rng.random() < self.config.guided:
            if node.code not in self.towards:
                self.towards[node.code] = Towards(self.graph.steps(node.code, self.distances))
            macro_action = most_promising(
                points,
                node.code,
                self.towards[node.code],
                self.distances,
                self.config,
                self.rng,
                self.promises,
            )
        else:
            macro_action = propose(points, self.rng, self.config.macro_actions)
        self.controller.begin(row, macro_action)
        return _Branch(node, macro_action.kind, node.code)

    def _keep(self, row: int, branch: _Branch, code: GaussCode) -> Node:
        """Put a state into the pool, if there are steps enough left to go on from it."""
        node = Node(
            self.simulation.states([row])[0],
            code,
            branch.steps,
            branch.node,
            branch.kind,
            tuple(branch.actions),
        )
        if self.met is not None:
            self.met(node)
        if node.steps + self.config.least_stride * self.pool.hops(code) <= self.steps:
            self.pool.add(node)
        return node

    def _hold_goal(self, row: int, node: Node) -> Node | None:
        """Rest until the goal has been held long enough; None if it is lost before."""
        still: tuple[NDArray[np.float32], ...] = ()
        for extra in range(1, self.hold):
            actions, held = step_ropes(
                self.simulation, np.array([0]), np.zeros((1, 3)), np.array([row])
            )
            self.spent += 1
            still = (*still, actions[0])
            held &= self._allowed(np.array([row]))
            if not held[0] or node.steps + extra > self.steps:
                return None
            if not label_many(self.simulation.points[row : row + 1])[0].matches(self.goal):
                return None
        if not still:
            return node
        state = self.simulation.states([row])[0]
        return Node(state, node.code, node.steps + len(still), node, REST, still)


def _drawn(weights: Array, rng: np.random.Generator) -> int:
    """A place, drawn by weights."""
    return int(cumulative_shares(weights).searchsorted(rng.random(), side="right"))


def _plan_to(node: Node, solved: bool, spent: int) -> Plan:
    """The actions from the root to a node."""
    stretches: list[tuple[tuple[NDArray[np.float32], ...], str]] = []
    while node.before is not None:
        stretches.append((node.actions, reason(node.before.code, node.code, node.kind)))
        node = node.before
    stretches.reverse()
    actions = [action for taken, _ in stretches for action in taken]
    moves = tuple(move for taken, move in stretches for _ in taken)
    return Plan(np.array(actions, dtype=np.float32).reshape(-1, 6), moves, solved, spent)
