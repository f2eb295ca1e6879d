"""Environments whose goal is told apart from what is seen, so that hindsight may change it.

A goal is a Gauss code, int16 (1 + SYMBOLS,): a 1, then its visits as in a "symbolic" observation.
What a rope has achieved is written alike, but begins with 0 where it can be nobody's success: the
rope shows the code that the episode began with, lies beyond `tow_limit`, or shows more crossings
than there is room for. Half of all states show the code that their episode began with; hindsight
that took them for goals would hand out success for nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from knotgym.envs.environment import KnotEnv, observation_space
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.observations import SYMBOLS, numbers
from knotgym.envs.tasks import InvalidSetting, TaskConfig
from knotgym.rope.towing import distances_towed
from knotgym.topology.gauss import GaussCode


class GoalEnv(KnotEnv):
    """As `KnotEnv`; an observation is a dict of what hindsight needs, see `goal_env`."""

    def __init__(self, task: str, render_mode: str | None = "rgb_array", **settings: Any) -> None:
        settings = {"failure_reward": 0.0, **settings}
        super().__init__(task, render_mode, **settings)
        self.goals = Goals(self.episodes)
        self.observation_space = self.goals.space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As `KnotEnv.reset`."""
        info = super().reset(seed=seed, options=options)[1]
        self.goals.begin(0)
        return self.goals.observation(0), info

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As `KnotEnv.step`."""
        _, *outcome = super().step(action)
        return self.goals.observation(0), *outcome  # type: ignore[return-value]

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """As `Goals.reward`; `info` isn't asked."""
        return self.goals.reward(achieved_goal, desired_goal)


def goal_env(task: str, **settings: Any) -> GoalEnv:
    """Make an environment for hindsight experience replay.

    Its observation is a dict of

        observation     uint8 (size, size, 3), float32 (3 beads,) or int16 (SYMBOLS,): the rope
        achieved_goal   int16 (1 + SYMBOLS,): the code that the rope shows, see this module
        desired_goal    the same, of the goal

    and `compute_reward(achieved_goal, desired_goal, info)` is what `step` pays: `success_reward`
    for the goal's code, else 0.

    Args:
        task: "unknot", "tie" or "convert".
        settings: as `KnotEnv`; `observation` is "pixels", "state" or "symbolic". A goal that
            anyone may change can't be asked for how long it was held, nor how many steps are left:
            `hold` is 1, and `failure_reward` 0.

    Raises:
        InvalidSetting: another setting.
    """
    return GoalEnv(task, **settings)


class Goals:
    """What the episodes of a batch achieved and shall achieve.

    Attributes:
        episodes: the batch; `begin` is to be called after its own.
        space: of `observation`.
    """

    def __init__(self, episodes: EpisodeBatch) -> None:
        config = episodes.config
        require_one_side(config)
        if config.hold != 1 or config.failure_reward:
            raise InvalidSetting(
                "a goal that hindsight may change is paid for at once and costs nothing: hold must"
                f" be 1 and failure_reward 0, got {config.hold} and {config.failure_reward}"
            )
        self.episodes = episodes
        self._began: list[GaussCode] = [GaussCode(())] * episodes.count
        goal = spaces.Box(-SYMBOLS, SYMBOLS, (1 + SYMBOLS,), np.int16)
        self.space = spaces.Dict(
            {"observation": rope_space(config), "achieved_goal": goal, "desired_goal": goal}
        )

    def begin(self, index: int) -> None:
        """Episode `index` has just begun: remember with which code."""
        self._began[index] = self.episodes.codes[index]

    def observation(self, index: int) -> dict[str, NDArray[Any]]:
        """What the agent of episode `index` sees."""
        code = self.episodes.codes[index]
        return {
            "observation": halves(self.episodes.observation(index))[0],
            "achieved_goal": _written(code, self._counts(index)),
            "desired_goal": _written(self.episodes.goals[index], True),
        }

    def reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> Any:
        """What goals (..., 1 + SYMBOLS) pay: `success_reward` where they are equal and count."""
        achieved, desired = np.asarray(achieved_goal), np.asarray(desired_goal)
        reached = (achieved == desired).all(axis=-1) & (desired[..., 0] == 1)
        paid = np.where(reached, self.episodes.config.success_reward, 0.0)
        return paid if paid.ndim else float(paid)

    def _counts(self, index: int) -> bool:
        episodes, code = self.episodes, self.episodes.codes[index]
        limit = episodes.config.tow_limit
        if code.matches(self._began[index]) or len(code.visits) > SYMBOLS:
            return False
        points, origins = episodes.simulation.points[[index]], episodes.origins[[index]]
        towed = limit is not None and distances_towed(points, origins)[0] > limit
        return not (towed or episodes.failed[index])


def rope_space(config: TaskConfig) -> spaces.Box:
    """The space of what is seen of the rope alone."""
    whole: Any = observation_space(config)
    return spaces.Box(halves(whole.low)[0], halves(whole.high)[0], dtype=whole.dtype)


def halves(seen: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """What is seen of the rope, and of its goal; of a picture, a state or symbols."""
    rope, goal = np.split(seen, 2, axis=1 if seen.ndim == 3 else 0)
    return (rope[0], goal[0]) if seen.ndim == 2 else (rope, goal)


def require_one_side(config: TaskConfig) -> None:
    """Refuse settings of what is shown that mean nothing where the rope is shown alone."""
    if config.observation == "both" or config.layout != "beside":
        raise InvalidSetting(
            "where the rope is shown without its goal, observation is pixels, state or symbolic,"
            f" and layout beside; got {config.observation!r} and {config.layout!r}"
        )


def _written(code: GaussCode, counts: bool) -> NDArray[np.int16]:
    return np.concatenate([np.array([counts], np.int16), numbers(code.visits)])
