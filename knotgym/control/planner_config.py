"""Settings of the planner."""

from dataclasses import dataclass

from knotgym.common.configuration import check_numbers
from knotgym.control.transition_graph import TransitionGraphConfig
from knotgym.rope.macro_actions import MacroActionConfig


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Settings of the planner, see `planner` for the search that they control.

    Attributes:
        budget: simulated actions per episode for expert planning. A search restarts after
            `planner.RESTART` of them.
        batch_size: copies of the rope simulated side by side.
        guided: share of macro-actions that imitate counted ones, where there are any; the rest are
            random.
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
        template_noise: standard deviation of a template's positions, in arcs.
        graph: settings of the distances.
        macro_actions: settings of the macro-actions.
    """

    budget: int = 60000
    batch_size: int = 8
    guided: float = 0.8
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
    template_noise: float = 0.1
    graph: TransitionGraphConfig = TransitionGraphConfig()
    macro_actions: MacroActionConfig = MacroActionConfig()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("batch_size", "longest", "kept"),
            whole=("budget", "least_stride", "unknown_hops", "stuck"),
            positive=("patience", "weariness"),
            non_negative=("greed", "stride", "try_cost", "template_noise"),
            shares=("guided",),
        )
