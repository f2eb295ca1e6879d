"""Planning: one table of moves, one computation of values, one batched search, two planners."""

from knotgym.control.planning.batched_search import BatchedSearch
from knotgym.control.planning.changes import CHANGES, shipped_guide
from knotgym.control.planning.pass_policies import Mixed, Noisy, Play, Scripted
from knotgym.control.planning.passes import EVERY_CODE, PASSES, PassPlan, PassValues, pass_values
from knotgym.control.planning.planners import PassPlanner, PullPlanner
from knotgym.control.planning.pulls import PullSearch
from knotgym.control.planning.sights import Diagram, Sight, first_goal, see

__all__ = [
    "CHANGES",
    "EVERY_CODE",
    "PASSES",
    "BatchedSearch",
    "Diagram",
    "Mixed",
    "Noisy",
    "PassPlan",
    "PassPlanner",
    "PassValues",
    "Play",
    "PullPlanner",
    "PullSearch",
    "Scripted",
    "Sight",
    "first_goal",
    "pass_values",
    "see",
    "shipped_guide",
]
