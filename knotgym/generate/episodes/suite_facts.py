"""What the benchmark's card says of a dataset; all of it is computed from its episodes."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from knotgym.common.errors import InvalidInput, KnotgymError, one_line
from knotgym.control.planning import first_goal
from knotgym.datasets.episode_dataset import content_digest, open_episodes
from knotgym.datasets.episodes import distinct
from knotgym.envs.task_states import task_sides
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import run_facts
from knotgym.generate.episodes.recordings import first_difference, recordings
from knotgym.states.state_file import ships
from knotgym.topology.gauss import GaussCode


def describe_set(made: Path) -> dict[str, Any]:
    """Describe a finished dataset that `collect` or the suite made.

    Args:
        made: folder of the dataset.

    Returns:
        Its settings and size; `sha256`, of its starts and pulls; `codes`, see `_goal_overlap`;
        `recorded`: "no" recording, "same", or "differs from episode k".

    Raises:
        InvalidInput: it isn't such a dataset.
    """
    try:
        dataset = open_episodes(made)
        config, versions = run_facts(made)["config"], run_facts(made)["versions"]
        policy, seed = config["policy"]["policy"], config["seed"]
    except (KnotgymError, KeyError, TypeError) as error:
        raise InvalidInput(
            f"{made} is none of the suite's sets ({one_line(error)}); remove it"
        ) from error
    task, episodes, rows = dataset.task, dataset.episodes, dataset.episodes.episodes
    recording = recordings().get(dataset.name)
    agreement = "no"
    if recording is not None:
        first = first_difference(episodes, recording)
        agreement = "same" if first is None else f"differs from episode {first}"
    files = [file for file in (made / "data").iterdir() if file.is_file()]
    return {
        **{name: getattr(task, name) for name in ("task", "nx", "split", "endless", "engine")},
        "states": task.states or "readable",
        "policy": policy,
        "seed": seed,
        "episodes": rows.rows,
        "succeeded": int(rows["success"].sum()),
        "steps": int(rows["length"].sum()),
        **distinct(rows),
        "bytes": sum(file.stat().st_size for file in files),
        "sha256": content_digest(episodes),
        "versions": versions,
        "codes": _goal_overlap(task) if ships(task.states) else None,
        "recorded": agreement,
    }


@lru_cache
def _goal_overlap(task: TaskConfig) -> dict[str, int]:
    """Count the goal codes of a task's training and test split.

    Returns:
        `train` and `test`, the numbers of codes; `shared`, those of both; `shared_classes`, classes
        up to symmetry that are in both.
    """
    sides = []
    for split in (task.split, task.split.replace("train", "test")):
        goals = task_sides(replace(task, split=split))[0][1]
        codes = goals.states.gauss_code[goals.rows].tolist()
        sides.append({GaussCode.parse(text) for text in codes})
    classes = [{first_goal(code)[0] for code in codes} for codes in sides]
    return {
        "train": len(sides[0]),
        "test": len(sides[1]),
        "shared": len(sides[0] & sides[1]),
        "shared_classes": len(classes[0] & classes[1]),
    }
