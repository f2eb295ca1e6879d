"""The configurations of `knotgym collect` and `knotgym evaluate`; the command line reads them, so
nothing here computes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Annotated

from pydantic import NonNegativeInt, PositiveInt

from knotgym.common import Distinct, InvalidInput, Seed, Stream, choice, configuration
from knotgym.control import PolicyConfig
from knotgym.envs import OBSERVATIONS, TaskConfig
from knotgym.rope import MUJOCO

if TYPE_CHECKING:
    from knotgym.datasets import Episodes

# Stored by `knotgym collect` by default: vertices, from which loaders draw pictures of any kind.
OBSERVATION = "state"


@configuration
class CollectConfig:
    """Which episodes to collect.

    Attributes:
        task: the environment; its `observation` is stored in Minari's form.
        policy: the acting policy.
        episodes: episodes to play for each dataset.
        steps: keep as many episodes as it takes for so many steps, instead of `episodes`; 0 for
            `episodes`. More steps only add episodes.
        seed: random seed; the same seed gives the same bytes, and the same starts and goals for
            every policy. Episode i has `Stream.EPISODE.derived_seed(seed, i)`.
        keep_failed: keep episodes that didn't reach the goal.
        labels: "expert" stores the expert's action at every state.
        policy_observation: observation given to functions and objects of your own; "" for the one
            that is stored.
        dataset_id: Minari id; "" for one made of the settings, such as knotgym/tie-nx3/expert-v0,
            with a mark for each setting that changes the data, as in expert-both-seed1-v0.
        form: files to write: columns, or minari for Minari's own beside them; by default these are
            written for at most 100,000 pulls. Or recording: starts and pulls alone, about 4 bytes a
            step; `knotgym dataset export --to compact` gets the columns by stepping.
        author: author of the dataset; may be repeated.
        author_email: author's email; may be repeated.
        code_permalink: URL of the code that made it.
    """

    task: TaskConfig = TaskConfig(task="tie", observation=OBSERVATION)
    policy: PolicyConfig = PolicyConfig(policy="expert")
    episodes: PositiveInt = 200
    steps: NonNegativeInt = 0
    seed: Seed = 0
    keep_failed: bool = True
    labels: Annotated[str, choice("", "expert")] = ""
    policy_observation: Annotated[str, choice("", *OBSERVATIONS)] = ""
    dataset_id: str = ""
    form: Annotated[str, choice("", "recording", "columns", "minari")] = ""
    author: tuple[str, ...] = ()
    author_email: tuple[str, ...] = ()
    code_permalink: str | None = None

    @property
    def policy_task(self) -> TaskConfig:
        """The environment with the observation that the policy gets."""
        return replace(self.task, observation=self.policy_observation or self.task.observation)

    def played(self, numbers: range, seed: int) -> Episodes:
        """Play some of the episodes that a collection with this seed has, by their numbers."""
        # both compute, and the command line reads this module first
        from knotgym.control import make_policy, rollouts
        from knotgym.datasets import PULLS, STEPS

        policy = make_policy(self.policy)
        adviser = make_policy(replace(self.policy, policy="expert")) if self.labels else None
        seeds = [Stream.EPISODE.derived_seed(seed, number) for number in numbers]
        kept = PULLS if self.form == "recording" else STEPS
        return rollouts(policy, self.policy_task, seeds, keep=kept, adviser=adviser)


def plain_id(task: TaskConfig, policy: PolicyConfig, *marks: str) -> str:
    """Return the id of a dataset from its task, its policy and further marks."""
    split = "" if task.split == "train" else task.split
    engine = "" if task.engine == MUJOCO else task.engine
    name = "-".join([policy.short, *filter(None, (engine, split, *marks))])
    return f"knotgym/{task.name}/{name}-v0"


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
        for policy, task, split, nx in product(self.policies, self.tasks, self.splits, self.nx):
            yield policy, replace(self.task, task=task, nx=nx, split=split)
