"""Collect a policy's episodes as a Minari dataset, with any number of processes.

Each process plays a few episodes at a time into a file of the staging folder; the files are merged
at the end. An episode depends only on the seed and its number, so the dataset's bytes don't depend
on the processes. A resumed run keeps the files that are finished.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

from knotgym.common.atomic_files import sha256
from knotgym.common.configuration import as_json
from knotgym.common.errors import InvalidInput
from knotgym.control.expert import Expert
from knotgym.control.old_policies import make_policy
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy import Effort
from knotgym.control.rollouts import Rollout, rollout
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.machine import machine
from knotgym.datasets.minari_dataset import MinariMetadata, publish
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import _metadata as _new_metadata
from knotgym.generate.episodes.digests import digests
from knotgym.runs.engine import Batch, Recipe
from knotgym.runs.progress import Status
from knotgym.runs.run_options import RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.states.state_file import read_states, ships, states_file

REPORT = "collection.json"
OBSERVATION = "both"  # stored by `knotgym collect` by default


from knotgym.generate.episodes.collect import (  # noqa: E402
    CollectConfig,
    sources_of,
)


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Totals over episodes."""

    played: int = 0
    succeeded: int = 0
    kept: int = 0
    steps: int = 0
    successful_steps: int = 0
    planned_actions: int = 0
    planning_seconds: float = 0.0
    simulation_failures: int = 0

    @property
    def planned(self) -> int:
        return self.planned_actions

    def __add__(self, other: "Tally") -> "Tally":
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Tally(**dict(zip(asdict(self), map(sum, pairs), strict=True)))


def stored_task(config: CollectConfig) -> TaskConfig:
    if ships(config.task.states):
        return config.task
    return replace(config.task, states=config.dataset_id)


class EpisodeFile(NamedTuple):
    """A unit of work: make episodes `numbers` and write them to `path`."""

    config: CollectConfig
    numbers: range
    path: Path


class EpisodeRecipe(Recipe):
    """Recipe for a policy's episodes, see `runs.engine.Recipe`.

    Each unit writes a file of a few episodes. The finished files are the checkpoint.
    """

    def __init__(self, config: CollectConfig, options: RunOptions) -> None:
        make_policy(config.policy).suited(config.seen_task)  # refuses before any work is done
        _metadata(config, Tally())  # refuses a bad id
        if not ships(config.task.states):
            read_states(states_file(config.task.states), images=False)
        self.config, self.shard, self.tally = config, options.shard, Tally()
        self.engine = config.task.engine
        self.numbers = options.shard.share(config.episodes)
        self.files: list[EpisodeFile] = []
        if not self.numbers:
            raise InvalidInput(
                f"shard {options.shard} of {config.episodes} episodes has none: split the run into"
                " fewer shards"
            )

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": self.sources()}

    def sources(self) -> dict[str, Any]:
        """Return the digests of everything that is read."""
        return sources_of(self.config)

    def work(self) -> Callable[[EpisodeFile], Tally]:
        """Return what makes a file."""
        return play

    def batches(self, folder: Path) -> Iterator[Batch]:
        size = 4
        for first in range(0, len(self.numbers), size):
            few, path = self.numbers[first : first + size], f"episodes-{first // size:06d}.h5"
            self.files.append(EpisodeFile(self.config, few, folder / path))
        finished = {file.path: _finished(file.path) for file in self.files}
        self.tally = sum((tally for tally in finished.values() if tally is not None), Tally())

        def absorb(file: EpisodeFile, tally: Tally) -> None:
            self.tally += tally

        left = [file for file in self.files if finished[file.path] is None]
        yield Batch(self.work(), left, absorb, "playing files of a few episodes")

    def status(self) -> Status:
        facts = {"reached the goal": f"{self.tally.succeeded}"}
        return Status(self.tally.played, len(self.numbers), "episodes", facts, even=True)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        paths = [file.path for file in self.files]
        if self.shard.is_whole:
            return write_whole(self.config, paths, self.tally, folder, request)
        folder.mkdir()
        merge_episodes(paths, folder / "main_data.hdf5")
        files = {"main_data.hdf5": sha256(folder / "main_data.hdf5")}
        _report(folder / REPORT, request, self.tally, files)
        return folder

    def summary(self) -> str:
        tally = self.tally
        return (
            f"{tally.kept} episodes, {tally.steps} steps; {tally.succeeded} of {tally.played}"
            f" reached the goal, {tally.played - tally.succeeded} failed"
            f" ({'kept' if self.config.keep_failed else 'dropped'}); planning"
            f" {tally.planned_actions / tally.played:.0f} simulated actions and"
            f" {tally.planning_seconds / tally.played:.1f} s an episode"
        )


def write_whole(
    config: CollectConfig,
    files: Sequence[Path],
    tally: Tally,
    root: Path,
    request: dict[str, Any],
    *,
    concatenate: bool = False,
    machines: Sequence[dict[str, str]] | None = None,
) -> Path:
    """Write a run's dataset below `root` from files of episodes, and return its folder.

    Args:
        files: files of episodes.
        tally: totals of the episodes.
        root: Minari root to write to.
        request: of the run.
        concatenate: see `publish`.
        machines: the machines that played the episodes; this one by default.

    Raises:
        InvalidInput: no episode is left to keep.
    """
    if not tally.kept:
        raise InvalidInput(
            f"none of {tally.played} episodes reached the goal and failed ones are dropped, so"
            " nothing is left to write"
        )
    carried = None if ships(config.task.states) else states_file(config.task.states)
    metadata = replace(_metadata(config, tally), digests=digests(request["source"]))
    made = publish(files, metadata, root, concatenate=concatenate, states=carried)
    _report(made / "data" / REPORT, request, tally, machines=machines)
    return made


def _report(
    path: Path,
    request: dict[str, Any],
    tally: Tally,
    files: dict[str, str] | None = None,
    machines: Sequence[dict[str, str]] | None = None,
) -> None:
    content = {
        "format": "knotgym-collection",
        "format_version": 1,
        **request,
        "machines": machines or [machine()],
        "tally": {**asdict(tally), "planning_seconds": round(tally.planning_seconds, 1)},
        **({"files": files} if files else {}),
    }
    path.write_text(json.dumps(content, indent=1, sort_keys=True), encoding="utf-8")


def play(file: EpisodeFile) -> Tally:
    """Play a file's episodes and write it."""
    return write_episodes(file, _best_of_attempts(file.config, file.numbers))


def write_episodes(file: EpisodeFile, rollouts: Sequence[Rollout]) -> Tally:
    """Write a file and then its tally, which marks it as finished."""
    config = file.config
    kept = [played for played in rollouts if played.success or config.keep_failed]
    with EpisodeWriter(file.path, stored_task(config)) as writer:
        for played in kept:
            writer.add(played.episode, played.number)
    tally = Tally(
        played=len(rollouts),
        succeeded=sum(played.success for played in rollouts),
        kept=len(kept),
        steps=sum(len(played.episode) for played in kept),
        successful_steps=sum(len(played.episode) for played in rollouts if played.success),
        planned_actions=sum(played.effort.actions for played in rollouts),
        planning_seconds=sum(played.effort.seconds for played in rollouts),
        simulation_failures=sum(bool(played.episode.simulation_failed[-1]) for played in rollouts),
    )
    sealed = {"sha256": sha256(file.path), "tally": asdict(tally)}
    write_sealed(file.path.with_suffix(".json"), sealed)
    return tally


def _best_of_attempts(config: CollectConfig, numbers: range) -> list[Rollout]:
    """Return each episode's shortest successful rollout, or else its first.

    Its planning effort is the sum over all rollouts of the episode.
    """
    policy = make_policy(config.policy)
    labeller = Expert(PlannerConfig(budget=config.policy.planner.budget)) if config.labels else None
    attempts = [
        rollout(config.seen_task, policy, numbers, config.seed, attempt=one, labeller=labeller)
        for one in range(config.attempts)
    ]
    best = []
    for tries in zip(*attempts, strict=True):
        kept = min(tries, key=lambda one: (not one.success, len(one.episode) * one.success))
        effort = reduce(Effort.plus, (one.effort for one in tries))
        best.append(replace(kept, effort=effort))
    return best


def _finished(path: Path) -> Tally | None:
    """Return the tally of a file if it is finished and intact, otherwise None."""
    try:
        sealed = read_sealed(path.with_suffix(".json"))
        return Tally(**sealed["tally"]) if sealed["sha256"] == sha256(path) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _metadata(config: CollectConfig, tally: Tally) -> MinariMetadata:
    return MinariMetadata(**vars(_new_metadata(config, tally)))
