"""The fixed benchmark: four policies' episodes on nine setups and two sets of states.

    {out}/knotgym/{task}-nx{nx}/{policy}-v0                 on readable states
    {out}/knotgym/{task}-nx{nx}/{policy}-random-walk-v0     on random-walk states
    {out}/knotgym/suite.json, README.md                     sizes, seeds, checksums; the card

Every dataset is an ordinary collection, see `collect`. This module defines which ones there are,
their order, the estimate of the time they take, and one card for all.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import knotgym
from knotgym.common.atomic_files import Occupied, atomic_write, require_output, sha256
from knotgym.common.configuration import InvalidConfig, read_json
from knotgym.common.errors import one_line
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import PolicyConfig
from knotgym.datasets.cards.citation import code_span, filled, plain
from knotgym.datasets.cards.state_card import table
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import (
    REPORT,
    CollectConfig,
    EpisodeRecipe,
    collect,
    plain_id,
)
from knotgym.generate.episodes.results import reference_scores
from knotgym.generate.episodes.suite_scores import SUITE, read_scores, score_tables
from knotgym.rope.engines import ENGINES, MUJOCO
from knotgym.runs.engine import is_finished, request_of, require_resumable, whole_request
from knotgym.runs.executors import cores
from knotgym.runs.progress import Progress, duration
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import has_work, require_no_interrupted_run, staging_folder
from knotgym.states.state_file import minari_root

POLICIES, STATES = tuple(SUITE["policies"]), tuple(SUITE["states"])
SETUPS = tuple(product(SUITE["tasks"], SUITE["nx"]))
_FORMAT = "knotgym-suite"
_CARD = ("suite.json", "README.md")


@dataclass(frozen=True, kw_only=True)
class SuiteConfig:
    """Which part of the benchmark to make; all of it by default, see `data/suite.toml`.

    Attributes:
        tasks: tasks, comma-separated: unknot, tie, convert.
        nx: numbers of crossings, from 2 to 4: 3 or 2,3.
        policies: policies, comma-separated: random, scripted, noisy, expert.
        states: sets of states, comma-separated: readable, random-walk.
        episodes: policy -> episodes per setup and set of states.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
            Every engine but MuJoCo has ids of its own.
        observation: observation to store: pixels, state, both or symbolic. Pictures can be drawn
            from any of them.
        budget: simulated actions per episode for expert planning.
        seed: random seed of every dataset; not 0, the default of `evaluate`, whose episodes on the
            train split would then start like those of the datasets.
    """

    tasks: tuple[str, ...] = tuple(SUITE["tasks"])
    nx: tuple[int, ...] = tuple(SUITE["nx"])
    policies: tuple[str, ...] = POLICIES
    states: tuple[str, ...] = STATES
    episodes: Mapping[str, int] = field(default_factory=dict)
    engine: str = MUJOCO
    observation: str = SUITE["observation"]
    budget: int = SUITE["budget"]
    seed: int = SUITE["seed"]

    def __post_init__(self) -> None:
        for name in ("tasks", "nx", "policies", "states"):
            some, known = getattr(self, name), SUITE[name]
            wrong = [one for one in some if one not in known]
            if wrong or not some:
                raise InvalidConfig(
                    f"the suite's {name} must be among {', '.join(map(str, known))}; got"
                    f" {', '.join(map(str, wrong)) or 'none'}"
                )
        if unknown := [one for one in self.episodes if one not in POLICIES]:
            raise InvalidConfig(
                f"episodes are set for {', '.join(POLICIES)}; got {', '.join(unknown)}"
            )
        object.__setattr__(self, "episodes", {**SUITE["episodes"], **self.episodes})
        for _ in self.sets():  # raises if a size, seed or observation is invalid
            pass

    def sets(self) -> Iterator[CollectConfig]:
        """Yield the requested datasets in the order in which they are made.

        Readable states come first; within a set of states, one setup is completed before the next.
        """
        seed_mark = () if self.seed == SUITE["seed"] else (f"seed{self.seed}",)
        for states, task, nx, name in product(self.states, self.tasks, self.nx, self.policies):
            policy = PolicyConfig(policy=name, planner=PlannerConfig(budget=self.budget))
            own = None if states == STATES[0] else states
            setup = TaskConfig(
                task=task, nx=nx, states=own, engine=self.engine, observation=self.observation
            )
            yield CollectConfig(
                task=setup,
                policy=policy,
                episodes=self.episodes[name],
                seed=self.seed,
                dataset_id=plain_id(setup, policy, own or "", *seed_mark),
            )


def core_seconds(config: CollectConfig) -> float:
    """Return the estimated cost of a dataset in core seconds, from `data/suite.toml`."""
    task = config.task
    rates = SUITE["rates"][task.states or STATES[0]][f"{task.task}-nx{task.nx}"]
    return float(rates[config.policy.policy]) * config.episodes


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
        Occupied: a dataset, a card or an interrupted run is in the way.
        InvalidRun: an existing dataset was made by another request.
        InvalidConfig, InvalidScores: an existing dataset or an evaluation can't be read.
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
        _write_card(told, results, config.seed, folder)  # the card is current during the run
    progress.say(f"{folder}: {len(wanted)} sets, README.md, suite.json")
    return folder


def _is_made(one: CollectConfig, root: Path, options: RunOptions) -> bool:
    """Whether a dataset of the same request is finished; raises as `make_suite` does."""
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
    """Raise Occupied if the card replaces other files than a suite's, unless `options`
    overwrite.
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
    """Return the size, seed and checksums of a finished dataset, made by `knotgym collect`."""
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
        raise InvalidConfig(
            f"{made} is none of the suite's sets ({one_line(error)}); remove it"
        ) from error


def _write_card(
    sets: Mapping[str, Any], results: Sequence[Mapping[str, Any]], seed: int, folder: Path
) -> None:
    report = {
        "format": _FORMAT,
        "format_version": 1,
        "knotgym": knotgym.__version__,
        "seed": seed,
        "sets": sets,
        "results": list(results),
    }
    folder.mkdir(parents=True, exist_ok=True)
    texts = json.dumps(report, indent=1, sort_keys=True) + "\n", suite_card(report)
    for name, text in zip(_CARD, texts, strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")


def suite_card(report: Mapping[str, Any]) -> str:
    """Return the card of the benchmark as Markdown; `report` is the content of suite.json."""
    sets = report["sets"]
    columns = "id states engine policy seed episodes steps".split()
    head = (*columns, "reached the goal", "MB", "SHA-256 of main_data.hdf5")
    rows = [
        (
            *(code_span(name), *(plain(one[key]) for key in ("states", "engine", "policy"))),
            *(one["seed"], one["episodes"], one["steps"]),
            f"{100 * one['succeeded'] / max(one['episodes'], 1):.1f} %",
            f"{one['bytes'] / 1e6:.1f}",
            f"`{one['sha256']['main_data.hdf5'][:16]}...`",
        )
        for name, one in sorted(sets.items())
    ]
    references = [
        (setup, f"{one['random']:.2f}", f"{one['expert']:.2f}", one["episodes"])
        for setup, one in reference_scores().items()
    ]
    none = ["", "None yet: no evaluation file lies in `evaluations`."]
    return filled(
        "suite_card.md",
        count=len(sets),
        episodes=sum(one["episodes"] for one in sets.values()),
        steps=sum(one["steps"] for one in sets.values()),
        version=report["knotgym"],
        seed=report["seed"],
        sets=table(head, rows),
        references=table(("set-up", "random", "expert", "episodes"), references),
        results=score_tables(report["results"], "###") or none,
    )
