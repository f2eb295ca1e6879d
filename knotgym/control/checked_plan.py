"""Plan in the chain engine, and check in the engine that counts.

A plan is searched for in the chain, which is some forty times as fast as MuJoCo, and acted out once
in MuJoCo. Where the two part, the search goes on from the state nearest to the goal that the check
came through, or begins again. Engines are deterministic, bit for bit, so what was checked holds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, resting, step_ropes
from knotgym.control.planner import REST, Plan, plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import TransitionGraph
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

_FAILURES = 2  # plans from one state that may lead no nearer to the goal, until it begins again
_LOOK = 4000  # actions of the first search; twice as many after each from the root that finds none


@dataclass(frozen=True, eq=False)
class Stand:
    """A state that the real rope was led to.

    Attributes:
        state: integration state.
        code: that it shows.
        pulls, moves: actions that led here, and the reason for each.
    """

    state: Array
    code: GaussCode
    pulls: ActionSequence = NO_ACTIONS
    moves: tuple[str, ...] = ()


def plan_checked(
    chain: Simulation,
    check: Simulation,
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
    met: Callable[[Stand], object] | None = None,
) -> Plan:
    """Find actions that lead to the goal code, by plans made in the chain engine.

    Args:
        chain: at least `config.batch_size` ropes of the chain engine; overwritten.
        check: one rope of the engine that the plan is for; overwritten.
        state: of that rope, to start from.
        goal, graph, config, rng, steps, hold, budget, bound: as of `plan`. The budget counts the
            actions of both engines.
        met: called with every state that plans led to in the check, in order.

    Returns:
        The first plan that ends in the goal, or else one to the state nearest to it.
    """
    limit = config.budget if budget is None else budget
    check.restore(state[None])
    root = here = best = Stand(state, label(check.points[0]))
    distances = graph.distances(goal, root.code)
    spent, failures, look = 0, 0, _LOOK

    def remoteness(stand: Stand) -> tuple[float, int]:
        return distances(stand.code), len(stand.pulls)

    while spent + config.batch_size <= limit and steps > 0:
        check.restore(here.state[None])
        chain.lay(check.qpos(), [0])
        made = plan(
            chain,
            chain.states([0])[0],
            goal,
            graph,
            config,
            rng,
            steps=steps - len(here.pulls),
            hold=hold,
            budget=min(look, limit - spent),
            bound=bound,
            hauling=True,
        )
        spent += made.spent
        if not made.solved and spent + config.batch_size <= limit:
            # too few actions are left from here, or the goal is hard to find
            look *= 1 if len(here.pulls) else 2
            here, failures = root, 0
            continue
        left = steps - len(here.pulls)
        stands, solved = _act_out(check, here, made, goal, left, hold, bound)
        spent += len(stands)
        if met is not None:
            for stand in stands:
                met(stand)
        if solved:
            return Plan(stands[-1].pulls, stands[-1].moves, True, spent)
        nearest = min(stands, key=remoteness, default=here)
        best = min(best, nearest, key=remoteness)
        if distances(nearest.code) < distances(here.code):
            here, failures = nearest, 0
        else:
            failures += 1
        if failures == _FAILURES or len(here.pulls) + config.least_stride > steps:
            here, failures = root, 0
    return Plan(best.pulls, best.moves, False, spent)


def _act_out(
    check: Simulation,
    here: Stand,
    made: Plan,
    goal: GaussCode,
    steps: int,
    hold: int,
    bound: TowBound | None,
) -> tuple[list[Stand], bool]:
    """Act a plan out, until it shows the goal or has had `steps` actions.

    Returns:
        The states on the way, and whether the last `hold` of them show the goal.
    """
    check.restore(here.state[None])
    stands, held = list[Stand](), 0
    rest = resting(1)
    while held < hold and len(stands) < (steps if held else min(steps, len(made.pulls))):
        at = slice(len(stands), len(stands) + 1)
        pull = rest if held else ActionSequence(made.pulls.beads[at], made.pulls.forces[at])
        move = f"none {REST}" if held else made.moves[len(stands)]
        stable = step_ropes(check, pull.beads, pull.forces)[1][0]
        if not stable or (bound is not None and bound.exceeded(check.points)[0]):
            break
        code = label(check.points[0])
        held = held + 1 if code.matches(goal) else 0
        pulls, moves = here.pulls + pull, (*here.moves, move)
        here = Stand(check.states()[0], code, pulls, moves)
        stands.append(here)
    return stands, held == hold
