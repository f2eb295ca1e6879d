"""What the benchmark's card says of a dataset: its size, its policy's play, and how it was made."""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.atomic_files import sha256
from knotgym.common.configuration import from_json, read_json
from knotgym.common.errors import InvalidInput, one_line
from knotgym.control.demonstrator import PLANNER
from knotgym.control.pass_counts import first_goal
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.envs.task_states import task_sides
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.old_collect import REPORT
from knotgym.generate.episodes.recordings import RECORDINGS, read_recording, recorded_ids
from knotgym.states.state_file import ships
from knotgym.topology.gauss import GaussCode

_CHOICE = "choice"  # first word of the reason for a pass of the demonstrator's; its rank follows
_STATES = "readable"  # name of the states that need none


def describe_set(made: Path, recordings: Path = RECORDINGS) -> dict[str, Any]:
    """Describe a finished dataset that `collect` or `rebuild` made.

    Returns:
        Size, seed, checksums and versions; `first_choices`, the share of macro-actions that were
        the first of the demonstrator's order, and `planner`, the share of episodes in which the
        planner acted, None for policies without macro-actions; `codes`, see `goal_overlap`;
        `recorded`, see `agreement`; `predictability`, and `learner`, the best that was trained on
        it, see `measured`.

    Raises:
        InvalidInput: it isn't such a dataset.
    """
    try:
        report = read_json(made / "data" / REPORT)
        config, tally = report["config"], report["tally"]
        files = {name: made / "data" / name for name in ("main_data.hdf5", "metadata.json")}
        task = from_json(TaskConfig, config["task"])
        facts = {
            **{name: config["task"][name] for name in ("task", "nx", "split", "tow_limit")},
            **{name: config["task"][name] for name in ("endless", "engine", "observation")},
            "states": config["task"]["states"] or _STATES,
            "policy": config["policy"]["policy"],
            "seed": config["seed"],
            "episodes": tally["kept"],
            "succeeded": tally["succeeded"],
            "steps": tally["steps"],
            "bytes": sum(file.stat().st_size for file in files.values()),
            "sha256": {name: sha256(file) for name, file in files.items()},
            "versions": report["versions"],
        }
        name = str(config["dataset_id"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInput(
            f"{made} is none of the suite's sets ({one_line(error)}); remove it"
        ) from error
    return {
        **facts,
        **_choices(made),
        "codes": goal_overlap(task) if ships(task.states) else None,
        "recorded": agreement(name, made, recordings),
        **measured(name, made, recordings),
    }


def _choices(made: Path) -> dict[str, float | None]:
    reader = EpisodeReader(made)
    if not reader.has("macro_start"):
        return {"first_choices": None, "planner": None}
    ranks, planned = list[str](), 0
    for index in range(len(reader)):
        moves = reader.column(index, "move").tolist()
        starts = np.flatnonzero(reader.column(index, "macro_start")).tolist()
        words = [moves[step].split() for step in starts]
        ranks += [why[1] for why in words if why[:1] == [_CHOICE]]
        planned += any(why.startswith(PLANNER) for why in moves)
    return {
        "first_choices": ranks.count("1") / max(1, len(ranks)),
        "planner": planned / len(reader),
    }


@lru_cache
def goal_overlap(task: TaskConfig) -> dict[str, int]:
    """Count the goal codes of a task's training and test split.

    Returns:
        `train` and `test`, the numbers of codes; `shared`, those of both; `shared_classes`, classes
        up to symmetry that are in both.
    """
    sides = []
    for split in (task.split, task.split.replace("train", "test")):
        states, _, nx = task_sides(replace(task, split=split))[1]
        rows = states.rows(nx, split)
        sides.append({GaussCode.parse(text) for text in states.gauss_code[rows].tolist()})
    classes = [{first_goal(code)[0] for code in codes} for codes in sides]
    return {
        "train": len(sides[0]),
        "test": len(sides[1]),
        "shared": len(sides[0] & sides[1]),
        "shared_classes": len(classes[0] & classes[1]),
    }


def agreement(name: str, made: Path, recordings: Path = RECORDINGS) -> str:
    """Compare a dataset with its recording: "no" recording, "same", or "differs from episode k"."""
    if name not in recorded_ids(recordings):
        return "no"
    recording = read_recording(name, recordings)
    first = recording.first_difference(made)
    if first is None:
        return "same"
    states = read_json(made / "data" / REPORT)["source"]["states"]
    reason = "" if recording.source["states"] == states else " (its states are others)"
    return f"differs from episode {first}{reason}"


def measured(
    name: str, made: Path, recordings: Path = RECORDINGS
) -> dict[str, Mapping[str, Any] | None]:
    """Return what was measured once, on the whole dataset as recorded.

    Returns:
        `predictability`: `bead_top1`, the share of the held-out `decisions` whose bead was the
        first guess of a clone, and `r2`, see `learn.clone_training.Predictability`; and `learner`,
        see `suite_scores.best_learner`. Each is None if unknown.
    """
    unknown = dict.fromkeys(("predictability", "learner"))
    figures = Path(recordings).with_suffix(".json")
    if agreement(name, made, recordings) != "same" or not figures.is_file():
        return unknown
    recording = read_recording(name, recordings)
    own = json.loads(figures.read_text(encoding="utf-8")).get(name, {})
    whole = len(EpisodeReader(made)) == len(recording)
    if not whole or own.get("recording_sha256") != recording.digest:
        return unknown
    return {key: own.get(key) for key in unknown}
