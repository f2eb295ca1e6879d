"""The configuration of `knotgym evaluate`; nothing here computes: the command line reads it."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated

from pydantic import NonNegativeInt, PositiveInt

from knotgym.common import Distinct, InvalidInput, Seed, configuration
from knotgym.control import PolicyConfig
from knotgym.envs import TaskConfig


@configuration
class EvaluateConfig:
    """What to evaluate.

    Attributes:
        policies: each is evaluated on every task, crossing number and split.
        tasks: tasks, comma-separated: tie, unknot, convert.
        nx: numbers of crossings: 3, 2,3 or 2-4.
        splits: splits, comma-separated: train, test, train-code, test-code.
        episodes: episodes for each policy, task, split and --nx. Episode i is the same for every
            policy.
        seed: random seed; the same seed gives the same episodes, and none of them is in a dataset.
        task: settings shared by all environments; its task, nx and split are not used.
        filmed: episodes per setup in a film.
    """

    policies: tuple[PolicyConfig, ...] = (PolicyConfig(),)
    tasks: tuple[str, ...] = ("tie",)
    nx: Annotated[tuple[NonNegativeInt, ...], Distinct] = (2,)
    splits: tuple[str, ...] = ("test",)
    episodes: PositiveInt = 256
    seed: Seed = 0
    task: TaskConfig = TaskConfig(task="tie", observation="state")
    filmed: PositiveInt = 2

    def __post_init__(self) -> None:
        if not all((self.policies, self.tasks, self.nx, self.splits)):
            raise InvalidInput("give at least one policy, task, number of crossings and split")
        list(self.setups())  # raises if an environment can't be made

    def setups(self) -> Iterator[tuple[PolicyConfig, TaskConfig]]:
        """Yield every combination of policy and environment."""
        for policy in self.policies:
            for task in self.tasks:
                for split in self.splits:
                    for nx in self.nx:
                        yield policy, replace(self.task, task=task, nx=nx, split=split)
