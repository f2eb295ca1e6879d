"""How hard the planner tries."""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.control.macro_actions import MacroActionConfig
from knotgym.control.surrogate import SurrogateConfig
from knotgym.control.transition_graph import TransitionGraphConfig


class InvalidPlanner(KnotgymError, ValueError):
    """Settings that no planner can have."""


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """How hard to plan.

    Attributes:
        budget: simulated actions for one episode at most, all its plans together. A search that
            has had `planner.ANEW` of them begins anew, for other draws may have more luck.
        batch_size: copies of the rope led side by side.
        guided: share of macro-actions that are chosen by surrogate rollouts; the others are any.
        surrogate_rollouts: macro-actions looked at for each one so chosen.
        longest: steps of one macro-action.
        kept: states kept for a code.
        greed: how much likelier a state is to be set out from the nearer it is; 0 for not at all.
        stride: steps that a change of code takes, about.
        least_stride: steps that it takes at least: states too late for the changes left are
            dropped.
        unknown_hops: changes of code to the goal where the graph knows no path.
        patience: steps later at which a state is e times less likely to be set out from.
        weariness: macro-actions from a code that halve its chance to be set out from again.
        try_cost: steps that a macro-action from a state counts as when the worst state of a code
            is dropped.
        stuck: macro-actions from a code after which states that show it, lying otherwise, are kept
            too.
        trust: macro-actions chosen for the same promise after which it counts half.
        template_noise: standard deviation of a template's places along the arcs, in arcs.
        graph: how distances are counted.
        macro_actions: how they are drawn and carried out.
        surrogate: how their surrogate rollouts move the rope.
    """

    budget: int = 20000
    batch_size: int = 8
    guided: float = 0.8
    surrogate_rollouts: int = 32
    longest: int = 10
    kept: int = 6
    greed: float = 4.0
    stride: float = 6.0
    least_stride: int = 2
    unknown_hops: int = 2
    patience: float = 10.0
    weariness: float = 10.0
    try_cost: float = 2.0
    stuck: int = 24
    trust: float = 3.0
    template_noise: float = 0.1
    graph: TransitionGraphConfig = TransitionGraphConfig()
    macro_actions: MacroActionConfig = MacroActionConfig()
    surrogate: SurrogateConfig = SurrogateConfig()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("batch_size", "surrogate_rollouts", "longest", "kept"),
            whole=("budget", "least_stride", "unknown_hops", "stuck"),
            positive=("patience", "weariness", "trust"),
            non_negative=("greed", "stride", "try_cost", "template_noise"),
            shares=("guided",),
            error=InvalidPlanner,
        )
