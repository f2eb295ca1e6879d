"""The three tasks: where a rope starts, which Gauss code it shall show, and all other settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from knotgym.errors import KnotgymError
from knotgym.reward import FAILURE_REWARD, SUCCESS_REWARD, RewardRule

if TYPE_CHECKING:
    from knotgym.rope import RopeConfig

SPLITS = ("train", "test")  # of a state file
# of these the rows of other diagrams, and of diagrams held out: see `States.rows`
CODE_SPLITS = ("train-code", "test-code")
OBSERVATIONS = ("pixels", "state", "both", "symbolic")
LAYOUTS = ("beside", "stacked")  # of the two halves of a picture
VIEWS = ("top", "left", "front")  # of the rope, see `rendering.camera`
MAX_NX = 11  # the largest of the hard unknots; a rope has hardly room for more

# task -> (crossings of the start, crossings of the goal) for a difficulty nx
TASKS: dict[str, Callable[[int], tuple[int, int]]] = {
    "unknot": lambda nx: (nx, 0),
    "tie": lambda nx: (0, nx),
    "convert": lambda nx: (nx - 1, nx),
}


class InvalidSetting(KnotgymError, ValueError):
    """A keyword of an environment that cannot be had."""


class UnknownKeyword(InvalidSetting, TypeError):
    """There is no such keyword.

    A TypeError in Python's own words, for TorchRL tries again without `frameskip` on no other.
    """


def checked_views(views: Sequence[str], error: type[KnotgymError]) -> tuple[str, ...]:
    """Views as a tuple (JSON has lists); raise error unless each is of VIEWS and named once."""
    named = tuple(views) if isinstance(views, (tuple, list)) else ()
    if not named or any(view not in VIEWS for view in named) or len({*named}) < len(named):
        raise error(
            f"views must be a list of {', '.join(VIEWS)}, each at most once, one at least; got"
            f" {views!r}"
        )
    return named


def check_depth(depth: object, renderer: str, error: type[KnotgymError]) -> None:
    """Raise error unless depth is a bool, and drawn by a renderer that draws it."""
    if not isinstance(depth, bool):
        raise error(f"depth must be true or false, got {depth!r}")
    if depth and renderer == "mujoco":
        raise error("depth is drawn by renderer 'opencv' (or 'auto', the same), not by 'mujoco'")


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """What an environment was asked for.

    Every field is JSON-able and a keyword of `gymnasium.make`.

    Attributes:
        task: "unknot", "tie" or "convert".
        nx: crossings of the tangled side; convert starts at nx - 1.
        split: rows of the state file to draw from: "train" or "test"; or "train-code" and
            "test-code", parts of those two that share no code even up to symmetry.
        states: "readable" (the same as None), "random-walk" or "hard-unknots", sets that ship,
            see `datasets.states.shipped`; or path of a state file, or of the run that made it, or
            id of a Minari dataset that carries one. Plain loops, and they alone, come from the
            readable set where a file has none.
        observation: "pixels", "state", "both" or "symbolic".
        max_goals: so many goal configurations of the split at most are drawn from, the first by
            row; None for all.
        horizon: steps until truncation.
        hold: consecutive steps the goal code must show.
        tow_limit: metres that the rope's centre may be from where it was at reset; farther off no
            state counts as the goal, and the episode is truncated. None for no bound. With 0.04
            an action that is only repeated hardly ever unties a rope (`benchmarks/towing.py`).
        reset_noise: scale of the noise at reset, radians per joint and metres.
        image_size: pixels, each half of the picture.
        views: where the rope is seen from: "top", "left", "front", each at most once, one picture
            below another.
        depth: a fourth channel, how near to the camera the rope is, see `rendering.picture`.
        layout: "beside", rope left and goal right, (size, 2 size, 3); or "stacked", the goal's
            channels behind the rope's, (size, size, 6).
        camera: "orthographic" or "perspective".
        renderer: "auto", "opencv" or "mujoco"; depth is drawn by OpenCV alone.
        integrator_steps: MuJoCo steps that the 0.192 s of an action are cut into; 24 as published.
            With 20 an action takes five sixths of the time, and the bead furthest off ends 0.2 mm
            from where 24 put it, 2 mm after ten actions (`benchmarks/physics.py`). With fewer,
            ropes under large forces blow up; with 20, two in 100,000 random steps did.
        success_reward, failure_reward: paid at success, and at the horizon without it.
        numeric_infos: `info` holds integers where it else holds text, see `EpisodeBatch.info`.
    """

    task: str
    nx: int = 2
    split: str = "train"
    states: str | None = None
    observation: str = "pixels"
    max_goals: int | None = None
    horizon: int = 50
    hold: int = 1
    tow_limit: float | None = None
    reset_noise: float = 0.015
    image_size: int = 128
    views: tuple[str, ...] = ("top",)
    depth: bool = False
    layout: str = "beside"
    camera: str = "orthographic"
    renderer: str = "auto"
    integrator_steps: int = 24
    success_reward: float = SUCCESS_REWARD
    failure_reward: float = FAILURE_REWARD
    numeric_infos: bool = False

    def __post_init__(self) -> None:
        for name, known in {
            "task": tuple(TASKS),
            "split": (*SPLITS, *CODE_SPLITS),
            "observation": OBSERVATIONS,
            "layout": LAYOUTS,
            "camera": ("orthographic", "perspective"),
            "renderer": ("auto", "opencv", "mujoco"),
        }.items():
            if getattr(self, name) not in known:
                raise InvalidSetting(
                    f"no {name} {getattr(self, name)!r}; there is {', '.join(known)}"
                )
        object.__setattr__(self, "views", checked_views(self.views, InvalidSetting))
        check_depth(self.depth, self.renderer, InvalidSetting)
        for name, least, most in (
            ("nx", 1, MAX_NX),
            ("horizon", 1, None),
            ("hold", 1, None),
            ("image_size", 16, 2048),
            ("integrator_steps", 20, 96),
        ):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if not whole or value < least or (most is not None and value > most):
                right = f"from {least} to {most}" if most else f"of at least {least}"
                raise InvalidSetting(f"{name} must be a whole number {right}, got {value!r}")
        if self.split in CODE_SPLITS and self.nx < 2:
            raise InvalidSetting(
                f"split {self.split!r} needs diagrams to hold out, and with nx = {self.nx} there is"
                " one up to symmetry; give an nx of at least 2, or split 'train' or 'test'"
            )
        if self.hold > self.horizon:
            raise InvalidSetting(
                f"hold {self.hold} is longer than the horizon of {self.horizon} steps: no episode"
                f" could succeed; at most {self.horizon}"
            )
        goals = self.max_goals
        if goals is not None and (not isinstance(goals, int) or goals is True or goals < 1):
            raise InvalidSetting(
                f"max_goals must be a whole number of at least 1, or None, got {goals!r}"
            )
        if not isinstance(self.numeric_infos, bool):
            raise InvalidSetting(f"numeric_infos must be True or False, got {self.numeric_infos!r}")
        if self.states is not None and not isinstance(self.states, str):
            raise InvalidSetting(
                f"states must be the path of a state file as a string, got {self.states!r}"
            )
        if self.tow_limit is not None and not self.tow_limit > 0:
            raise InvalidSetting(
                f"tow_limit must be a number of metres above 0, or None, got {self.tow_limit!r}"
            )
        if not 0 <= self.reset_noise < 1:
            raise InvalidSetting(f"reset_noise must be in [0, 1), got {self.reset_noise!r}")

    @property
    def start_nx(self) -> int:
        """Crossings at reset."""
        return TASKS[self.task](self.nx)[0]

    @property
    def goal_nx(self) -> int:
        """Crossings of the goal."""
        return TASKS[self.task](self.nx)[1]

    @property
    def reward_rule(self) -> RewardRule:
        """What an episode pays, and when it ends."""
        return RewardRule(
            hold=self.hold,
            horizon=self.horizon,
            success_reward=self.success_reward,
            failure_reward=self.failure_reward,
        )

    @property
    def rope(self) -> RopeConfig:
        """The usual rope, an action's time cut into `integrator_steps`."""
        from knotgym.rope import RopeConfig  # here, so that loaders need no simulator

        usual = RopeConfig()
        return replace(
            usual,
            frame_skip=self.integrator_steps,
            timestep=usual.timestep * usual.frame_skip / self.integrator_steps,
        )
