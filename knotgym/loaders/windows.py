"""Windows over transitions: n steps, chunks of actions, stacks, histories, and sampled goals.

    states   s0  s1  s2  s3      transition t leads from s[t] to s[t + 1]
    actions    a0  a1  a2

    n_step=2  at t=0    rewards r0 + discount r1, next observation s2, its bootstrap discount ** 2
    chunk=2   at t=2    actions a2 0, of which the mask keeps the first
    stack=2   at t=0    observations s0 s0: the first one is repeated, as in Gymnasium's
                        FrameStackObservation and in OGBench
    history=2 at t=1    the actions before s1: 0 a0, of which the mask keeps the second

No window leaves its segment. The names and meanings of goal sampling are those of HIQL and OGBench.
"""

from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from knotgym.common import Ids, InvalidInput, Seed, Share, configuration


@configuration
class GoalSampling:
    """How the goal of each transition is drawn among the states of the dataset.

    A transition succeeds if the state after it shows the Gauss code of the goal, for as many
    consecutive steps as the task's `hold`. States that are towed beyond the task's bound, or in
    which the simulation blew up, never succeed.

    Attributes:
        p_currgoal: probability of the state before the transition.
        p_trajgoal: probability of a later state of its episode.
        p_randomgoal: probability of any state of the dataset.
        geom_sample: True to draw the later state a geometric number of transitions ahead, with
            the discount of the `Window`, at most the last state; False to draw it uniformly.
        gc_negative: True for reward 0 on success and -1 otherwise; False for 1 and 0.
        negatives: goals per transition that show other codes than its own goal, drawn uniformly,
            for contrastive learners.
        seed: of the goals of loaders that draw them once (arrays, TensorDict, d3rlpy).
    """

    p_currgoal: Share = 0.2
    p_trajgoal: Share = 0.5
    p_randomgoal: Share = 0.3
    geom_sample: bool = True
    gc_negative: bool = True
    negatives: NonNegativeInt = 0
    seed: Seed = 0

    def __post_init__(self) -> None:
        chances = self.p_currgoal, self.p_trajgoal, self.p_randomgoal
        if not np.isclose(sum(chances), 1):
            names = "p_currgoal, p_trajgoal and p_randomgoal"
            raise InvalidInput(f"{names} must be probabilities that sum to 1, got {chances}")

    def draw(
        self, states: Ids, last: Ids, count: int, discount: float, rng: np.random.Generator
    ) -> Ids:
        """Draw the goals of n transitions.

        Args:
            states: (n,), the states before them.
            last: (n,), the last state of each one's segment.
            count: number of states to draw random goals from.
            discount: of the geometric distribution.
            rng: generator of the draws.

        Returns:
            (n,), indices of states.
        """
        if self.geom_sample:
            ahead = rng.geometric(1 - discount, len(states))
        else:
            ahead = rng.integers(1, last - states + 1)
        later = np.minimum(states + ahead, last)
        anywhere = rng.integers(count, size=len(states))
        chance = rng.random(len(states))
        drawn = np.where(chance < 1 - self.p_randomgoal, later, anywhere)
        return np.where(chance < self.p_currgoal, states, drawn)


@configuration
class Window:
    """What a loader gives with each transition.

    Attributes:
        n_step: transitions from the observation to the next one; fewer where the episode ends.
        discount: discount per pull of rewards and of the bootstrap.
        chunk: actions from the observation on; None for one, without an axis of its own.
        stack: observations up to the present one; None for one, without an axis of its own.
        history: actions before the observation; None for none.
        goals: how goals are drawn; None for each episode's own goal.
    """

    n_step: PositiveInt = 1
    discount: Annotated[PositiveFloat, Field(le=1)] = 0.99
    chunk: PositiveInt | None = None
    stack: PositiveInt | None = None
    history: PositiveInt | None = None
    goals: GoalSampling | None = None

    def __post_init__(self) -> None:
        if self.goals is not None and self.goals.geom_sample and self.discount == 1:
            raise InvalidInput(
                "goals can't be drawn geometrically with discount 1: use a smaller discount, or"
                " geom_sample=False"
            )
