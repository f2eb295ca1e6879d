"""A goal-conditioned environment as OGBench's agents evaluate in.

The ids `knotgym/tie-nx2-v0`, `knotgym/visual-tie-nx2-v0` and the like make it. OGBench makes an id
of a dataset's name, `knotgym/tie-nx2-expert-v0`, less the policy's; "visual" asks for pictures.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.adapters.goal_environment import halves, require_one_side, rope_space
from knotgym.env import KnotEnv
from knotgym.tasks import InvalidSetting

TASKS = 5  # evaluation goals, as OGBench has


class OGBenchEnv(KnotEnv):
    """As `KnotEnv`; an observation is the rope alone, its goal is in `info` of `reset`.

    `reset(options={"task_id": k})` is the k-th of `task_infos`; without it start and goal are
    drawn. `render_goal` puts a picture of the goal into `info["goal_rendered"]`. `info` holds
    numbers alone (`numeric_infos`), `info["goal"]` the goal as an observation (its row is
    `info["goal_row"]`), `info["success"]` what `is_success` says.

    Attributes:
        task_infos: five pairs of a start and a goal, spread evenly over the rows of the split:
            `task_name`, and the rows `start` and `goal`.
    """

    def __init__(self, task: str, render_mode: str | None = "rgb_array", **settings: Any) -> None:
        super().__init__(task, render_mode, **{"numeric_infos": True, **settings})
        require_one_side(self.config)
        self.observation_space = rope_space(self.config)
        rows = self.episodes.rows("start")
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
        """As `KnotEnv.reset`; options also `task_id`, 1 to 5, and `render_goal`."""
        wanted = dict(options or {})
        task_id, render_goal = wanted.pop("task_id", None), wanted.pop("render_goal", False)
        if task_id is not None:
            if task_id not in range(1, TASKS + 1):
                raise InvalidSetting(f"task_id is a number from 1 to {TASKS}, got {task_id!r}")
            chosen = self.task_infos[task_id - 1]
            wanted = {"start": chosen["start"], "goal": chosen["goal"], **wanted}
        seen, info = super().reset(seed=seed, options=wanted)
        if render_goal:
            info["goal_rendered"] = halves(self.episodes.rgb(0))[1]
        return _told(seen, info)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As `KnotEnv.step`."""
        whole, reward, terminated, truncated, info = super().step(action)
        seen, info = _told(whole, info)
        return seen, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The rope alone, uint8 (size, size, 3)."""
        seen = super().render()
        return None if seen is None else halves(seen)[0]


def _told(seen: NDArray[Any], info: dict[str, Any]) -> tuple[NDArray[Any], dict[str, Any]]:
    """The rope alone, and what OGBench looks for in `info`."""
    rope, goal = halves(seen)
    return rope, {**info, "goal_row": info["goal"], "goal": goal, "success": info["is_success"]}
