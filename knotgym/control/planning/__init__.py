"""Planning: one table of moves, one computation of values, one batched search, two planners."""

from knotgym.control.planning.batched_search import BatchedSearch
from knotgym.control.planning.passes import EVERY_CODE, PASSES, PassPlan, PassValues, pass_values
from knotgym.control.planning.planners import PassPlanner, PullPlanner, compile_planning
from knotgym.control.planning.pulls import PullSearch
from knotgym.control.planning.sights import Diagram, Sight, first_goal, see

__all__ = [
    "EVERY_CODE",
    "PASSES",
    "BatchedSearch",
    "Diagram",
    "PassPlan",
    "PassPlanner",
    "PassValues",
    "PullPlanner",
    "PullSearch",
    "Sight",
    "compile_planning",
    "first_goal",
    "pass_values",
    "see",
]
