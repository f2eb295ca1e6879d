"""The environments: `KnotEnv` for one rope, `KnotVectorEnv` for many in one simulation."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from knotgym.common import Failed, InvalidInput, MissingExtra, python_values
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope import VIEWS, warn_of_compilation

Info = dict[str, Any]
_FPS = 5  # an action lasts 0.192 s
_NEXT_STEP, _SAME_STEP, _DISABLED = "NextStep", "SameStep", "Disabled"  # Gymnasium's values
_MODE: Any = getattr(gym.vector, "AutoresetMode", str)  # Gymnasium before 1.1 has no such class


class _HorizonSpec(EnvSpec):
    """A spec that says truly after how many steps an episode ends, whatever wraps it.

    Attributes:
        horizon: the environment's own limit. `TimeLimit` with a lower one ends episodes earlier;
            with a higher one, as from `gymnasium.make(..., max_episode_steps=120)`, it has no
            effect, which no environment can find out before somebody reads the spec.
    """

    horizon: int

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "max_episode_steps" and value > self.horizon:
            gym.logger.warn(
                f"max_episode_steps = {value} has no effect: episodes end after horizon ="
                f" {self.horizon} steps; make the environment with horizon={value}"
            )
            value = self.horizon
        super().__setattr__(name, value)


class _KnowsHorizon:
    """Keeps a spec, which Gymnasium sets, as a `_HorizonSpec`, for wrappers that read it.

    Its keywords are Python's own values: JSON has no NumPy scalars, and Minari's collector leaves a
    spec without JSON out of its dataset in silence.
    """

    config: TaskConfig

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, EnvSpec):
            given, horizon, value = vars(value), self.config.horizon, object.__new__(_HorizonSpec)
            vars(value).update(given, horizon=horizon, max_episode_steps=horizon)
            value.kwargs = python_values(given["kwargs"])
        super().__setattr__(name, value)


class KnotEnv(_KnowsHorizon, gym.Env[Any, NDArray[Any]]):
    """Environment with one rope; for keywords see `TaskConfig`, for info `EpisodeBatch`."""

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": _FPS}
    _batch: ClassVar = EpisodeBatch

    def __init__(
        self, task: str | Sequence[str], render_mode: str | None = "rgb_array", **settings: Any
    ) -> None:
        self.config = TaskConfig.of(task, settings)
        warn_of_compilation(self.config.engine)
        self.render_mode = _checked(render_mode, "rgb_array", "human")
        self._window = _Window() if render_mode == "human" else None
        self.episodes = self._batch(self.config)
        self.observation_space = self.episodes.space
        self.action_space = VIEWS[self.config.action].space(self.config.beads)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Start a new episode; options `start` and `goal` choose rows of the state file."""
        super().reset(seed=seed)
        self.episodes.begin(np.array([0]), [self.np_random], options)
        self._show()
        return self._seen()

    def step(self, action: NDArray[Any]) -> tuple[Any, float, bool, bool, Info]:
        """Take one action.

        Raises:
            InvalidInput: a number is NaN or out of range; the rope has not moved.
            gymnasium.error.ResetNeeded: the environment was never reset.
        """
        _require_reset(self.episodes)
        reward, terminated, truncated = self.episodes.act(np.asarray(action)[None], np.array([0]))
        observation, info = self._seen()
        ends = bool(terminated[0]), bool(truncated[0])
        self._show("reached" if info["is_success"] else "failed" if any(ends) else "")
        return observation, float(reward[0]), *ends, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the rope and its goal, uint8 (views * size, 2 size, 3), in mode "rgb_array"."""
        return self.episodes.rgb(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window of render mode "human"."""
        if self._window is not None:
            self._window.close()

    def _seen(self) -> tuple[Any, Info]:
        """Return what `reset` and `step` show: the observation and `info`."""
        return self.episodes.observation(0), self.episodes.info_rows(np.array([0]))[0]

    def _show(self, outcome: str = "") -> None:
        """Draw the state in the window of render mode "human"."""
        if self._window is not None:
            self._window.show(self.episodes, outcome)


class _Window:
    """The window of render mode "human".

    Raises:
        MissingExtra: pygame isn't installed.
        Failed: from `show`, there is no display.
    """

    def __init__(self) -> None:
        self._pygame = MissingExtra.imported("pygame", "pip install pygame", "render_mode 'human'")
        self._screen: Any = None
        self._side = 0.0

    def show(self, episodes: EpisodeBatch, outcome: str) -> None:
        """Draw the state of a batch's first rope beside its goal, and wait to keep the frame rate.

        The window opens with the first frame, and doesn't zoom in during an episode.
        """
        # here, since a film needs PIL
        from knotgym.rendering import Film

        pygame, step, views = self._pygame, int(episodes.steps[0]), episodes.task.views
        ropes = episodes.simulation.points[0], episodes.goal_points(0)
        self._side = max(Film.side(ropes, views), self._side if step else 0.0)
        heading = f"step {step} of {episodes.task.horizon}"
        frame = Film.frame(*ropes, heading, None, outcome, views, self._side)
        if self._screen is None:
            # A window that SDL fills by OpenGL holds this thread's context: beside it MuJoCo's
            # renderer could make none by EGL, and would crash by OSMesa.
            os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
            needed = "render_mode 'human' needs a display; use 'rgb_array' without one"
            with Failed.instead(needed, pygame.error):
                pygame.display.init()
                self._screen = pygame.display.set_mode(frame.shape[1::-1])
            pygame.display.set_caption("knotgym")
            self._clock = pygame.time.Clock()
        self._screen.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(_FPS)

    def close(self) -> None:
        """Close the window; a later frame opens a new one."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None


class KnotVectorEnv(_KnowsHorizon, gym.vector.VectorEnv[Any, NDArray[Any], NDArray[Any]]):
    """Environment with many ropes; with seed s, rope i behaves as `KnotEnv` with seed s + i.

    Args:
        task: "unknot", "tie" or "convert", or a list of them.
        num_envs: number of ropes.
        threads: that share stepping, codes and pictures; 0 for every core. They change no byte.
        autoreset_mode: "next_step", "same_step" or "disabled", or Gymnasium's constants.
        render_mode: "rgb_array" or None.
        max_episode_steps: Gymnasium's word for the keyword `horizon`; None for that.
        settings: keywords, see `TaskConfig`.
    """

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": _FPS,
        "autoreset_mode": _MODE(_NEXT_STEP),
    }

    def __init__(
        self,
        task: str | Sequence[str],
        num_envs: int = 1,
        threads: int = 0,
        autoreset_mode: Any = "next_step",
        render_mode: str | None = "rgb_array",
        max_episode_steps: int | None = None,
        **settings: Any,
    ) -> None:
        if max_episode_steps is not None:
            settings.setdefault("horizon", max_episode_steps)
        self.config = TaskConfig.of(task, settings)
        if max_episode_steps not in (None, self.config.horizon):
            given = f"max_episode_steps is {max_episode_steps} and horizon {self.config.horizon}"
            raise InvalidInput(f"{given}, and they are the same thing: give one")
        warn_of_compilation(self.config.engine)
        self.render_mode = _checked(render_mode, "rgb_array")
        self.num_envs = num_envs
        self.autoreset_mode = _autoreset(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.episodes = EpisodeBatch(self.config, num_envs, threads)
        self.single_observation_space = self.episodes.space
        self.single_action_space = VIEWS[self.config.action].space(self.config.beads)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs = [np.random.default_rng() for _ in range(num_envs)]
        self._done = np.zeros(num_envs, dtype=bool)
        self._all = np.arange(num_envs)

    def __len__(self) -> int:
        """Return the number of ropes."""
        return self.num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Any, Info]:
        """Start new episodes; options as in `KnotEnv`, and `reset_mask`, bool (num_envs,)."""
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise InvalidInput(f"reset_mask must be {self.num_envs} booleans, got {mask!r:.80}")
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + i for i in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise InvalidInput(
                f"a list of seeds needs one for each of {self.num_envs} ropes, got {len(seeds)}"
            )
        chosen = np.flatnonzero(mask)
        for i in chosen:
            if seeds[i] is not None:
                self._rngs[i] = np.random.default_rng(seeds[i])
        self._begin(chosen, options)
        self._done[mask] = False
        return self.episodes.observations(self._all), self._infos(chosen)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Take one action with every rope; `autoreset_mode` says when ended episodes restart."""
        _require_reset(self.episodes)
        done = self._done.copy()
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise InvalidInput(
                f"actions must have shape {self.action_space.shape}, got {actions.shape}"
            )
        if done.any() and self.autoreset_mode == _MODE(_DISABLED):
            over = np.flatnonzero(done).tolist()
            raise InvalidInput(f"episodes {over} have ended: reset them, by options reset_mask")
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), dtype=bool)
        running, ended = np.flatnonzero(~done), np.flatnonzero(done)
        # next_step: what ended in the step before is reset in this one, and its action ignored
        restart = partial(self._begin, ended) if len(ended) else None
        if len(running):
            rewards[running], terminated[running], truncated[running] = self.episodes.act(
                actions[running], running, restart
            )
        elif restart is not None:
            restart()
        self._done = terminated | truncated
        final: Info = {}
        if self.autoreset_mode == _MODE(_SAME_STEP) and self._done.any():
            ended = np.flatnonzero(self._done)
            last = np.full(self.num_envs, None, dtype=object)
            for i in ended:
                last[i] = self.episodes.observation(int(i))
            final = {"final_obs": last, "final_info": self._infos(ended)}
            final |= {f"_{name}": self._done.copy() for name in list(final)}
            self._begin(ended)
            self._done[:] = False
        infos = {**self._infos(self._all), **final}
        return self.episodes.observations(self._all), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return one picture per rope, uint8 (views * size, 2 size, 3) each."""
        if self.render_mode != "rgb_array":
            return None
        return tuple(self.episodes.rgb(i) for i in range(self.num_envs))

    def _begin(self, ids: NDArray[np.int64], options: Info | None = None) -> None:
        self.episodes.begin(ids, [self._rngs[i] for i in ids], options)

    def _infos(self, ids: NDArray[np.int64]) -> Info:
        """Return the infos of the ropes `ids` as Gymnasium does: arrays over all ropes, and masks.

        The others have 0 or None.
        """
        infos: Info = {}
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[ids] = True
        for name, column in self.episodes.infos(ids).items():
            array = np.zeros((self.num_envs, *column.shape[1:]), dtype=column.dtype)
            if column.dtype == object:
                array[:] = None
            array[ids] = column
            infos[name], infos[f"_{name}"] = array, mask.copy()
        return infos


def _autoreset(mode: Any) -> Any:
    """Return Gymnasium's constant for an autoreset mode."""
    known = {"next_step": _NEXT_STEP, "same_step": _SAME_STEP, "disabled": _DISABLED}
    given = str(getattr(mode, "value", mode))
    name = known.get(given, given)
    if name not in known.values():
        raise InvalidInput(f"no autoreset_mode {given!r}; there is {', '.join(known)}")
    return _MODE(name)


def _require_reset(episodes: EpisodeBatch) -> None:
    if episodes.goal_row.min() < 0:
        raise ResetNeeded("reset the environment before its first step")


def _checked(render_mode: str | None, *known: str) -> str | None:
    if render_mode not in (None, *known):
        modes = ", ".join(f'"{mode}"' for mode in known)
        raise InvalidInput(f"no render_mode {render_mode!r}; there is {modes} or None")
    return render_mode
