"""Planning: one table of moves, one computation of values, one batched search, two planners."""

from knotgym.control.planning.batched_search import BatchedSearch, Orders, Report, Search, Trial
from knotgym.control.planning.changes import CHANGES, Guide, shipped_guide
from knotgym.control.planning.diagrams import Diagram, Sight, first_goal, see
from knotgym.control.planning.pass_policies import Mixed, Noisy, Play, Scripted
from knotgym.control.planning.passes import (
    EVERY_CODE,
    PASSES,
    PassPlan,
    PassSearch,
    PassValues,
    TriedPass,
    pass_values,
    random_pass,
)
from knotgym.control.planning.planners import PassPlanner, PullPlanner
from knotgym.control.planning.pulls import PullPlan, PullSearch

__all__ = [
    "CHANGES",
    "EVERY_CODE",
    "PASSES",
    "BatchedSearch",
    "Diagram",
    "Guide",
    "Mixed",
    "Noisy",
    "Orders",
    "PassPlan",
    "PassPlanner",
    "PassSearch",
    "PassValues",
    "Play",
    "PullPlan",
    "PullPlanner",
    "PullSearch",
    "Report",
    "Scripted",
    "Search",
    "Sight",
    "Trial",
    "TriedPass",
    "first_goal",
    "pass_values",
    "random_pass",
    "see",
    "shipped_guide",
]
