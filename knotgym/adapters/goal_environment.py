"""Goal-conditioned environments: for hindsight experience replay, and for OGBench's agents.

A goal is a Gauss code, int16 (1 + SYMBOLS,): a 1, then its visits as in a "symbolic" observation.
An achieved goal has the same format, but starts with 0 if it must not count as a success: because
the rope shows the code with which the episode started, is beyond `tow_limit`, or shows more
crossings than fit. Half of all states show their episode's first code; relabelling them as goals
would reward doing nothing.

OGBench's ids are `knotgym/tie-nx2-v0`, `knotgym/visual-tie-nx2-v0` and the like. It derives an id
from the name of a dataset, such as `knotgym/tie-nx2-expert-v0`, by removing the policy's name;
"visual" stands for pictures.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from knotgym.common import InvalidInput
from knotgym.envs import OBSERVATIONS, EpisodeBatch, KnotEnv, Observer, Situation, TaskConfig

Info = dict[str, Any]
_SYMBOLS = Observer.SYMBOLS
_TASKS = 5  # number of evaluation goals, as in OGBench


class GoalBatch(EpisodeBatch):
    """Episodes whose observations hold achieved and desired goals, see `goal_env`."""

    def __init__(self, task: TaskConfig, count: int = 1, threads: int = 1) -> None:
        _require_one_side(task)
        if task.hold != 1 or task.failure_reward:
            raise InvalidInput(
                "with goals that may be relabelled, hold must be 1 and failure_reward 0, got"
                f" {task.hold} and {task.failure_reward}"
            )
        super().__init__(task, count, threads)
        self._began = Observer.symbols(self.visits)  # the first code of each episode
        goal = spaces.Box(-_SYMBOLS, _SYMBOLS, (1 + _SYMBOLS,), np.int16)
        self.space = spaces.Dict(
            {"observation": _rope_space(task), "achieved_goal": goal, "desired_goal": goal}
        )

    def restore(self, ids: NDArray[np.int64], rows: Mapping[str, ArrayLike]) -> None:
        """Begin episodes, as `EpisodeBatch.restore`."""
        super().restore(ids, rows)
        self._began[ids] = Observer.symbols(self.visits[ids])

    def observations(self, ids: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return the observations of the episodes `ids`: arrays (n, ...)."""
        # which codes that ropes show may count as a success
        same = Situation.shown(self.task, Observer.symbols(self.visits[ids]), self._began[ids])
        fits = 2 * self.crossings[ids] <= _SYMBOLS
        counts = ~same & fits & ~self.towed[ids] & ~self.failed[ids]
        return {
            "observation": self.halves(ids)[0],
            "achieved_goal": _encoded(self.visits[ids], counts),
            "desired_goal": _encoded(self.wanted[ids], np.ones(len(ids), dtype=bool)),
        }

    def reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> Any:
        """Return the task's rewards of goals (..., 1 + SYMBOLS): success where equal ones count."""
        pair = np.broadcast_arrays(achieved_goal, desired_goal)
        achieved, desired = (goals.reshape(-1, 1 + _SYMBOLS) for goals in pair)
        counts = (achieved[:, 0] == 1) & (desired[:, 0] == 1)
        held = counts & Situation.shown(self.task, achieved[:, 1:], desired[:, 1:])
        # hold is 1, and no failure is paid: which step it is, and whether it failed, don't matter
        first = np.ones(len(held), dtype=np.int64)
        seen = Situation(achieved[:, 1:], desired[:, 1:], held.astype(np.int64), 1, first)
        rewards = seen.outcome(self.task).rewards.reshape(pair[0].shape[:-1])
        return rewards if rewards.ndim else float(rewards)


class GoalEnv(KnotEnv):
    """A `KnotEnv` whose observation is a dict for hindsight relabelling, see `goal_env`."""

    _batch = GoalBatch
    episodes: GoalBatch

    def __init__(self, task: str, render_mode: str | None = "rgb_array", **settings: Any) -> None:
        super().__init__(task, render_mode, **{"failure_reward": 0.0, **settings})

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """Compute rewards as `GoalBatch.reward`; `info` is not used."""
        return self.episodes.reward(achieved_goal, desired_goal)


def goal_env(task: str, **settings: Any) -> GoalEnv:
    """Make an environment for hindsight experience replay.

    Its observation is a dict of

        observation     uint8 (size, size, 3), float32 (3 beads,) or int16 (SYMBOLS,): the rope
        achieved_goal   int16 (1 + SYMBOLS,): the code that the rope shows, see this module
        desired_goal    int16 (1 + SYMBOLS,): the code of the goal

    and `compute_reward(achieved_goal, desired_goal, info)` equals the reward of `step`.

    Args:
        task: "unknot", "tie" or "convert".
        settings: keywords of `KnotEnv`. `observation` must be "pixels", "state" or "symbolic".
            `hold` must be 1 and `failure_reward` 0, because a relabelled goal determines neither
            how long it was held nor how many steps are left.

    Raises:
        InvalidInput: a setting is invalid.
    """
    return GoalEnv(task, **settings)


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
        _require_one_side(self.config)
        self.observation_space = _rope_space(self.config)
        rows = self.episodes.rows["start"]
        starts = [int(rows[k * len(rows) // _TASKS]) for k in range(_TASKS)]
        fitting = [self.episodes.goal_rows(start) for start in starts]
        goals = [int(some[k * len(some) // _TASKS]) for k, some in enumerate(fitting)]
        self.task_infos = [
            {"task_name": f"task{k}", "start": start, "goal": goal}
            for k, (start, goal) in enumerate(zip(starts, goals, strict=True), 1)
        ]

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Start an episode; options as in `KnotEnv`, and `task_id`, 1 to 5, and `render_goal`."""
        options = dict(options or {})
        task_id, render_goal = options.pop("task_id", None), options.pop("render_goal", False)
        if task_id is not None:
            if task_id not in range(1, _TASKS + 1):
                raise InvalidInput(f"task_id must be a number from 1 to {_TASKS}, got {task_id!r}")
            chosen = self.task_infos[task_id - 1]
            options = {"start": chosen["start"], "goal": chosen["goal"], **options}
        rope, info = super().reset(seed=seed, options=options)
        if render_goal:
            info["goal_rendered"] = np.split(self.episodes.rgb(0), 2, axis=1)[1]
        return rope, info

    def _seen(self) -> tuple[NDArray[Any], Info]:
        info, ids = self.episodes.info_rows(np.array([0]))[0], np.array([0])
        rope, goal = (half[0] for half in self.episodes.halves(ids))
        return rope, {**info, "goal_row": info["goal"], "goal": goal, "success": info["is_success"]}

    def render(self) -> NDArray[np.uint8] | None:
        """Return the rope alone, uint8 (size, size, 3)."""
        picture = super().render()
        return None if picture is None else np.split(picture, 2, axis=1)[0]


def _rope_space(config: TaskConfig) -> spaces.Box:
    """Return the space of the rope's half of an observation."""
    space = OBSERVATIONS[config.observation].space
    assert space is not None  # required before
    half = space(config)
    return (
        half if half.shape[0] > 1 else spaces.Box(half.low[0], half.high[0], dtype=half.dtype.type)
    )


def _require_one_side(config: TaskConfig) -> None:
    """Raise InvalidInput if the rope can't be observed without its goal, as one array."""
    fits = [name for name, kind in OBSERVATIONS.items() if kind.half is not None]
    if config.observation not in fits or config.is_canonical:
        raise InvalidInput(
            "an environment that shows the rope without its goal needs observation"
            f" {', '.join(map(repr, fits))}, and frame 'world';"
            f" got {config.observation!r} and {config.frame!r}"
        )


def _encoded(visits: NDArray[np.int16], count: NDArray[np.bool_]) -> NDArray[np.int16]:
    return np.concatenate([count[:, None].astype(np.int16), Observer.symbols(visits)], axis=1)
