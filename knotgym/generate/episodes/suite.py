"""The fixed benchmark: four policies' episodes on nine setups and two sets of states.

    {out}/knotgym/{task}-nx{nx}/{policy}-v0                 on readable states
    {out}/knotgym/{task}-nx{nx}/{policy}-random-walk-v0     on random-walk states
    {out}/knotgym/suite.json, README.md                     sizes, seeds, checksums; the card

Every dataset is an ordinary collection, see `collect`. This module defines which ones there are,
their order, the estimate of the time they take, and one card for all.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import knotgym
from knotgym.common.atomic_files import Occupied, atomic_write, require_output, sha256
from knotgym.common.configuration import read_json
from knotgym.common.errors import KnotgymError, one_line
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import MIXED, PolicyConfig
from knotgym.envs.tasks import TASKS, TaskConfig
from knotgym.generate.episodes.collect import (
    REPORT,
    CollectConfig,
    EpisodeRecipe,
    collect,
    plain_id,
    reference_scores,
)
from knotgym.generate.episodes.suite_card import suite_card
from knotgym.generate.episodes.suite_scores import read_scores
from knotgym.rope.engines import ENGINES, MUJOCO
from knotgym.runs.engine import is_finished, request_of, require_resumable, whole_request
from knotgym.runs.executors import cores
from knotgym.runs.progress import Progress, duration
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import has_work, require_no_interrupted_run, staging_folder
from knotgym.states.state_file import minari_root

SETUPS = tuple((task, nx) for task in TASKS for nx in (2, 3, 4))
POLICIES = MIXED  # random, scripted, noisy-expert, expert: cheapest first
STATES = ("readable", "random-walk")
EPISODES = {"random": 250, "scripted": 500, "noisy-expert": 150, "expert": 1000}
# Chosen to fit in eight hours. With the default of 20,000 all timed episodes succeeded, but
# tie and convert at nx 4 took 13 to 50 s each; with 1,000 they take 4 to 7 s, and some fail.
BUDGET = 1000
SEED = 1
_FORMAT = "knotgym-suite"
_CARD = ("suite.json", "README.md")
_RATES = Path(__file__).parent / "data" / "suite_rates.json"


class InvalidSuite(KnotgymError, ValueError):
    """The requested benchmark, or part of it, can't be made."""


@dataclass(frozen=True, kw_only=True)
class SuiteConfig:
    """Which part of the benchmark to make; all of it by default.

    Attributes:
        tasks, nx: every task is combined with every number of crossings.
        policies: a subset of POLICIES.
        states: a subset of STATES.
        episodes: policy -> episodes per setup and set of states.
        engine: see `TaskConfig`; other engines than MuJoCo have ids of their own.
        observation: stored observation, see `TaskConfig`; pictures can be drawn from any of them.
        budget: simulated actions per episode for expert planning, see `PlannerConfig`.
        seed: random seed of every dataset.
    """

    tasks: tuple[str, ...] = tuple(TASKS)
    nx: tuple[int, ...] = (2, 3, 4)
    policies: tuple[str, ...] = POLICIES
    states: tuple[str, ...] = STATES
    episodes: Mapping[str, int] = field(default_factory=lambda: dict(EPISODES))
    engine: str = MUJOCO
    observation: str = "state"
    budget: int = BUDGET
    seed: int = SEED

    def __post_init__(self) -> None:
        for name, known in {
            "tasks": tuple(TASKS),
            "nx": (2, 3, 4),
            "policies": POLICIES,
            "states": STATES,
        }.items():
            given = getattr(self, name)
            wrong = [one for one in given if one not in known]
            if wrong or not given:
                raise InvalidSuite(
                    f"the suite's {name} must be among {', '.join(map(str, known))}; got"
                    f" {', '.join(map(str, wrong)) or 'none'}"
                )
        unknown = [one for one in self.episodes if one not in POLICIES]
        if unknown:
            raise InvalidSuite(
                f"episodes are set for {', '.join(POLICIES)}; got {', '.join(unknown)}"
            )
        object.__setattr__(self, "episodes", {**EPISODES, **self.episodes})
        for _ in self.sets():  # raises if a size, seed or observation is invalid
            pass

    def sets(self) -> Iterator[CollectConfig]:
        """Yield the requested datasets in the order in which they are made.

        Readable states come first; within a set of states, one setup is completed before the next.
        """
        for states in self.states:
            for task in self.tasks:
                for nx in self.nx:
                    for name in self.policies:
                        yield self._set(states, task, nx, name)

    def _set(self, states: str, task: str, nx: int, name: str) -> CollectConfig:
        policy = PolicyConfig(policy=name, planner=PlannerConfig(budget=self.budget))
        setup = TaskConfig(
            task=task,
            nx=nx,
            states=None if states == STATES[0] else states,
            engine=self.engine,
            observation=self.observation,
        )
        marks = ("" if states == STATES[0] else states, *self._seed_mark())
        return CollectConfig(
            task=setup,
            policy=policy,
            episodes=self.episodes[name],
            seed=self.seed,
            dataset_id=plain_id(setup, policy, *marks),
        )

    def _seed_mark(self) -> tuple[str, ...]:
        return () if self.seed == SEED else (f"seed{self.seed}",)


def core_seconds(config: CollectConfig) -> float:
    """Return the estimated cost of a dataset in core seconds, from `data/suite_rates.json`.

    The rates are CPU seconds per episode, the mean of 2 to 8 episodes on a shared machine; where a
    noisy expert wasn't timed, 1.5 times the expert's. They hold for BUDGET.
    """
    rates: dict[str, Any] = json.loads(_RATES.read_text(encoding="utf-8"))
    setup = f"{config.task.task}-nx{config.task.nx}"
    rate = rates[config.task.states or STATES[0]][setup][config.policy.policy]
    return float(rate) * config.episodes


def make_suite(
    config: SuiteConfig,
    out: Path | None,
    options: RunOptions,
    *,
    scores: Sequence[Path] = (),
    progress: Progress | None = None,
) -> Path:
    """Make the missing datasets and a card for all existing ones; return the card's folder.

    Args:
        config: which datasets to make.
        out: Minari root to write to; None for Minari's own.
        options: how to execute the runs. With `resume`, finished datasets are kept and interrupted
            ones continued; with `overwrite`, each is replaced once the new one is complete.
        scores: files of `knotgym evaluate --out` for the card's table of results, besides those in
            the folder `evaluations` next to the card.
        progress: where to show progress; a new display by default.

    Raises:
        Occupied: a dataset or a card exists, or an interrupted run left work, and `options` don't
            say what to do with it.
        InvalidRun: an existing dataset was made by another request.
        InvalidSuite, InvalidScores: an existing dataset or an evaluation can't be read.
    """
    if progress is None:
        with Progress(options.quiet) as progress:
            return make_suite(config, out, options, scores=scores, progress=progress)
    root = Path(out) if out is not None else minari_root()
    folder = root / "knotgym"
    wanted = list(config.sets())
    results = read_scores([*scores, *sorted((folder / "evaluations").glob("*.json"))])
    left = [one for one in wanted if not _is_made(one, root, options)]
    _require_own_card(folder, options)
    progress.say(_forecast(wanted, left, options))
    told = _described(config, root)
    _write_card(told, results, config.seed, folder)
    for number, one in enumerate(left, 1):
        progress.say(f"set {number} of {len(left)}: {one.dataset_id}, {one.episodes} episodes")
        begun = has_work(staging_folder(root / one.dataset_id))
        collect(one, root, replace(options, resume=options.resume and begun), progress=progress)
        told[one.dataset_id] = describe_set(root / one.dataset_id)
        _write_card(
            told, results, config.seed, folder
        )  # so that the card is current during the run
    progress.say(f"{folder}: {len(wanted)} sets, README.md, suite.json")
    return folder


def _is_made(one: CollectConfig, root: Path, options: RunOptions) -> bool:
    """Whether a dataset of the same request is finished.

    Raises:
        Occupied, InvalidRun: as in `make_suite`.
    """
    made = root / one.dataset_id
    request = whole_request(EpisodeRecipe(one, options).request(), options.shard)
    require_no_interrupted_run(made, options)
    if has_work(staging_folder(made)):
        if options.resume:
            left = request_of(staging_folder(made))
            require_resumable(staging_folder(made), left, request, ())
        return False
    if is_finished(made, request, options):
        return True
    if os.path.lexists(made) and not options.overwrite:
        raise Occupied(
            f"{made} exists already; --resume keeps finished datasets and makes the rest,"
            " --overwrite makes all of them again"
        )
    require_output(made, folder=True, overwrite=options.overwrite)
    return False


def _require_own_card(folder: Path, options: RunOptions) -> None:
    """Require that the card replaces only files of a suite.

    Raises:
        Occupied: it would replace another file, and `options` don't say overwrite.
    """
    try:
        own = read_json(folder / "suite.json")["format"] == _FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        own = False
    if not (own and options.resume):
        for name in _CARD:
            require_output(folder / name, folder=False, overwrite=options.overwrite)


def _forecast(
    wanted: Sequence[CollectConfig], left: Sequence[CollectConfig], options: RunOptions
) -> str:
    workers = options.workers or cores()
    episodes = sum(one.episodes for one in left)
    spent = sum(map(core_seconds, left)) / workers
    finished = f", {len(wanted) - len(left)} finished already" if len(left) < len(wanted) else ""
    return (
        f"{len(wanted)} sets{finished}; {episodes} episodes to play, about"
        f" {duration(math.ceil(spent))} with {workers} workers, each a core of its own"
    )


def _described(config: SuiteConfig, root: Path) -> dict[str, Any]:
    """Describe every existing dataset of the benchmark, of this run or earlier ones, by id."""
    whole = SuiteConfig(observation=config.observation, seed=config.seed)
    ids = [one.dataset_id for engine in ENGINES for one in replace(whole, engine=engine).sets()]
    return {name: describe_set(root / name) for name in ids if (root / name).exists()}


def describe_set(made: Path) -> dict[str, Any]:
    """Return the size, seed and checksums of a finished dataset.

    Raises:
        InvalidSuite: it wasn't made by `knotgym collect`.
    """
    try:
        said = read_json(made / "data" / REPORT)
        config, tally = said["config"], said["tally"]
        files = {name: made / "data" / name for name in ("main_data.hdf5", "metadata.json")}
        return {
            "task": config["task"]["task"],
            "nx": config["task"]["nx"],
            "split": config["task"]["split"],
            "states": config["task"]["states"] or STATES[0],
            "engine": config["task"]["engine"],
            "observation": config["task"]["observation"],
            "policy": config["policy"]["policy"],
            "seed": config["seed"],
            "episodes": tally["kept"],
            "succeeded": tally["succeeded"],
            "steps": tally["steps"],
            "bytes": sum(file.stat().st_size for file in files.values()),
            "sha256": {name: sha256(file) for name, file in files.items()},
            "versions": said["versions"],
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidSuite(
            f"{made} is none of the suite's sets ({one_line(error)}); remove it"
        ) from error


def _write_card(
    told: Mapping[str, Any], results: Sequence[Mapping[str, Any]], seed: int, folder: Path
) -> None:
    report = {
        "format": _FORMAT,
        "format_version": 1,
        "knotgym": knotgym.__version__,
        "seed": seed,
        "sets": told,
        "results": list(results),
    }
    folder.mkdir(parents=True, exist_ok=True)
    texts = (
        json.dumps(report, indent=1, sort_keys=True) + "\n",
        suite_card(report, reference_scores()),
    )
    for name, text in zip(_CARD, texts, strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
