"""Collection: a policy's episodes as a Minari dataset, by any number of processes, whatever kills
them.

Episodes are played in shards of a few, each written by one process and merged at the end; an
episode depends on the seed and its number alone, so the dataset's bytes don't depend on the
processes. While it runs, everything stands in a hidden folder beside the dataset; finished shards
outlive a kill.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

import knotgym
from knotgym.atomic_files import atomic_write, sha256
from knotgym.control.policies import PolicyConfig, make_policy
from knotgym.control.rollouts import rollout
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.minari_dataset import MinariMetadata, publish
from knotgym.datasets.minari_folder import minari_root
from knotgym.datasets.states import states_file
from knotgym.errors import KnotgymError
from knotgym.rope import RopeConfig
from knotgym.runs.executors import engine
from knotgym.runs.shards import Shard
from knotgym.runs.staging import Occupied, staging, staging_folder
from knotgym.tasks import TaskConfig

SHARD = 4  # episodes; part of the format of a run under way, not of a dataset
REPORT = "collection.json"
_WHOLE = Shard()
_REFERENCES = Path(__file__).parent / "data" / "references.json"


class InvalidCollection(KnotgymError, ValueError):
    """A collection that cannot be made as asked."""


@dataclass(frozen=True, kw_only=True)
class CollectConfig:
    """What is collected.

    Attributes:
        task: the environment, whose `observation` is stored.
        policy: who acts.
        episodes: played.
        seed: of the run; episode i is that of `rollouts.episode_seed(seed, i)`.
        keep_failed: keep episodes that didn't reach the goal.
        dataset_id: of Minari; "" for knotgym/tie-nx3/expert-v0 and the like.
        author, author_email, code_permalink: for Minari's metadata.
    """

    task: TaskConfig
    policy: PolicyConfig
    episodes: int = 200
    seed: int = 0
    keep_failed: bool = True
    dataset_id: str = ""
    author: tuple[str, ...] = ()
    author_email: tuple[str, ...] = ()
    code_permalink: str | None = None

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise InvalidCollection(f"episodes must be at least 1, got {self.episodes}")
        if self.seed < 0:
            raise InvalidCollection(f"seed must be at least 0, got {self.seed}")
        if not self.dataset_id:
            object.__setattr__(
                self,
                "dataset_id",
                f"knotgym/{self.task.task}-nx{self.task.nx}/{self.policy.short}-v0",
            )

    @property
    def stored_task(self) -> TaskConfig:
        """The environment as the dataset names it: states that don't ship are carried along, and
        found by the dataset's id.
        """
        return self.task if self.task.states is None else replace(self.task, states=self.dataset_id)


class _EpisodeFile(NamedTuple):
    """Work for one process: episodes `numbers`, to `path`."""

    config: CollectConfig
    numbers: range
    path: Path


@dataclass(frozen=True, kw_only=True)
class Tally:
    """What was collected; sums over episodes.

    Attributes:
        played, succeeded, kept: episodes.
        steps: actions, of the kept episodes.
        successful_steps: actions, of those that succeeded.
        planned_actions: simulated while planning.
        planning_seconds: that took; the only number here that is not the same in every run.
        simulation_failures: episodes that ended because the simulation blew up.
    """

    played: int = 0
    succeeded: int = 0
    kept: int = 0
    steps: int = 0
    successful_steps: int = 0
    planned_actions: int = 0
    planning_seconds: float = 0.0
    simulation_failures: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            **{
                field.name: getattr(self, field.name) + getattr(other, field.name)
                for field in fields(self)
            }
        )


def collect(
    config: CollectConfig,
    out: Path | None,
    *,
    workers: int,
    resume: bool,
    quiet: bool,
    console: Console,
    scheduler: str = "",
    shard: Shard = _WHOLE,
) -> Path:
    """Make the dataset and return its folder.

    Args:
        config: what is collected.
        out: the root under which Minari would find the id; None for Minari's own.
        workers: processes, 0 for one a core.
        resume: go on with the shards that are there; with a finished dataset of the same settings
            there is nothing to do.
        quiet: show nothing.
        console: to show progress on.
        scheduler: address of a Dask cluster's, to work there.
        part: of the run, whose episodes go to a folder NAME-shard-2-of-8 with main_data.hdf5 and
            collection.json; Minari doesn't list it.

    Raises:
        Occupied: there is something in the way, or another run is at it.
        InvalidCollection: what is resumed was another collection, or no episode is left to keep.
    """
    if workers < 0:
        raise InvalidCollection(f"workers must be at least 0, got {workers}")
    make_policy(config.policy)  # refuses what isn't there before any work is done
    _metadata(config, Tally())  # refuses a bad id
    root = Path(out) if out is not None else minari_root()
    folder = shard.folder(root / config.dataset_id)
    settings = json.loads(json.dumps({**asdict(config), "shard": asdict(shard)}))
    numbers = shard.share(config.episodes)
    if not numbers:
        raise InvalidCollection(
            f"shard {shard} of {config.episodes} episodes has none: cut the run into fewer shards"
        )
    if folder.exists():
        if resume and settings_of(folder) == settings:
            # killed between its last two steps
            shutil.rmtree(staging_folder(folder), ignore_errors=True)
            if not quiet:
                console.print(f"{folder} is finished already", soft_wrap=True)
            return folder
        raise Occupied(f"{folder} is there already; choose another --out or --id, or remove it")
    began = time.perf_counter()
    with staging(folder, resume) as partial:
        if settings_of(partial) not in (None, settings):
            raise InvalidCollection(
                f"{partial} holds another collection than the one asked for; give the same options"
                " again, or start without --resume"
            )
        with atomic_write(partial / REPORT) as file:
            file.write_text(json.dumps({"config": settings}))
        shards = [
            _EpisodeFile(
                config, numbers[first : first + SHARD], partial / f"shard-{first // SHARD:06d}.h5"
            )
            for first in range(0, len(numbers), SHARD)
        ]
        tally = _play_all(shards, workers, scheduler, quiet, console)
        staged = partial / "whole"
        shutil.rmtree(staged, ignore_errors=True)
        made = (
            write_whole(config, [shard.path for shard in shards], tally, staged)
            if shard.is_whole
            else staged
        )
        if not shard.is_whole:
            made.mkdir()
            merge_episodes([shard.path for shard in shards], made / "main_data.hdf5")
            _report(
                made / REPORT, settings, tally, {"main_data.hdf5": sha256(made / "main_data.hdf5")}
            )
        made.rename(folder)
        shutil.rmtree(partial)
    if not quiet:
        seconds = time.perf_counter() - began
        lost = tally.played - tally.succeeded
        console.print(
            f"{folder}: {tally.kept} episodes, {tally.steps} steps; {tally.succeeded} of"
            f" {tally.played} reached the goal, {lost} failed"
            f" ({'kept' if config.keep_failed else 'dropped'}); planning"
            f" {tally.planned_actions / tally.played:.0f} simulated actions and"
            f" {tally.planning_seconds / tally.played:.1f} s an episode; {seconds:.0f} s",
            soft_wrap=True,
            highlight=False,
        )
    return folder


def write_whole(
    config: CollectConfig,
    sources: Sequence[Path],
    tally: Tally,
    root: Path,
    *,
    concatenate: bool = False,
) -> Path:
    """Write the dataset of a run below `root` from its episodes' files, `concatenate` as of
    `publish`; its folder.

    Raises:
        InvalidCollection: no episode is left.
    """
    if not tally.kept:
        raise InvalidCollection(
            f"none of {tally.played} episodes reached the goal, and failed ones are dropped:"
            " nothing is left to write"
        )
    carried = None if config.task.states is None else states_file(config.task.states)
    made = publish(sources, _metadata(config, tally), root, concatenate=concatenate, states=carried)
    _report(
        made / "data" / REPORT,
        json.loads(json.dumps({**asdict(config), "shard": asdict(_WHOLE)})),
        tally,
    )
    return made


def _report(path: Path, settings: Any, tally: Tally, files: dict[str, str] | None = None) -> None:
    counted = {**asdict(tally), "planning_seconds": round(tally.planning_seconds, 1)}
    said = {
        "config": settings,
        "version": knotgym.__version__,
        "tally": counted,
        **({"files": files} if files else {}),
    }
    path.write_text(json.dumps(said, indent=1, sort_keys=True), encoding="utf-8")


def _play_all(
    shards: Sequence[_EpisodeFile], workers: int, scheduler: str, quiet: bool, console: Console
) -> Tally:
    """Play the shards that aren't finished; the tally of all."""
    done = {shard.path: _finished(shard.path) for shard in shards}
    total = sum((one for one in done.values() if one is not None), Tally())
    todo = [shard for shard in shards if done[shard.path] is None]
    told, began = 0.0, time.perf_counter()
    with engine(workers, scheduler) as pool:
        for number, tally in enumerate(pool.map(play, todo), 1):
            total += tally
            seconds = time.perf_counter() - began
            if not quiet and (seconds - told > 10 or number == len(todo)):
                told = seconds
                left = seconds * (len(todo) - number) / number
                all_episodes = sum(len(shard.numbers) for shard in shards)
                console.print(
                    f"{seconds:5.0f} s  {total.played} of {all_episodes} episodes,"
                    f" {total.succeeded} reached the goal; about {left:.0f} s left",
                    soft_wrap=True,
                    highlight=False,
                )
    return total


def play(shard: _EpisodeFile) -> Tally:
    """Play a shard and write it, then its tally beside it; a shard without a tally isn't
    finished.
    """
    config = shard.config
    rollouts = rollout(config.task, make_policy(config.policy), shard.numbers, config.seed)
    kept = [one for one in rollouts if one.success or config.keep_failed]
    with EpisodeWriter(shard.path, config.stored_task) as writer:
        for one in kept:
            writer.add(one.episode, one.number)
    tally = Tally(
        played=len(rollouts),
        succeeded=sum(one.success for one in rollouts),
        kept=len(kept),
        steps=sum(len(one.episode) for one in kept),
        successful_steps=sum(len(one.episode) for one in rollouts if one.success),
        planned_actions=sum(one.effort.actions for one in rollouts),
        planning_seconds=sum(one.effort.seconds for one in rollouts),
        simulation_failures=sum(bool(one.episode.simulation_failed[-1]) for one in rollouts),
    )
    with atomic_write(shard.path.with_suffix(".json")) as temporary:
        temporary.write_text(
            json.dumps({"sha256": sha256(shard.path), "tally": asdict(tally)}), encoding="utf-8"
        )
    return tally


def _finished(path: Path) -> Tally | None:
    """The tally of a shard that is there and unspoilt."""
    try:
        said = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        return Tally(**said["tally"]) if said["sha256"] == sha256(path) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def settings_of(folder: Path) -> Any:
    """What was asked for of the dataset or shard that is or will be in a folder; None if it doesn't
    say.
    """
    for path in (folder / "data" / REPORT, folder / REPORT):
        try:
            return json.loads(path.read_text(encoding="utf-8"))["config"]
        except (OSError, ValueError, KeyError):
            continue
    return None


def _metadata(config: CollectConfig, tally: Tally) -> MinariMetadata:
    """Minari's metadata, with what is known of random and expert policies on this setup as
    reference scores.
    """
    task, policy = config.task, config.policy
    scores = _references().get(f"{task.task}-nx{task.nx}", {}) if task.rope == RopeConfig() else {}
    noise = (
        f", each pull a random one with probability {policy.noise}"
        if policy.policy in ("noisy-expert", "mixed")
        else ""
    )
    planning = (
        f" Planning took {tally.planned_actions / tally.played:.0f} simulated actions an episode,"
        f" of {policy.planner.budget} allowed."
        if tally.planned_actions
        else ""
    )
    text = (
        f"KnotGym, task {task.task} with {task.nx} crossings, {task.split} split: {tally.kept}"
        f" episodes of policy {policy.policy}{noise}, seed {config.seed}. {tally.succeeded} of"
        f" {tally.played} episodes played reached the goal within {task.horizon} steps; failed ones"
        f" are {'kept' if config.keep_failed else 'dropped'}.{planning}"
    )
    return MinariMetadata(
        dataset_id=config.dataset_id,
        algorithm_name=policy.policy,
        description=text,
        author=config.author,
        author_email=config.author_email,
        code_permalink=config.code_permalink,
        ref_min_score=scores.get("random"),
        ref_max_score=scores.get("expert"),
        num_episodes_average_score=scores.get("episodes"),
    )


def _references() -> dict[str, Any]:
    if not _REFERENCES.is_file():
        return {}
    found: dict[str, Any] = json.loads(_REFERENCES.read_text(encoding="utf-8"))
    return found
