"""Rebuild a recorded dataset by stepping alone: no demonstrator looks, no planner searches."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from knotgym.common.configuration import as_json, differences, from_json
from knotgym.common.errors import InvalidFile
from knotgym.control.rollouts import rollout
from knotgym.generate.episodes.old_collect import (
    CollectConfig,
    EpisodeFile,
    EpisodeRecipe,
    Tally,
    write_episodes,
)
from knotgym.generate.episodes.recordings import PulledPolicy, Recording
from knotgym.runs.run_options import RunOptions

_FREE = (
    *("episodes", "dataset_id", "seen", "author", "author_email"),
    "code_permalink",
)


class RebuildRecipe(EpisodeRecipe):
    """Recipe for a recorded dataset, or its first episodes; see `runs.engine.Recipe`.

    Its request, and so its output, is that of the collection.
    """

    def __init__(self, config: CollectConfig, options: RunOptions, recording: Recording) -> None:
        """Take the dataset to make and its recording.

        Raises:
            InvalidFile: it has other settings or fewer episodes.
        """
        _require_recorded(config, recording)
        self._recording = recording
        super().__init__(config, options)

    def sources(self) -> dict[str, Any]:
        # the states of today: if their file was only rewritten, the episodes are the same
        return {**self._recording.source, "states": super().sources()["states"]}

    def work(self) -> Callable[[EpisodeFile], Tally]:
        return partial(_step, self._recording)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        if self.config.episodes == len(self._recording):  # of a part, the effort isn't known
            self.tally = replace(self.tally, planned_actions=self._recording.planned_actions)
        return super().finish(folder, request)


def _require_recorded(config: CollectConfig, recording: Recording) -> None:
    """Require that a dataset has the settings of a recording, apart from its size, observation and
    names, and not more episodes.
    """
    recorded = from_json(CollectConfig, recording.config)  # fills in settings that came later
    free: dict[str, Any] = {name: getattr(recorded, name) for name in _FREE}
    task = replace(config.task, observation=recorded.task.observation)
    requested = replace(config, task=task, **free)
    if found := [*differences(as_json(recorded), as_json(requested))]:
        raise InvalidFile(
            f"the recording of {recording.name} has other settings: {'; '.join(found[:3])}"
        )
    if config.episodes > len(recording):
        raise InvalidFile(
            f"{recording.name} is recorded with {len(recording)} episodes, got {config.episodes}"
        )


def _step(recording: Recording, file: EpisodeFile) -> Tally:
    """Make a file's episodes from their recordings."""
    config = file.config
    recorded = [recording.episode(number) for number in file.numbers]
    policy = PulledPolicy(config.policy.policy, recorded)
    return write_episodes(file, rollout(config.seen_task, policy, file.numbers, config.seed))
