"""Settings of the planner."""

from knotgym.common.configuration import Count, NonNegative, Positive, Share, Whole, configuration
from knotgym.control.transition_graph import TransitionGraphConfig
from knotgym.rope.macro_action_config import MacroActionConfig


@configuration
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

    budget: Whole = 60000
    batch_size: Count = 8
    guided: Share = 0.8
    longest: Count = 10
    kept: Count = 6
    greed: NonNegative = 4.0
    stride: NonNegative = 6.0
    least_stride: Whole = 2
    unknown_hops: Whole = 2
    patience: Positive = 10.0
    weariness: Positive = 10.0
    try_cost: NonNegative = 2.0
    stuck: Whole = 24
    template_noise: NonNegative = 0.1
    graph: TransitionGraphConfig = TransitionGraphConfig()
    macro_actions: MacroActionConfig = MacroActionConfig()
