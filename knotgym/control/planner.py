"""Plan in the simulator: find actions that lead a rope from its current state to a Gauss code.

This is a best-first search with random choices. A pool holds the states met so far, grouped by
code. Each iteration picks a state from the pool, preferring codes that the transition graph puts
near the goal, and applies one macro-action to it, in `batch_size` simulations side by side. The
macro-action is either random or imitates one that made a useful change of code before. Ropes with
many crossings may be hauled instead. Every state with a new code joins the pool.

Either engine can be searched in, and is deterministic from a given state. The chain is some forty
times as fast as MuJoCo; `expert` checks there what was planned here.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, resting
from knotgym.control.guidance import Towards
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import Distances, TransitionGraph
from knotgym.rope.macro_actions import Haul, WaypointController, cumulative_shares, propose_haul
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

REST = "rest"  # kind of an action without force, which holds a code
HAUL = "haul"  # kind of the actions of a haul
HARD_NX = 7  # hauls are allowed from this many crossings on, where guidance knows very little
HAULED_NX = 3  # a hard rope is hauled only from states of at least this many crossings
HAULS = 0.6  # share of a hard rope's macro-actions that are hauls
RESTART = 20_000  # simulated actions after which a search restarts: other draws may do better


@dataclass(eq=False)
class Node:
    """A state in the search tree.

    Attributes:
        state: integration state, float64.
        code: Gauss code of the state, with chirality.
        steps: actions from the root to here.
        before: parent node, None at the root.
        kind: kind of the macro-action that led here from the parent.
        pulls: that macro-action, up to here.
        tries: macro-actions started from here so far.
    """

    state: Array
    code: GaussCode
    steps: int = 0
    before: Node | None = None
    kind: str = ""
    pulls: ActionSequence = NO_ACTIONS
    tries: int = 0


@dataclass(frozen=True, eq=False)
class Plan:
    """T actions and the reason for each.

    Attributes:
        pulls: the actions.
        moves: T reasons, in the words of `reason`.
        solved: whether the last state shows the goal.
        spent: number of actions simulated to find the plan.
    """

    pulls: ActionSequence
    moves: tuple[str, ...]
    solved: bool
    spent: int


class _Pool:
    """The states met so far, grouped by code, with what `choose` needs to weigh each code.

    Codes get rows in the order in which they are met; the arrays below are indexed by row.
    """

    def __init__(self, distances: Distances, config: PlannerConfig, *, nx_as_hops: bool) -> None:
        self._distances, self._config, self._nx_as_hops = distances, config, nx_as_hops
        self._rows: dict[GaussCode, int] = {}
        self._nodes: list[list[Node]] = []
        self._distance = np.empty(0)  # macro-actions to the goal
        self._tries = np.empty(0, dtype=np.int64)  # macro-actions started from states of the code
        self._earliest = np.empty(0, dtype=np.int64)  # fewest steps from the root
        self._left = np.empty(0)  # estimated steps to the goal

    def __iter__(self) -> Iterator[Node]:
        return itertools.chain.from_iterable(self._nodes)

    def hops(self, code: GaussCode) -> int:
        """Estimated number of code changes from a code to the goal."""
        self._distances(code)  # fills in `hops` for a code that the graph meets only now
        unknown = code.nx if self._nx_as_hops else self._config.unknown_hops
        return self._distances.hops.get(code, unknown)

    def add(self, node: Node) -> None:
        """Add a state; if its code now has too many, drop the one latest and tried most often."""
        row = self._row(node.code)
        nodes = self._nodes[row]
        nodes.append(node)
        if len(nodes) > self._config.kept:
            cost = self._config.try_cost
            nodes.remove(max(nodes, key=lambda node: node.steps + cost * node.tries))
        # computed again, since the state dropped may have been the earliest
        self._earliest[row] = min([node.steps for node in nodes])

    def tries(self, code: GaussCode) -> int:
        """Number of macro-actions started from states of this code."""
        return int(self._tries[self._rows[code]]) if code in self._rows else 0

    def choose(self, rng: np.random.Generator) -> Node:
        """Draw a code, then a state that shows it, and count the try."""
        config = self._config
        # A code's weight falls with its distance to the goal (greed), with how often it was tried
        # (weariness), and with the estimated length of an episode through it (patience). Lengths
        # are compared to the shortest one, which keeps the exponentials from underflowing.
        late = self._earliest + self._left
        weights = (
            (1 + self._distance) ** -config.greed
            / (1 + self._tries / config.weariness)
            * np.exp(-(late - late.min()) / config.patience)
        )
        row = _drawn(weights, rng)
        # among the code's states: early ones, and ones tried less often
        nodes = self._nodes[row]
        fresh = [np.exp(-node.steps / config.patience) / (1 + node.tries) for node in nodes]
        node = nodes[_drawn(np.array(fresh), rng)]
        node.tries += 1
        self._tries[row] += 1
        return node

    def _row(self, code: GaussCode) -> int:
        """The row of a code; a new code gets one."""
        if code not in self._rows:
            self._rows[code] = len(self._nodes)
            self._nodes.append([])
            self._distance = np.append(self._distance, self._distances(code))
            self._tries = np.append(self._tries, 0)
            self._earliest = np.append(self._earliest, 0)
            self._left = np.append(self._left, self._config.stride * self.hops(code))
        return self._rows[code]


@dataclass(eq=False)
class _Branch:
    """A simulation in the middle of a macro-action.

    Attributes:
        node: where the macro-action started.
        kind: of the macro-action.
        code: shown after the last action.
        haul: the haul under way, None for a macro-action that follows waypoints.
        beads, forces: pulled so far; a force is float32 (3,), in units of the largest.
    """

    node: Node
    kind: str
    code: GaussCode
    haul: Haul | None = None
    beads: list[int] = field(default_factory=list)
    forces: list[NDArray[np.float32]] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """Actions from the root to the current state."""
        return self.node.steps + len(self.beads)

    @property
    def pulls(self) -> ActionSequence:
        return ActionSequence(np.array(self.beads, dtype=np.int16), np.stack(self.forces))


def plan(
    simulation: Simulation,
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
    """Find actions that lead to the goal code.

    Args:
        simulation: at least `config.batch_size` ropes; their states are overwritten.
        state: integration state to start from.
        goal: compared without chirality.
        graph: gives distances; an empty one is guided by numbers of crossings alone.
        config: settings of the search.
        rng: source of all random choices.
        steps: most actions that the plan may have.
        hold: number of consecutive states that must show the goal.
        budget: most actions to simulate, `config.budget` if None; the search restarts after every
            RESTART of them.
        bound: region in which the rope's centre must stay; None for no limit.
        met: called with every state that is kept, in order; the goal comes last.
        hauling: allow hauls if the rope has at least HARD_NX crossings, and more than the goal.

    Returns:
        The first plan found that reaches the goal; if none is found, the plan to the state nearest
        to the goal.
    """
    # Restarts draw from the same generator, so they differ. A last search shorter than RESTART gets
    # what is left; the loop ends when that is less than one action per rope.
    limit = config.budget if budget is None else budget
    spent, nearest = 0, list[Node]()  # the best node of each restart
    while True:
        search = _Search(
            simulation, state, goal, graph, config, rng, steps, hold, bound, met, hauling
        )
        reached = search.run(min(RESTART, limit - spent))
        spent += search.spent
        if reached is not None:
            return _plan_to(reached, True, spent)
        nearest.append(min(search.pool, key=search.remoteness))
        if spent + config.batch_size > limit or not search.spent:
            break
    return _plan_to(min(nearest, key=search.remoteness), False, spent)


def reason(before: GaussCode, after: GaussCode, kind: str) -> str:
    """Name the change of code that a macro-action made, and its kind: "R1+ curl", "R2- pass".

    The change is read from the two codes alone. R1 and R2 mean that one or two crossings were added
    (+) or removed (-); "slide" that the base bead moved past crossings; R3 that at least three
    crossings kept their number and writhe; "none" that the code is the same; "other" is the rest.

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


@dataclass(eq=False)
class _Search:
    """One search, from its root until the goal is reached or its budget is spent.

    The fields are arguments of `plan`.
    """

    simulation: Simulation
    state: Array
    goal: GaussCode
    graph: TransitionGraph
    config: PlannerConfig
    rng: np.random.Generator
    steps: int
    hold: int
    bound: TowBound | None
    met: Callable[[Node], object] | None
    hauling: bool

    def __post_init__(self) -> None:
        self.simulation.restore(self.state[None], [0])
        root = Node(self.state, label_many(self.simulation.points[:1])[0])
        self.distances = self.graph.distances(self.goal, root.code)
        # Hauls take crossings out. Where they are allowed the graph knows few paths, and each
        # crossing is taken for a change of code to go.
        self.hauling &= root.code.nx >= HARD_NX and root.code.nx > self.goal.nx
        self.pool = _Pool(self.distances, self.config, nx_as_hops=self.hauling)
        self.pool.add(root)
        self.towards: dict[GaussCode, Towards] = {}
        self.controller = WaypointController(self.simulation.count, self.config.macro_actions)
        self.branches: dict[int, _Branch] = {}  # by rope of the simulation
        self.spent = 0

    def run(self, budget: int) -> Node | None:
        """Search until the budget is spent; return the node that reaches the goal, if any does."""
        count = self.config.batch_size
        while self.spent + count <= budget and self.steps > 0:
            for row in range(count):
                if row not in self.branches:
                    self.branches[row] = self._set_out(row)
            reached = self._step()
            if reached is not None:
                return reached
        return None

    def remoteness(self, node: Node) -> tuple[float, int]:
        """Sort key: the distance of a node's code to the goal, then its steps from the root."""
        return self.distances(node.code), node.steps

    def _step(self) -> Node | None:
        """Take one action in every branch; return a node at which the goal was held, if any."""
        count, simulation, controller = self.config.batch_size, self.simulation, self.controller
        controller.advance(simulation.points)
        beads = controller.beads[:count].copy()
        forces = controller.forces(simulation.points)[:count]
        for row, branch in self.branches.items():
            if branch.haul is not None:
                # instead of the controller's pull, which is left over from another branch
                beads[row], forces[row] = branch.haul.pull(len(branch.beads))
        pulled = forces.astype(np.float32)
        held = self._pull(beads, pulled, np.arange(count))
        codes = label_many(simulation.points[:count])
        controller.advance(simulation.points)  # a waypoint just reached may be the last one
        idle = controller.idle
        for row in range(count):
            if not held[row]:  # unstable, or out of bounds: nothing from here on is of use
                del self.branches[row]
                continue
            branch, code = self.branches[row], codes[row]
            branch.beads.append(int(beads[row]))
            branch.forces.append(pulled[row])
            ended = (bool(idle[row]) and branch.haul is None) or self._is_over(branch)
            if self._is_worth_keeping(branch, code, ended):
                node = self._keep(row, branch, code)
                if code.matches(self.goal):
                    reached = self._hold_goal(row, node)
                    if reached is not None:
                        return reached
                    ended = True
                # progress is worth a fresh choice of macro-action rather than the rest of this one
                ended |= self.distances(code) < self.distances(branch.node.code)
            branch.code = code
            if ended:
                del self.branches[row]
        return None

    def _pull(
        self, beads: NDArray[np.int64], forces: NDArray[np.float32], rows: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Act on ropes; return which stay stable and within the bound, bool (len(rows),)."""
        newtons = np.clip(forces, -1, 1).astype(np.float64) * self.simulation.max_force
        held = self.simulation.step(beads, newtons, rows)
        self.spent += len(rows)
        if self.bound is not None:
            held = held & ~self.bound.exceeded(self.simulation.points[rows])
        return held

    def _is_over(self, branch: _Branch) -> bool:
        """Tell whether the macro-action or the episode has used up its actions."""
        longest = self.config.longest if branch.haul is None else branch.haul.steps
        return len(branch.beads) >= longest or branch.steps >= self.steps

    def _is_worth_keeping(self, branch: _Branch, code: GaussCode, ended: bool) -> bool:
        """Tell whether a state should join the pool.

        States at which the code changes do, and so do the ends of macro-actions. But an end with
        the code that the branch started from is kept only if that code is stuck: then another
        configuration with the same code may be a better start. Along a haul, only states nearer to
        the goal than its start are kept.
        """
        if branch.haul is not None:
            return ended or self.distances(code) < self.distances(branch.node.code)
        if code != branch.code:
            return True
        stuck = self.pool.tries(branch.node.code) > self.config.stuck
        return ended and (stuck or code != branch.node.code)

    def _set_out(self, row: int) -> _Branch:
        """Choose a state and a macro-action; restore the state in rope `row`."""
        node = self.pool.choose(self.rng)
        self.simulation.restore(node.state[None], [row])
        points = self.simulation.points[row]
        if self.hauling and node.code.nx >= HAULED_NX and self.rng.random() < HAULS:
            return _Branch(node, HAUL, node.code, propose_haul(len(points), self.rng))
        if node.code not in self.towards:
            self.towards[node.code] = Towards(self.graph.steps(node.code, self.distances))
        macro_action = self.towards[node.code].propose(points, self.config, self.rng)
        self.controller.begin(row, macro_action)
        return _Branch(node, macro_action.kind, node.code)

    def _keep(self, row: int, branch: _Branch, code: GaussCode) -> Node:
        """Make a node of the current state; pool it if the goal is still within reach."""
        node = Node(
            self.simulation.states([row])[0],
            code,
            branch.steps,
            branch.node,
            branch.kind,
            branch.pulls,
        )
        if self.met is not None:
            self.met(node)
        # optimistic: every change of code that is left takes the fewest steps it can
        if node.steps + self.config.least_stride * self.pool.hops(code) <= self.steps:
            self.pool.add(node)
        return node

    def _hold_goal(self, row: int, node: Node) -> Node | None:
        """Rest for hold - 1 actions; return the node after them, or None if the goal is lost."""
        rows, still = np.array([row]), resting(self.hold - 1)
        for extra in range(1, self.hold):
            held = self._pull(rows, np.zeros((1, 3), dtype=np.float32), rows)
            if not held[0] or node.steps + extra > self.steps:
                return None
            if not label_many(self.simulation.points[rows])[0].matches(self.goal):
                return None
        if not len(still):
            return node
        state = self.simulation.states([row])[0]
        return Node(state, node.code, node.steps + len(still), node, REST, still)


def _drawn(weights: Array, rng: np.random.Generator) -> int:
    """Draw an index with probability proportional to its weight."""
    return int(cumulative_shares(weights).searchsorted(rng.random(), side="right"))


def _plan_to(node: Node, solved: bool, spent: int) -> Plan:
    """Collect the actions from the root to a node, following the parents back."""
    pulls, moves = NO_ACTIONS, list[str]()
    while node.before is not None:
        # one reason for the whole macro-action: the change of code between its two ends
        pulls = node.pulls + pulls
        moves += [reason(node.before.code, node.code, node.kind)] * len(node.pulls)
        node = node.before
    return Plan(pulls, tuple(moves[::-1]), solved, spent)
