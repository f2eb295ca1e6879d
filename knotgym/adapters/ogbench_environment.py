"""A goal-conditioned environment for the evaluation of OGBench's agents.

Its ids are `knotgym/tie-nx2-v0`, `knotgym/visual-tie-nx2-v0` and the like. OGBench derives an id
from the name of a dataset, such as `knotgym/tie-nx2-expert-v0`, by removing the policy's name;
"visual" stands for pictures.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.adapters.goal_environment import halves, require_one_side, rope_space
from knotgym.common import InvalidInput
from knotgym.envs import KnotEnv

TASKS = 5  # number of evaluation goals, as in OGBench


class OGBenchEnv(KnotEnv):
    """A `KnotEnv` whose observation is the rope alone; the goal is in `info`.

    `reset(options={"task_id": k})` starts the k-th of `task_infos`; without it, start and goal are
    sampled. The option `render_goal` adds a picture of the goal as `info["goal_rendered"]`. `info`
    holds numbers only (`numeric_infos`); `info["goal"]` is the goal as an observation, its row
    `info["goal_row"]`, and `info["success"]` equals `info["is_success"]`.

    Attributes:
        task_infos: five pairs of a start and a goal, spread evenly over the rows of the split, as
            dicts of `task_name` and the rows `start` and `goal`.
    """

    def __init__(self, task: str, render_mode: str | None = "rgb_array", **settings: Any) -> None:
        super().__init__(task, render_mode, **{"numeric_infos": True, **settings})
        require_one_side(self.config)
        self.observation_space = rope_space(self.config)
        rows = self.episodes.rows["start"]
        starts = [int(rows[k * len(rows) // TASKS]) for k in range(TASKS)]
        goals = [self.episodes.goal_rows(start) for start in starts]
        self.task_infos = [
            {
                "task_name": f"task{k + 1}",
                "start": start,
                "goal": int(goals[k][k * len(goals[k]) // TASKS]),
            }
            for k, start in enumerate(starts)
        ]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; options as in `KnotEnv`, and `task_id`, 1 to 5, and `render_goal`."""
        options = dict(options or {})
        task_id, render_goal = options.pop("task_id", None), options.pop("render_goal", False)
        if task_id is not None:
            if task_id not in range(1, TASKS + 1):
                raise InvalidInput(f"task_id must be a number from 1 to {TASKS}, got {task_id!r}")
            chosen = self.task_infos[task_id - 1]
            options = {"start": chosen["start"], "goal": chosen["goal"], **options}
        both, info = super().reset(seed=seed, options=options)
        if render_goal:
            info["goal_rendered"] = halves(self.episodes.rgb(0))[1]
        return _goal_to_info(both, info)

    def step(self, action: NDArray[Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one action, as `KnotEnv.step`."""
        both, reward, terminated, truncated, info = super().step(action)
        rope, info = _goal_to_info(both, info)
        return rope, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the rope alone, uint8 (size, size, 3)."""
        picture = super().render()
        return None if picture is None else halves(picture)[0]


def _goal_to_info(both: NDArray[Any], info: dict[str, Any]) -> tuple[NDArray[Any], dict[str, Any]]:
    """Move the goal's half of an observation to `info`, under the keys that OGBench expects."""
    rope, goal = halves(both)
    return rope, {**info, "goal_row": info["goal"], "goal": goal, "success": info["is_success"]}
