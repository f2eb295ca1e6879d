"""The fixed benchmark: for each of nine set-ups the episodes of four policies, on two sets of
states, always of the train split, with one card over all of them.

    {out}/knotgym/{task}-nx{nx}/{policy}-v0                 on readable states
    {out}/knotgym/{task}-nx{nx}/{policy}-random-walk-v0     on random-walk states
    {out}/knotgym/suite.json, README.md                     sizes, seeds, checksums; the card

Every set is a collection like any other, see `collect`: this only says which, in which order, and
how long all of them will take.
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
from knotgym.atomic_files import Occupied, atomic_write, require_output, sha256
from knotgym.configuration import read_json
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import MIXED, PolicyConfig
from knotgym.datasets.states import minari_root
from knotgym.errors import KnotgymError, one_line
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
from knotgym.runs.engine import is_finished, request_of, require_resumable, whole_request
from knotgym.runs.executors import cores
from knotgym.runs.progress import Progress, duration
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import has_work, require_no_interrupted_run, staging_folder
from knotgym.tasks import TASKS, TaskConfig

SETUPS = tuple((task, nx) for task in TASKS for nx in (2, 3, 4))
POLICIES = MIXED  # random, scripted, noisy-expert, expert: cheapest first
STATES = ("readable", "random-walk")
EPISODES = {"random": 250, "scripted": 500, "noisy-expert": 150, "expert": 1000}
# for the sake of eight hours: with 20,000, as elsewhere, every episode that was timed reached its
# goal, but tie and convert at nx 4 took 13 to 50 s each; with this they take 4 to 7, and some fail
BUDGET = 1000
SEED = 1
_FORMAT = "knotgym-suite"
_CARD = ("suite.json", "README.md")
_RATES = Path(__file__).parent / "data" / "suite_rates.json"


class InvalidSuite(KnotgymError, ValueError):
    """A benchmark, or a part of it, that can't be made as asked."""


@dataclass(frozen=True, kw_only=True)
class SuiteConfig:
    """Which part of the benchmark; all of it by default.

    Attributes:
        tasks, nx: set-ups, each task with each number of crossings.
        policies: of POLICIES.
        states: of STATES.
        episodes: policy -> played in each set-up, on each set of states.
        observation: stored, see `TaskConfig`; pictures can be drawn from any of them.
        budget: actions that the experts may simulate for an episode, see `PlannerConfig`.
        seed: of every set.
    """

    tasks: tuple[str, ...] = tuple(TASKS)
    nx: tuple[int, ...] = (2, 3, 4)
    policies: tuple[str, ...] = POLICIES
    states: tuple[str, ...] = STATES
    episodes: Mapping[str, int] = field(default_factory=lambda: dict(EPISODES))
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
                    f"the suite's {name} are of {', '.join(map(str, known))}; got"
                    f" {', '.join(map(str, wrong)) or 'none'}"
                )
        unknown = [one for one in self.episodes if one not in POLICIES]
        if unknown:
            raise InvalidSuite(
                f"episodes are told of {', '.join(POLICIES)}; got {', '.join(unknown)}"
            )
        object.__setattr__(self, "episodes", {**EPISODES, **self.episodes})
        for _ in self.sets():  # refuses sizes, seeds and observations that no collection has
            pass

    def sets(self) -> Iterator[CollectConfig]:
        """Every set asked for, in the order in which they are made: a set-up whole, then another,
        and all of the readable states first.
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
    """What a set costs on one core, from `data/suite_rates.json`: CPU seconds an episode, the mean
    of 2 to 8 on a machine that others used, and where a noisy expert wasn't timed, 1.5 times the
    expert's. They hold for BUDGET; a larger one takes longer.
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
    """Make the sets that aren't there, then the card over all that are, and return its folder.

    Args:
        config: which sets.
        out: the root under which Minari would find them; None for Minari's own.
        options: how it is done. With `resume` sets that are finished are left alone and a set that
            was interrupted goes on; with `overwrite` each is replaced once its new one is whole.
        scores: files of `knotgym evaluate --out`, for the card's table of results; those in the
            folder `evaluations` beside the card are taken as well.
        progress: to show it on.

    Raises:
        Occupied: a set or a card exists, or a set is begun, and it wasn't said what becomes of it.
        InvalidRun: one is there that was asked for differently.
        InvalidSuite: an evaluation can't be read.
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
        _write_card(told, results, config.seed, folder)  # for whoever looks in meanwhile
    progress.say(f"{folder}: {len(wanted)} sets, README.md, suite.json")
    return folder


def _is_made(one: CollectConfig, root: Path, options: RunOptions) -> bool:
    """Whether a set is finished, as it is asked for now.

    Raises:
        Occupied, InvalidRun: as of `make_suite`.
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
            f"{made} exists already; --resume leaves finished sets alone and goes on with the rest,"
            " --overwrite makes all of them anew"
        )
    require_output(made, folder=True, overwrite=options.overwrite)
    return False


def _require_own_card(folder: Path, options: RunOptions) -> None:
    """Refuse to write the card over files that no suite wrote.

    Raises:
        Occupied: there is such a file, and `overwrite` wasn't asked for.
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
    """Every set of the benchmark that is there, be it of this run or of another, by its id."""
    whole = SuiteConfig(observation=config.observation, seed=config.seed)
    ids = [one.dataset_id for one in whole.sets()]
    return {name: describe_set(root / name) for name in ids if (root / name).exists()}


def describe_set(made: Path) -> dict[str, Any]:
    """Size, seed and checksums of a finished set.

    Raises:
        InvalidSuite: it isn't one that `knotgym collect` made.
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
