"""The configurations of `knotgym collect`, `evaluate` and `suite`; the command line reads them, so
nothing here computes.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from importlib.resources import files
from itertools import product
from math import prod
from typing import Annotated, Any, ClassVar

from pydantic import Field, NonNegativeInt

from knotgym import control, datasets  # loaded on first use, as the command line reads this
from knotgym.common import Count, Distinct, InvalidInput, Mark, Seed, Stream, choice, configuration
from knotgym.control import PolicyConfig
from knotgym.envs import OBSERVATIONS, TaskConfig
from knotgym.rope import ENGINES, MUJOCO

SUITE: dict[str, Any] = tomllib.loads(
    (files("knotgym.generate") / "data" / "suite.toml").read_text("utf-8")
)
STATES, SPLITS = tuple(SUITE["states"]), tuple(SUITE["splits"])
BENCH, SIZES = "bench", SUITE["bench"]["sizes"]
_PROTOCOL, PROTOCOLS = SUITE["protocol"], SUITE["protocols"]
_MOST_SETUPS = 4096  # of an evaluation, each of which is made before any is played
TIERS = tuple(SUITE["bench"]["policies"])  # policies whose episodes on bench states are a tier

Tasks = Annotated[tuple[Annotated[str, choice(*SUITE["tasks"])], ...], Distinct]
Policies = Annotated[tuple[Annotated[str, choice(*TIERS)], ...], Distinct]
Splits = Annotated[tuple[Annotated[str, choice(*SPLITS)], ...], Distinct]
States = Annotated[tuple[Annotated[str, choice(*STATES, BENCH)], ...], Distinct]
Numbers = Annotated[tuple[Annotated[int, Field(ge=2, le=5)], ...], Distinct]


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

    # vertices by default, from which loaders draw pictures of any kind
    task: TaskConfig = TaskConfig(task="tie", observation="state")
    policy: PolicyConfig = PolicyConfig(policy="expert")
    episodes: Count = 200
    steps: Annotated[NonNegativeInt, Field(le=10**9)] = 0
    seed: Seed = 0
    keep_failed: bool = True
    labels: Annotated[str, choice("", "expert")] = ""
    policy_observation: Annotated[str, choice("", growing=OBSERVATIONS)] = ""
    dataset_id: str = ""
    form: Annotated[str, choice("", "recording", "columns", "minari")] = ""
    author: tuple[str, ...] = ()
    author_email: tuple[str, ...] = ()
    code_permalink: str | None = None

    @property
    def policy_task(self) -> TaskConfig:
        """The environment with the observation that the policy gets."""
        return replace(self.task, observation=self.policy_observation or self.task.observation)

    def played(self, numbers: range, seed: int, columns: Any = None) -> datasets.Episodes:
        """Play some of the episodes that a collection with this seed has, by their numbers.

        `columns` are those of `control.rollouts`.
        """
        policy, expert = control.make_policy(self.policy), replace(self.policy, policy="expert")
        adviser = control.make_policy(expert) if self.labels else None
        seeds = [Stream.EPISODE.derived_seed(seed, number) for number in numbers]
        keep = datasets.PULLS if self.form == "recording" else datasets.STEPS
        more = {"adviser": adviser, "columns": columns}
        return control.rollouts(policy, self.policy_task, seeds, keep=keep, **more)


def _tow_limit(task: str) -> Any:
    return SUITE["settings"].get(task, {}).get("tow_limit")


def plain_id(task: TaskConfig, policy: PolicyConfig, *marks: str) -> str:
    """Return the id of a dataset from its task, its policy and further marks."""
    split = "" if task.split == TaskConfig.split else task.split
    engine = "" if ENGINES[task.engine].is_reference else task.engine
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
        failures: film the first episodes that failed, not the first of all.
        protocol: protocol of the board, which sets what isn't given: code (policies see the goal's
            code alone), goal-state (vertices that show it) or pixels. A setting that differs from
            it is refused.
    """

    policies: tuple[PolicyConfig, ...] = (PolicyConfig(),)
    tasks: tuple[str, ...] = ("tie",)
    nx: Annotated[tuple[NonNegativeInt, ...], Distinct] = (2,)
    splits: tuple[str, ...] = ("test",)
    episodes: Count = 256
    seed: Seed = 0
    task: TaskConfig = TaskConfig(task="tie", observation="state")
    filmed: Count = 2
    failures: bool = False
    protocol: Annotated[str, choice("", *PROTOCOLS)] = ""

    def __post_init__(self) -> None:
        several = self.policies, self.tasks, self.nx, self.splits
        if not all(several):
            raise InvalidInput("give at least one policy, task, number of crossings and split")
        if (count := prod(map(len, several))) > _MOST_SETUPS:
            raise InvalidInput(f"an evaluation has at most {_MOST_SETUPS} setups, got {count}")
        list(self.setups())  # raises if an environment can't be made
        for fault in self.differences(self.protocol) if self.protocol else ():
            raise InvalidInput(f"protocol {self.protocol} has {fault}")

    @staticmethod
    def of_protocol(name: str, tasks: Sequence[str]) -> dict[str, Any]:
        """Return what a protocol sets for tasks, by the path of the field."""
        return {
            "splits": tuple(_PROTOCOL["splits"]),
            "task.states": _PROTOCOL["states"],
            "task.engine": SUITE[_PROTOCOL["states"]]["engine"],
            "task.observation": PROTOCOLS[name],
            "task.tow_limit": _tow_limit(tasks[0]),
        }

    @staticmethod
    def shows(protocol: str, observation: str) -> bool:
        """Whether a protocol lets policies observe this of the goal."""
        kinds = OBSERVATIONS
        allowed = {*kinds[PROTOCOLS[protocol]].goal, "code"}
        return observation in kinds and allowed >= {*kinds[observation].goal}

    def differences(self, protocol: str) -> Iterator[str]:
        """Yield the settings that aren't a protocol's; what policies observe is their own."""
        limits = [*map(_tow_limit, self.tasks)]
        wanted = TaskConfig(task="tie", states=_PROTOCOL["states"], engine=self.task.engine)
        wanted = replace(wanted, tow_limit=limits[0])
        plain = (replace(task, task="tie", nx=2, split="test") for task in (wanted, self.task))
        rules = [Mark.values(task, "rules", "physics", "look") for task in plain]
        pairs = [
            *((f"task.{name}", wanted, rules[1][name]) for name, wanted in rules[0].items()),
            ("split", (*_PROTOCOL["splits"],), self.splits),
            ("seed", _PROTOCOL["seed"], self.seed),
            ("one task.tow_limit for each of its tasks", limits, limits[:1] * len(limits)),
        ]
        yield from (f"{name} {right}, got {own}" for name, right, own in pairs if own != right)
        if self.episodes < _PROTOCOL["episodes"]:
            yield f"at least {_PROTOCOL['episodes']} episodes, got {self.episodes}"

    def setups(self) -> Iterator[tuple[PolicyConfig, TaskConfig]]:
        """Yield every combination of policy and environment."""
        for policy, task, split, nx in product(self.policies, self.tasks, self.splits, self.nx):
            yield policy, replace(self.task, task=task, nx=nx, split=split)


@configuration
class SuiteConfig:
    """Which part of the benchmark to make; see `data/suite.toml`.

    Attributes:
        tasks: tasks, comma-separated: unknot, tie, convert.
        nx: numbers of crossings, from 2 to 4, and for tie on bench states 5: 3 or 2,3; all by
            default.
        policies: policies, comma-separated: random, noisy, expert, play; on bench states also
            wander (random macro-actions, from the task's starts and goals) and mixed. All by
            default.
        splits: splits, comma-separated: train, whose states are held out from test, and train-code,
            which shares no code with test-code and which bench hasn't. All by default.
        states: sets of states, comma-separated: readable, random-walk; or bench, whose datasets
            are nested tiers of the chain engine.
        size: steps of each tier of bench states: 10k (the default), 100k, 1M or 10M. A tier is the
            beginning of the next.
        episodes: policy -> episodes per dataset; by default those of `data/suite.toml`. Tiers have
            a size instead.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
            Every engine but MuJoCo has ids of its own. Tiers are of the chain engine.
        observation: observation to store: pixels, state, both or symbolic. Pictures can be drawn
            from any of them.
        seed: random seed of every dataset; not 0, the default of `evaluate`, whose episodes on the
            train split would then start like those of the datasets.
        recorded: rebuild datasets from the recordings that are included, by stepping alone. Setups
            without a recording are left out; random episodes follow from the seed.
        verify: make nothing; compare the digest of the values of each set with the known one, see
            docs/suite.md. Exit status 1 if a set isn't there, or isn't the same.
    """

    SUITE: ClassVar[dict[str, Any]] = SUITE  # what `data/suite.toml` says

    tasks: Tasks = tuple(SUITE["tasks"])
    nx: Numbers | None = None
    policies: Policies | None = None
    splits: Splits | None = None
    states: States = STATES
    size: Annotated[str, choice(*SIZES)] | None = None
    episodes: Mapping[Annotated[str, choice(*TIERS)], Count] = field(default_factory=dict)
    engine: str = MUJOCO
    observation: str = SUITE["observation"]
    seed: Seed = SUITE["seed"]
    recorded: bool = False
    verify: bool = False

    def __post_init__(self) -> None:
        if self.size and BENCH not in self.states:
            raise InvalidInput(f"--size {self.size} is of --states {BENCH}, not {self.states[0]}")
        if not [*self.sets()]:  # which raises if a size, seed or observation is invalid
            raise InvalidInput(
                f"no set-up of {', '.join(self.tasks)} with nx"
                f" {', '.join(map(str, self.nx or ()))} on states {', '.join(self.states)}"
            )

    def sets(self) -> Iterator[CollectConfig]:
        """Yield the requested datasets in the order in which they are made.

        The split by state and readable states come first; within them, one setup is completed
        before the next.
        """
        for split, states in product(SPLITS, self.states):
            table = SUITE | SUITE.get(states, {})
            fields = "nx", "policies", "splits"
            asked = {name: self._asked(name, states, table) for name in fields}
            if split not in asked["splits"]:
                continue
            for task, nx, name in product(self.tasks, asked["nx"], asked["policies"]):
                if task in table.get("only", {}).get(str(nx), self.tasks):
                    yield self._set(table, task, nx, split, states, name)

    def _asked(self, name: str, states: str, table: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return the requested values of a field, or all that a set of states has."""
        asked, there = getattr(self, name) or (), table[name]
        if missing := [value for value in asked if value not in there]:
            raise InvalidInput(
                f"{name} of the sets on {states} states must be one of"
                f" {', '.join(map(str, there))}, got {missing[0]}"
            )
        return asked or tuple(there)

    def _set(
        self, table: Mapping[str, Any], task: str, nx: int, split: str, states: str, name: str
    ) -> CollectConfig:
        policy = PolicyConfig(policy=table.get("acting", {}).get(name, name))
        tier = self.size or table["size"] if states == BENCH else ""
        settings = table["settings"].get(task, {}) | table["settings"].get(name, {})
        setup = TaskConfig(
            task=task,
            nx=nx,
            split=split,
            states=None if states == STATES[0] else states,
            engine=table.get("engine", self.engine),
            observation=self.observation,
            **settings,
        )
        seeded = f"seed{self.seed}" * (self.seed != SUITE["seed"])
        dataset_id = plain_id(setup, PolicyConfig(policy=name), setup.states or "", tier, seeded)
        if beside := table.get("beside", {}).get(name, {}).get(task):
            setup = replace(setup, task=(task, beside))
        config = CollectConfig(task=setup, policy=policy, seed=self.seed, dataset_id=dataset_id)
        if not tier:
            sizes = SUITE["episodes"] | SUITE["episodes"].get(task, {})
            size = sizes[name][SUITE["nx"].index(nx)]
            return replace(config, episodes=self.episodes.get(name, size))
        if self.episodes:
            raise InvalidInput(f"sets on {BENCH} states have a --size, not a number of --episodes")
        return replace(config, **SIZES[tier])
