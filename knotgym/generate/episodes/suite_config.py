"""The configuration of `knotgym suite`; nothing here computes: the command line reads it."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import field
from importlib.resources import files
from itertools import product
from typing import Annotated, Any

from pydantic import Field

from knotgym.common.configuration import Count, Distinct, Seed, choice, configuration
from knotgym.control.policy_config import PolicyConfig
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect_config import CollectConfig, plain_id
from knotgym.rope.engines import MUJOCO

SUITE: dict[str, Any] = tomllib.loads(
    (files("knotgym.generate.episodes") / "data" / "suite.toml").read_text("utf-8")
)
POLICIES, STATES, SPLITS = (tuple(SUITE[name]) for name in ("policies", "states", "splits"))

Tasks = Annotated[tuple[Annotated[str, choice(*SUITE["tasks"])], ...], Distinct]
Policies = Annotated[tuple[Annotated[str, choice(*POLICIES)], ...], Distinct]
Splits = Annotated[tuple[Annotated[str, choice(*SPLITS)], ...], Distinct]
States = Annotated[tuple[Annotated[str, choice(*STATES)], ...], Distinct]
Numbers = Annotated[tuple[Annotated[int, Field(ge=2, le=4)], ...], Distinct]


@configuration
class SuiteConfig:
    """Which part of the benchmark to make; all of it by default, see `data/suite.toml`.

    Attributes:
        tasks: tasks, comma-separated: unknot, tie, convert.
        nx: numbers of crossings, from 2 to 4: 3 or 2,3.
        policies: policies, comma-separated: random, noisy, expert, play.
        splits: splits, comma-separated: train, whose states are held out from test, and train-code,
            which shares no code with test-code.
        states: sets of states, comma-separated: readable, random-walk.
        episodes: policy -> episodes per dataset; by default those of `data/suite.toml`.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
            Every engine but MuJoCo has ids of its own.
        observation: observation to store: pixels, state, both or symbolic. Pictures can be drawn
            from any of them.
        seed: random seed of every dataset; not 0, the default of `evaluate`, whose episodes on the
            train split would then start like those of the datasets.
        recorded: rebuild datasets from the recordings that are included, by stepping alone. Setups
            without a recording are left out; random episodes follow from the seed.
    """

    tasks: Tasks = tuple(SUITE["tasks"])
    nx: Numbers = tuple(SUITE["nx"])
    policies: Policies = POLICIES
    splits: Splits = SPLITS
    states: States = STATES
    episodes: Mapping[Annotated[str, choice(*POLICIES)], Count] = field(default_factory=dict)
    engine: str = MUJOCO
    observation: str = SUITE["observation"]
    seed: Seed = SUITE["seed"]
    recorded: bool = False

    def __post_init__(self) -> None:
        for _ in self.sets():  # raises if a size, seed or observation is invalid
            pass

    def sets(self) -> Iterator[CollectConfig]:
        """Yield the requested datasets in the order in which they are made.

        The split by state and readable states come first; within them, one setup is completed
        before the next.
        """
        seed_mark = () if self.seed == SUITE["seed"] else (f"seed{self.seed}",)
        every = product(self.splits, self.states, self.tasks, self.nx, self.policies)
        for split, states, task, nx, name in every:
            policy = PolicyConfig(policy=name)
            own = None if states == STATES[0] else states
            setup = TaskConfig(
                task=task,
                nx=nx,
                split=split,
                states=own,
                engine=self.engine,
                observation=self.observation,
                **SUITE["settings"].get(task, {}),
                **SUITE["settings"].get(name, {}),
            )
            sizes = SUITE["episodes"] | SUITE["episodes"].get(task, {})
            size = sizes[name][SUITE["nx"].index(nx)]
            yield CollectConfig(
                task=setup,
                policy=policy,
                episodes=self.episodes.get(name, size),
                seed=self.seed,
                dataset_id=plain_id(setup, policy, own or "", *seed_mark),
            )
