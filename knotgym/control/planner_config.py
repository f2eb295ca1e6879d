"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.control.surrogate import SurrogateConfig
from knotgym.control.transition_graph import TransitionGraphConfig
from knotgym.rope.macro_actions import MacroActionConfig


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Settings of the planner, see `planner` for the search that they control.

    Attributes:
        budget: simulated actions per episode for expert planning. A search restarts after
            `planner.ANEW` of them.
        batch_size: copies of the rope simulated side by side.
        guided: share of macro-actions that are chosen by surrogate rollouts; the rest are random.
        surrogate_rollouts: candidates compared for each macro-action chosen in this way.
        longest: most actions of one macro-action.
        kept: most states kept per code.
        greed: exponent of the preference for codes near the goal; 0 for no preference.
        stride: expected actions per change of code.
        least_stride: fewest actions per change of code; a state from which the goal can't be
            reached in time even at this rate is dropped.
        unknown_hops: changes of code to the goal assumed where the graph knows no path.
        patience: delay, in actions, that makes a state e times less likely to be chosen.
        weariness: macro-actions from a code that halve its probability to be chosen again.
        try_cost: actions that each try of a state counts for when the worst state of a code is
            dropped.
        stuck: macro-actions from a code after which other configurations with the same code are
            kept too.
        trust: times a predicted change must have been chosen for its gain to count half.
        template_noise: standard deviation of a template's positions, in arcs.
        graph: settings of the distances.
        macro_actions: settings of the macro-actions.
        surrogate: settings of the surrogate rollouts.
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
        )
