"""Planning in the simulator: pulls that lead a rope from the very state it is in to a Gauss code.

A pool of states met is kept by their codes. Copies of the rope set out from states whose codes are
near the goal, as the graph tells, each through one macro_action: the most promising of several that
are surrogate_rollout, some of them like those that made a change towards the goal before; or any.
Every new code on the way joins the pool. MuJoCo repeats itself bit for bit from an integration
state, so a plan that reaches the goal here reaches it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import (
    MacroAction,
    WaypointController,
    move_aside,
    pass_strand,
    propose,
    step_ropes,
)
from knotgym.control.surrogate import surrogate_rollout
from knotgym.control.transition_counts import MacroTemplate, Places
from knotgym.control.transition_graph import Distances, Step, TransitionGraph
from knotgym.errors import KnotgymError
from knotgym.rope import Array
from knotgym.simulation import Simulation
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode

_STUCK = 24  # macro-actions from one code
_TRUST = 3  # failures after which a promise counts half
_SKETCHED = 10  # pulls of a surrogate rollout
# code set out from, nearest code in a surrogate rollout -> macro-actions chosen for it
Tried = Counter[tuple[GaussCode, GaussCode]]

REST = "rest"  # the kind of a pull with no force, by which a code is held


class InvalidPlanner(KnotgymError, ValueError):
    """Settings that no planner can have."""


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """How hard to plan.

    Attributes:
        budget: simulated actions for one episode at most, all its plans together.
        batch_size: copies of the rope led side by side.
        guided: share of macro-actions that are chosen among `surrogate_rollouts`; the others are
        any.
        surrogate_rollouts: macro-actions surrogate_rollout for each one chosen.
        longest: pulls of one macro_action.
        kept: states kept for a code.
        greed: how much likelier a state is to be set out from the nearer it is; 0 for not at all.
        stride: pulls that a change of code takes, about.
        patience: pulls later at which a state is e times less likely to be set out from.
    """

    budget: int = 20000
    batch_size: int = 8
    guided: float = 0.8
    surrogate_rollouts: int = 32
    longest: int = 10
    kept: int = 6
    greed: float = 4.0
    stride: float = 6.0
    patience: float = 10.0

    def __post_init__(self) -> None:
        for name in ("batch_size", "surrogate_rollouts", "longest", "kept"):
            if getattr(self, name) < 1:
                raise InvalidPlanner(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.budget < 0:
            raise InvalidPlanner(f"budget must be at least 0 actions, got {self.budget}")
        if not 0 <= self.guided <= 1:
            raise InvalidPlanner(f"guided must be in [0, 1], got {self.guided}")
        if not 0 <= self.greed < np.inf:
            raise InvalidPlanner(f"greed must be at least 0 and finite, got {self.greed}")
        if not (0 <= self.stride < np.inf and 0 < self.patience < np.inf):
            raise InvalidPlanner(
                f"stride must be at least 0 and patience above 0, both finite; got {self.stride}"
                f" and {self.patience}"
            )


@dataclass(eq=False)
class Node:
    """A state met.

    Attributes:
        state: integration state, float64.
        code: shown, with chirality.
        pulls: from the state planned from.
        before: the node that the last macro-action set out from, None at the root.
        kind: of that macro_action.
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


@dataclass(eq=False)
class _Branch:
    """A copy of the rope under way from a node."""

    node: Node
    kind: str
    code: GaussCode
    actions: list[NDArray[np.float32]] = field(default_factory=list)


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
) -> Plan:
    """Find pulls that lead to the goal code.

    Args:
        simulation: at least `config.slots` ropes, whose states are overwritten.
        state: integration state to set out from.
        goal: compared without chirality.
        graph: knows distances; an empty one guides by crossings alone.
        config: how hard to try.
        rng: decides what is tried.
        steps: pulls there are.
        hold: consecutive states that shall show the goal.
        budget: simulated actions, instead of the configuration's.

    Returns:
        The first plan found that reaches the goal; for want of one, the way to the state nearest to
        it.
    """
    return _Search(simulation, state, goal, graph, config, rng, steps, hold).run(
        config.budget if budget is None else budget
    )


def guided(
    points: Array, graph: TransitionGraph, distances: Distances, rng: np.random.Generator
) -> MacroAction:
    """A macro-action that promises to lead towards the goal."""
    code = find_crossings(points).code
    return _foreseen(
        points,
        code,
        graph.steps(code, distances),
        distances,
        rng,
        Counter(),
        PlannerConfig().surrogate_rollouts,
    )


def reason(before: GaussCode, after: GaussCode, kind: str) -> str:
    """Name what a macro-action did to a code, and the macro_action: "R1+ curl", "R2- pass", "slide
    spread".

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
        simulation: Simulation,
        state: Array,
        goal: GaussCode,
        graph: TransitionGraph,
        config: PlannerConfig,
        rng: np.random.Generator,
        steps: int,
        hold: int,
    ) -> None:
        self.simulation, self.goal, self.graph, self.config, self.rng = (
            simulation,
            goal,
            graph,
            config,
            rng,
        )
        self.steps, self.hold = steps, hold
        simulation.restore(state[None], [0])
        self.root = Node(state, label_many(simulation.points[:1])[0])
        self.distances = graph.distances(goal)
        self.pool: dict[GaussCode, list[Node]] = {self.root.code: [self.root]}
        self.tries: dict[GaussCode, int] = {}
        self.towards: dict[GaussCode, list[Step]] = {}
        self.promised: Tried = Counter()
        self.controller = WaypointController(simulation.count)

    def run(self, budget: int) -> Plan:
        count = self.config.batch_size
        branches: list[_Branch | None] = [None] * count
        ids = np.arange(count)
        spent = 0
        while spent + count <= budget and self.steps > 0:
            for row in range(count):
                if branches[row] is None:
                    branches[row] = self._set_out(row)
            self.controller.advance(self.simulation.points)
            actions, held = step_ropes(
                self.simulation,
                self.controller.beads[:count],
                self.controller.forces(self.simulation.points)[:count],
                ids,
            )
            spent += count
            codes = label_many(self.simulation.points[:count])
            self.controller.advance(self.simulation.points)
            ended = self.controller.idle
            for row, branch in enumerate(branches):
                if branch is None or not held[row]:
                    branches[row] = None
                    continue
                branch.actions.append(actions[row])
                steps = branch.node.steps + len(branch.actions)
                last = (
                    bool(ended[row])
                    or len(branch.actions) >= self.config.longest
                    or steps >= self.steps
                )
                # then the same code, lying otherwise, is worth setting out from
                stuck = self.tries.get(branch.node.code, 0) > _STUCK
                if codes[row] != branch.code or (
                    last and (stuck or codes[row] != branch.node.code)
                ):
                    node = self._met(row, branch, codes[row])
                    if codes[row].matches(self.goal):
                        reached, cost = self._holding(row, node)
                        spent += cost
                        if reached is not None:
                            return _plan(reached, True, spent)
                        last = True
                    last |= self.distances(codes[row]) < self.distances(branch.node.code)
                branch.code = codes[row]
                if last:
                    branches[row] = None
        best = min(
            (node for nodes in self.pool.values() for node in nodes),
            key=lambda one: (self.distances(one.code), one.steps),
        )
        return _plan(best, False, spent)

    def _set_out(self, row: int) -> _Branch:
        """Choose a state and a macro-action, and lay a rope there."""
        node = self._chosen()
        node.tries += 1
        self.tries[node.code] = self.tries.get(node.code, 0) + 1
        self.simulation.restore(node.state[None], [row])
        points = self.simulation.points[row]
        if self.rng.random() < self.config.guided:
            if node.code not in self.towards:
                self.towards[node.code] = self.graph.steps(node.code, self.distances)
            macro_action = _foreseen(
                points,
                node.code,
                self.towards[node.code],
                self.distances,
                self.rng,
                self.promised,
                self.config.surrogate_rollouts,
            )
        else:
            macro_action = propose(points, self.rng)
        self.controller.begin(row, macro_action)
        return _Branch(node, macro_action.kind, node.code)

    def _chosen(self) -> Node:
        codes = [code for code, nodes in self.pool.items() if nodes]
        far = np.array([self.distances(code) for code in codes])
        tries = np.array([self.tries.get(code, 0) for code in codes])
        late = np.array(
            [
                min(node.steps for node in self.pool[code])
                + self.config.stride * self.distances.hops.get(code, 2)
                for code in codes
            ]
        )
        weights = (
            (1 + far) ** -self.config.greed
            / (1 + tries / 10)
            * np.exp(-(late - late.min()) / self.config.patience)
        )
        nodes = self.pool[codes[self.rng.choice(len(codes), p=weights / weights.sum())]]
        fresh = np.array(
            [np.exp(-node.steps / self.config.patience) / (1 + node.tries) for node in nodes]
        )
        return nodes[self.rng.choice(len(nodes), p=fresh / fresh.sum())]

    def _met(self, row: int, branch: _Branch, code: GaussCode) -> Node:
        """Keep a state, if there is a way on from it; of too many with one code the longest and
        most tried goes.
        """
        steps = branch.node.steps + len(branch.actions)
        node = Node(
            self.simulation.states([row])[0],
            code,
            steps,
            branch.node,
            branch.kind,
            tuple(branch.actions),
        )
        if steps + 2 * self.distances.hops.get(code, 2) <= self.steps:
            nodes = self.pool.setdefault(code, [])
            nodes.append(node)
            if len(nodes) > self.config.kept:
                nodes.remove(max(nodes, key=lambda one: one.steps + 2 * one.tries))
        return node

    def _holding(self, row: int, node: Node) -> tuple[Node | None, int]:
        """The node at which the goal has been held long enough, and the actions simulated; None if
        it is lost.
        """
        still: tuple[NDArray[np.float32], ...] = ()
        for extra in range(1, self.hold):
            actions, held = step_ropes(
                self.simulation, np.array([0]), np.zeros((1, 3)), np.array([row])
            )
            still = (*still, actions[0])
            if (
                not held[0]
                or node.steps + extra > self.steps
                or not label_many(self.simulation.points[row : row + 1])[0].matches(self.goal)
            ):
                return None, extra
        if not still:
            return node, 0
        return Node(
            self.simulation.states([row])[0], node.code, node.steps + len(still), node, REST, still
        ), len(still)


def _foreseen(
    points: Array,
    code: GaussCode,
    steps: list[Step],
    distances: Distances,
    rng: np.random.Generator,
    tried: Tried,
    count: int,
) -> MacroAction:
    """Of some macro-actions, half of them held as ones that made a change towards the goal, the one
    whose surrogate rollout comes nearest to it.

    What a surrogate rollout promises counts the less the oftener it was chosen for the same
    promise; the choice is counted in `tried`.
    """
    places = Places(find_crossings(points), len(points))
    weights = np.array([step.chance * step.gain for step in steps])
    here, best, promise, chosen = distances(code), -np.inf, code, None
    for number in range(count):
        if steps and number % 2 == 0:
            templates = steps[rng.choice(len(steps), p=weights / weights.sum())].templates
            macro_action = held_so(points, templates[rng.integers(len(templates))], places, rng)
        else:
            macro_action = propose(points, rng)
        nearest = min(label_many(surrogate_rollout(points, macro_action, _SKETCHED)), key=distances)
        gain = (here - distances(nearest)) / (1 + tried[code, nearest] / _TRUST)
        if gain > best:
            best, promise, chosen = gain, nearest, macro_action
    assert chosen is not None  # count is at least 1, and no distance is infinite
    tried[code, promise] += 1
    return chosen


def held_so(
    points: Array, template: MacroTemplate, places: Places, rng: np.random.Generator
) -> MacroAction:
    """The macro-action of a template on a rope, its places along the arcs varied a little."""

    def bead(place: float) -> int:
        along = np.clip(place % 1.0 + rng.normal(0, 0.1), 0.0, 0.999)
        return places.bead(int(place) + float(along))

    if template.target >= 0:
        return pass_strand(
            points, template.kind, bead(template.bead), bead(template.target), template.side, rng
        )
    return move_aside(points, template.kind, bead(template.bead), template.side, rng)


def _plan(node: Node, solved: bool, spent: int) -> Plan:
    """The way from the root to a node."""
    parts: list[tuple[tuple[NDArray[np.float32], ...], str]] = []
    while node.before is not None:
        parts.append((node.actions, reason(node.before.code, node.code, node.kind)))
        node = node.before
    parts.reverse()
    actions = [action for some, _ in parts for action in some]
    moves = tuple(why for some, why in parts for _ in some)
    return Plan(np.array(actions, dtype=np.float32).reshape(-1, 6), moves, solved, spent)
