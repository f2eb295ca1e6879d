"""Datasets that Minari's own `DataCollector` recorded in an environment of knotgym, wrapped or not.

    data/main_data.hdf5     /episode_{k}: observations, actions, rewards, terminations, truncations
    data/metadata.json      env_spec: the environment's id and keywords

Rewards and ends are those recorded, so those of a wrapper reach the loaders. Codes are read from
the vertices. The rest isn't there: rows of starts and goals are -1 and positions at rest NaN, so
that episodes can be loaded, but not played again. Nothing that the metadata name is imported.
"""

import json
from collections.abc import Mapping
from dataclasses import fields
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile, Table, from_json, read_json, require_stored
from knotgym.datasets.episodes import EPISODES, STEPS, Episodes
from knotgym.envs import TaskConfig
from knotgym.rope import VIEWS, Rope, Taken
from knotgym.topology import CodeArrays


def recorded_columns(path: Path) -> tuple[Episodes, TaskConfig]:
    """Read the episodes of a file `main_data.hdf5`, and the task that its environment had.

    Raises:
        InvalidFile: it was recorded in another environment or without vertices, its actions aren't
            pulls, or it is damaged.
    """
    # there is no end to what foreign bytes make h5py and NumPy raise
    with InvalidFile.instead(f"{path} can't be loaded", Exception):
        metadata = read_json(path.with_name("metadata.json"))
        spec = json.loads(metadata["env_spec"])
        known = {field.name for field in fields(TaskConfig)}
        keywords = {name: value for name, value in spec["kwargs"].items() if name in known}
        if not spec["id"].startswith("knotgym/"):
            raise InvalidFile(f"it was recorded in {spec['id']}, no environment of knotgym")
        task = from_json(TaskConfig, keywords)
        if not VIEWS[task.action].is_plain:
            raise InvalidFile(f"it holds actions of view {task.action!r}, record 'pull'")
        with h5py.File(path, "r", locking=False) as file:
            items: dict[str, Any] = {}
            file.visititems(items.__setitem__)  # follows no links but hard ones
            names = takewhile(lambda name: name in items, (f"episode_{k}" for k in count()))
            policy = str(metadata.get("algorithm_name", "unknown"))
            parts = [_episode(items, name, task, policy) for name in names]
    every = Episodes.merged(parts)
    reached = np.logical_or.reduceat(every.goal_reached(task), every.offsets[:-1])
    return every._replace(episodes=every.episodes.replaced(success=reached)), task


def _episode(items: Mapping[str, Any], name: str, task: TaskConfig, policy: str) -> Episodes:
    """Read one episode of T pulls."""

    def _read(key: str) -> NDArray[Any]:
        require_stored(items[f"{name}/{key}"], key)
        return np.asarray(items[f"{name}/{key}"][()])

    seen = items.get(f"{name}/observations/state", items[f"{name}/observations"])
    if getattr(seen, "shape", ())[1:] != (6 * task.beads,):
        raise InvalidFile("it holds no vertices: record with observation='state' or 'both'")
    key = seen.name.removeprefix(f"/{name}/")
    ropes, goals = np.moveaxis(_read(key).reshape(-1, 2, task.beads, 3).astype(np.float32), 1, 0)
    points, actions = ropes.astype(np.float64), _read("actions").astype(np.float32)
    sides, rope = np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2), task.rope_config
    if not (np.abs(sides - rope.bead_length) < 2 * rope.radius).all():
        raise InvalidFile("it holds observations that a wrapper changed: record vertices")
    pulls = len(points) - 1
    terminated = _read("terminations")
    truncated = _read("truncations") & ~terminated
    truncated[-1] = not terminated[-1]
    codes = CodeArrays.read(np.concatenate([points, goals[:1].astype(np.float64)]))
    sizes = {"beads": task.beads, "nq": Rope(rope).nq}
    sizes |= {"visits": codes.visits.shape[1], "labels": codes.signs.shape[1]}
    optional = [c.name for c in STEPS.columns if c.optional and c.origin == "given"]
    schema = STEPS.sized(**sizes).without(*optional)
    shown = (points, *(part[:-1] for part in codes))  # but for the goal's
    steps = schema.empty(pulls + 1)
    for column, column_values in Episodes.of_states(schema, *shown).items():
        steps[column][:] = column_values
    at = np.arange(pulls)
    made = Taken({"observation": points, "read": actions}, at, at, "read", rope.reach)
    led: dict[str, Any] = {
        "bead": made.beads,
        "force": np.clip(actions[:, 3:], -1, 1),
        "action": actions,
        "reward": _read("rewards"),
        "terminated": terminated,
        "truncated": truncated,
        "applied_fraction": 1,
    }
    for column, values in led.items():
        steps[column][:-1] = values  # no pull is made in the last state
    rows = EPISODES.sized(**sizes).empty(1) | {"policy": np.array([policy])}
    known = {"seed": items[name].attrs.get("seed", -1), "length": pulls}
    known |= {"start": -1, "goal": -1, "start_qpos": np.nan, "return_": steps["reward"].sum()}
    known |= {"goal_visits": codes.visits[-1], "goal_points": goals[0]}
    for column, value in known.items():
        rows[column][:] = value
    return Episodes(Table(EPISODES.sized(**sizes), rows), Table(schema, steps))
