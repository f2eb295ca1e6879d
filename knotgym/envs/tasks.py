"""The three tasks, and the settings of their environments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from knotgym.common.errors import InvalidInput
from knotgym.envs.reward import FAILURE_REWARD, SUCCESS_REWARD, RewardRule
from knotgym.quality.limits import RESET_NOISE
from knotgym.rendering.views import check_depth, checked_views
from knotgym.rope.engines import ENGINES, MUJOCO
from knotgym.states.schema import CODE_SPLITS, STATE_SPLITS

if TYPE_CHECKING:
    from knotgym.rope.model import RopeConfig

OBSERVATIONS = ("pixels", "state", "both", "symbolic", "marked")
ACTIONS = ("pull", "bead", "macro")  # see `knotgym.rope.action_views`
LAYOUTS = ("beside", "stacked")  # arrangement of the rope's and the goal's picture
MAX_NX = 11  # crossings; a rope of 100 beads hardly has room for more
MIN_BEADS, MAX_BEADS = 50, 1000

# task -> (crossings of the start, crossings of the goal) for a difficulty nx
TASKS: dict[str, Callable[[int], tuple[int, int]]] = {
    "unknot": lambda nx: (nx, 0),
    "tie": lambda nx: (0, nx),
    "convert": lambda nx: (nx - 1, nx),
}


class UnknownKeyword(InvalidInput, TypeError):
    """An unknown keyword of an environment.

    A TypeError in Python's own words, because TorchRL retries without `frameskip` only on these.
    """


def max_nx(beads: Any) -> int:
    """Return the largest number of crossings for which a rope of so many beads has room."""
    return MAX_NX * beads // 100 if isinstance(beads, int) else MAX_NX


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Settings of an environment.

    Every field is JSON-serializable and a keyword of `gymnasium.make`.

    Attributes:
        task: task: tie, unknot or convert.
        nx: number of crossings of the tangled side; convert starts at one less.
        split: split of the states: train, test, train-code or test-code. The last two are subsets
            of the others that share no code, even up to symmetry.
        states: set of states: readable (default), random-walk or hard-unknots, which are included;
            or a state file, or the folder of the run that made it, or the id of a Minari dataset
            that contains one. If a file has no plain loops, they come from the readable set.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
        beads: number of beads of the rope, each 13.3 mm long. The states must have as many; the
            sets that are included have 100.
        observation: observation: pixels, state, both, symbolic or marked.
        action: "pull", six numbers; "bead", a bead and binned forces; or "macro", a bead led past a
            strand by up to ten pulls. See `knotgym.rope.action_views`.
        max_goals: use only the first N goal states of the split, in file order; all by default.
        image_size: side of each half of the picture (rope and goal), in pixels.
        views: camera views in the picture, comma-separated: top, left, front.
        depth: add depth as a fourth image channel.
        horizon: steps before an episode is truncated. A macro-action is as many steps as it has
            pulls.
        hold: consecutive steps that the rope must show the goal code.
        endless: episodes don't end at the goal, but only at the horizon; the reward is
            `success_reward` at every step that shows the goal, otherwise 0.
        tow_limit: furthest that the rope's centre may be towed, in metres; no limit by default.
            Beyond it no state counts as the goal, and the episode is truncated. With 0.04,
            repeating one action hardly ever unties a rope.
        reset_noise: scale of the noise added at reset, in radians per joint and in metres.
        layout: "beside", rope left and goal right, (size, 2 size, 3); or "stacked", the goal's
            channels after the rope's, (size, size, 6).
        camera: projection: orthographic or perspective.
        renderer: "auto", "opencv" or "mujoco"; "mujoco" doesn't draw depth.
        integrator_steps: MuJoCo steps per action; 20 is faster and gives slightly different
            trajectories.
        success_reward: reward on success.
        failure_reward: reward at the horizon, or beyond `tow_limit`, without success.
        numeric_infos: whether `info` holds numbers instead of text, see `EpisodeBatch.info`.
    """

    task: str
    nx: int = 2
    split: str = "train"
    states: str | None = None
    engine: str = MUJOCO
    beads: int = 100
    observation: str = "pixels"
    action: str = "pull"
    max_goals: int | None = None
    horizon: int = 50
    hold: int = 1
    endless: bool = False
    tow_limit: float | None = None
    reset_noise: float = RESET_NOISE
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
            "split": (*STATE_SPLITS, *CODE_SPLITS),
            "engine": ENGINES,
            "observation": OBSERVATIONS,
            "action": ACTIONS,
            "layout": LAYOUTS,
            "camera": ("orthographic", "perspective"),
            "renderer": ("auto", "opencv", "mujoco"),
        }.items():
            if getattr(self, name) not in known:
                raise InvalidInput(
                    f"no {name} {getattr(self, name)!r}; there is {', '.join(known)}"
                )
        object.__setattr__(self, "views", checked_views(self.views, InvalidInput))
        check_depth(self.depth, self.renderer, InvalidInput)
        for name, least, most in (
            ("beads", MIN_BEADS, MAX_BEADS),
            ("nx", 1, max_nx(self.beads)),
            ("horizon", 1, None),
            ("hold", 1, None),
            ("image_size", 16, 2048),
            # an action takes 0.192 s; with fewer steps, ropes under large forces blow up
            ("integrator_steps", 20, 96),
        ):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if not whole or value < least or (most is not None and value > most):
                right = f"from {least} to {most}" if most else f"of at least {least}"
                raise InvalidInput(f"{name} must be a whole number {right}, got {value!r}")
        if self.split in CODE_SPLITS and self.nx < 2:
            raise InvalidInput(
                f"split {self.split!r} needs several diagrams, and with nx = {self.nx} there is"
                " only one up to symmetry; use an nx of at least 2, or split 'train' or 'test'"
            )
        if self.engine != MUJOCO and self.integrator_steps != 24:
            raise InvalidInput(
                f"integrator_steps are steps of MuJoCo, and engine {self.engine!r} chooses its own;"
                f" leave it at 24, got {self.integrator_steps}"
            )
        if self.hold > self.horizon:
            raise InvalidInput(
                f"hold {self.hold} is longer than the horizon of {self.horizon} steps: no episode"
                f" could succeed; at most {self.horizon}"
            )
        goals = self.max_goals
        if goals is not None and (not isinstance(goals, int) or goals is True or goals < 1):
            raise InvalidInput(
                f"max_goals must be a whole number of at least 1, or None, got {goals!r}"
            )
        for name in ("endless", "numeric_infos"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidInput(f"{name} must be True or False, got {getattr(self, name)!r}")
        if self.states is not None and not isinstance(self.states, str):
            raise InvalidInput(
                f"states must be the path of a state file as a string, got {self.states!r}"
            )
        if self.tow_limit is not None and not self.tow_limit > 0:
            raise InvalidInput(
                f"tow_limit must be a number of metres above 0, or None, got {self.tow_limit!r}"
            )
        if not 0 <= self.reset_noise < 1:
            raise InvalidInput(f"reset_noise must be in [0, 1), got {self.reset_noise!r}")

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
        """Parameters of the reward."""
        return RewardRule(
            hold=self.hold,
            horizon=self.horizon,
            success_reward=self.success_reward,
            failure_reward=self.failure_reward,
            endless=self.endless,
        )

    @property
    def rope(self) -> RopeConfig:
        """The rope, with an action's time divided into `integrator_steps`."""
        from knotgym.rope.model import rope_of  # here, so that loaders need no simulator

        default = rope_of(self.beads)
        return replace(
            default,
            frame_skip=self.integrator_steps,
            timestep=default.timestep * default.frame_skip / self.integrator_steps,
        )
