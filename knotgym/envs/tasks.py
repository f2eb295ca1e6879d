"""The three tasks, and the settings of their environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, PositiveFloat, PositiveInt

import knotgym
from knotgym.common import Distinct, InvalidInput, Kinds, Mark, choice, configuration
from knotgym.envs.observations import LAYOUTS, OBSERVATIONS
from knotgym.quality import Quality
from knotgym.rendering import APPEARANCES, AppearanceName, CameraName, PictureConfig, Views
from knotgym.rope import ENGINES, MUJOCO, VIEWS, EngineName
from knotgym.states import SPLITS

if TYPE_CHECKING:
    from knotgym.rope import RopeConfig

MOST_STEPS = 100_000  # of an episode; arrays of all steps are made before it begins
_BEADS = range(50, 1001)  # that a rope may have

# Each field has one role, from which follows what datasets and scores must share.
_RULES = Mark("rules")  # how an episode begins and ends, and what is success
_PHYSICS = Mark("physics")  # where a pull leads
_VIEW = Mark("view")  # what is observed, and what an action is
_LOOK = Mark("look")  # how pictures are drawn
_NAMED = Mark("named")  # and stands in a dataset's id by its value
_READ = Mark("read")  # and is read by loaders, as looks are: the same in what is loaded together

# task -> (crossings of the start, crossings of the goal) for a difficulty nx
TASKS: Kinds[Callable[[int], tuple[int, int]]] = Kinds(
    "task",
    {"unknot": lambda nx: (nx, 0), "tie": lambda nx: (0, nx), "convert": lambda nx: (nx - 1, nx)},
    " (register_task, or --plugin MODULE, adds others)",
)


def register_task(name: str, crossings: Callable[[int], tuple[int, int]]) -> None:
    """Add a task, and register its environment with Gymnasium as knotgym/Name-v0.

    Workers make their own tasks, so a name must be registered in every process that uses it, as by
    a plugin (`--plugin`).

    Args:
        name: a lower-case word.
        crossings: nx -> the crossings of the start and of the goal.

    Raises:
        InvalidInput: the name is taken or no such word.
    """
    if name in TASKS or not (name.isidentifier() and name.islower()):
        raise InvalidInput(f"a task's name is a new lower-case word, got {name!r}")
    TASKS[name] = crossings
    knotgym.register_environment(name)


TaskName = Annotated[str, choice(growing=TASKS)]


class UnknownKeyword(InvalidInput, TypeError):
    """An unknown keyword of an environment.

    A TypeError in Python's own words, because TorchRL retries without `frameskip` only on these.
    """


@configuration
class TaskConfig:
    """Settings of an environment.

    Every field is JSON-serializable and a keyword of `gymnasium.make`. With several tasks or
    crossing numbers every reset draws one of their combinations.

    Attributes:
        task: task: tie, unknot or convert. May be several.
        nx: number of crossings of the tangled side; convert starts at one less. May be several.
        split: split of the states: train, test, train-code or test-code. The last two are subsets
            of the others that share no code, even up to symmetry.
        states: set of states: readable (default), bench, random-walk or hard-unknots, which are
            included; or a state file, or the folder of the run that made it, or the id of a Minari
            dataset that contains one. If a file has no plain loops, they come from the readable
            set.
        engine: simulation engine: mujoco, the reference, or chain, which is many times as fast.
        beads: number of beads of the rope, each 13.3 mm long. The states must have as many; the
            sets that are included have 100.
        rope: parameters of the rope that differ from the published ones, such as {"joint_damping":
            0.02, "max_force": 0.3}: any of `knotgym.rope.RopeConfig` but those that have keywords
            of their own (beads, integrator_steps) or that states depend on otherwise. The states
            must fit: their ropes have the same length and radius.
        observation: observation: pixels, state, both, symbolic or marked.
        action: "pull", six numbers; "bead", a bead and binned forces; "macro", a bead led past a
            strand by up to ten pulls; or "decision", a bead and the forces of up to ten pulls. See
            `knotgym.rope.action_views`.
        frame: of actions and of the observation state: "world", or "canonical", the rope's own
            frame, in which all images of a state by the task's symmetries look alike. marked is
            always seen in it.
        max_goals: use only the first N goal states of the split, in file order; all by default.
        image_size: side of each half of the picture (rope and goal), in pixels.
        views: camera views in the picture, comma-separated: top, left, front.
        depth: add depth as a fourth image channel.
        horizon: steps before an episode is truncated, at most 100,000. A macro-action is as many
            steps as it has pulls.
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
        appearance: of the pictures, one of `knotgym.rendering.APPEARANCES`. Photos have a white
            mark on the base bead and a red one on the bead before it, and each goal state has its
            own rope, table and light; a line marks neither base nor direction.
        renderer: "auto", "opencv" or "mujoco"; "mujoco" doesn't draw depth.
        integrator_steps: MuJoCo steps per action; 20 is faster and gives slightly different
            trajectories.
        success_reward: reward on success.
        failure_reward: reward at the horizon, or beyond `tow_limit`, without success.
        numeric_infos: whether `info` holds numbers instead of text, see `EpisodeBatch.info_rows`.
    """

    BEADS: ClassVar = _BEADS

    task: Annotated[TaskName | Annotated[tuple[TaskName, ...], Distinct], _RULES, _NAMED]
    nx: Annotated[PositiveInt | Annotated[tuple[PositiveInt, ...], Distinct], _RULES, _NAMED] = 2
    split: Annotated[str, choice(growing=SPLITS), _RULES, _NAMED] = "train"
    states: Annotated[Annotated[str, Mark("states")] | None, _RULES, _NAMED] = None
    engine: Annotated[EngineName, _PHYSICS, _NAMED] = MUJOCO
    beads: Annotated[int, Field(ge=_BEADS.start, le=_BEADS[-1]), _PHYSICS, _READ] = 100
    rope: Annotated[dict[str, float] | None, _PHYSICS] = None
    observation: Annotated[str, choice(growing=OBSERVATIONS), _VIEW, _NAMED, _READ] = "pixels"
    action: Annotated[str, choice(growing=VIEWS), _VIEW, _READ] = "pull"
    frame: Annotated[str, choice("world", "canonical"), _VIEW] = "world"
    max_goals: Annotated[PositiveInt | None, _RULES] = None
    horizon: Annotated[int, Field(ge=1, le=MOST_STEPS), _RULES] = 50
    hold: Annotated[PositiveInt, _RULES, _READ] = 1
    endless: Annotated[bool, _RULES] = False
    tow_limit: Annotated[PositiveFloat | None, _RULES, _READ] = None
    reset_noise: Annotated[float, Field(ge=0, lt=1), _RULES] = Quality.RESET_NOISE
    image_size: Annotated[int, Field(ge=16, le=2048), _LOOK] = 128
    views: Annotated[Views, _LOOK] = ("top",)
    depth: Annotated[bool, _LOOK] = False
    layout: Annotated[str, choice(growing=LAYOUTS), _LOOK] = "beside"
    camera: Annotated[CameraName, _LOOK] = "orthographic"
    appearance: Annotated[AppearanceName, _LOOK] = "published"
    renderer: Annotated[str, choice("auto", "opencv", "mujoco"), _LOOK] = "auto"
    # an action takes 0.192 s; with fewer steps, ropes under large forces blow up
    integrator_steps: Annotated[int, Field(ge=20, le=96), _PHYSICS] = 24
    success_reward: Annotated[float, _RULES, _READ] = 5.0
    failure_reward: Annotated[float, _RULES] = -5.0
    numeric_infos: Annotated[bool, _VIEW] = False

    def __post_init__(self) -> None:
        if self.rope is not None:
            from knotgym.rope import RopeConfig

            derived = {name for name, *_ in Mark.fields(RopeConfig, {}, "derived")}
            known = sorted({field.name for field in fields(RopeConfig)} - derived)
            if unknown := sorted(self.rope.keys() - known):
                raise InvalidInput(
                    f"rope may set {', '.join(known)}; got {', '.join(map(repr, unknown))}"
                )
            _ = self.rope_config  # refuses values out of range
        PictureConfig(depth=self.depth, renderer=self.renderer)  # type: ignore[arg-type]
        framed = OBSERVATIONS[self.observation].canonical is not None
        if self.is_canonical and not (framed and VIEWS[self.action].to_world):
            shown = (f'"{name}"' for name, kind in OBSERVATIONS.items() if kind.canonical)
            lack = (f'"{name}"' for name, kind in VIEWS.items() if not kind.to_world)
            raise InvalidInput(
                f'frame "canonical" goes with observation {" or ".join(shown)} and any action but'
                f" {', '.join(lack)}, whose forces are of the world; got"
                f" {self.observation!r} and {self.action!r}"
            )
        if max(self.crossings) > (most := self.most_nx(self.beads)):
            raise InvalidInput(f"nx must be from 1 to {most} on {self.beads} beads, got {self.nx}")
        if SPLITS[self.split].by_code and min(self.crossings) < 2:
            raise InvalidInput(f"with split {self.split!r} use an nx of at least 2, got {self.nx}")
        if self.integrator_steps != 24 and not ENGINES[self.engine].has_integrator:
            raise InvalidInput(f"integrator_steps are steps of MuJoCo, not of {self.engine!r}")
        plain = self.views == ("top",) and not self.depth and self.camera == "orthographic"
        if not APPEARANCES[self.appearance].obeys and not (plain and self.renderer != "mujoco"):
            raise InvalidInput(
                f'appearance "{self.appearance}" is the orthographic top view, without depth and'
                " not drawn by MuJoCo; leave out views, depth, camera and renderer"
            )
        if self.hold > self.horizon:
            raise InvalidInput(
                f"hold {self.hold} is longer than the horizon of {self.horizon} steps"
            )

    @classmethod
    def of(cls, task: Any, settings: dict[str, Any]) -> TaskConfig:
        """Return the settings that keywords of an environment specify.

        Raises:
            UnknownKeyword: a keyword is unknown.
            InvalidInput: a value is invalid.
        """
        known = [field.name for field in fields(cls)]
        unknown = [name for name in settings if name not in known]
        if unknown:
            raise UnknownKeyword(
                f"got an unexpected keyword argument {', '.join(map(repr, unknown))}; there is"
                f" {', '.join(name for name in known if name != 'task')}"
            )
        return cls(task=task, **settings)

    @staticmethod
    def joined(tasks: Sequence[TaskConfig]) -> TaskConfig:
        """Return the task that draws from all of those, which differ in task, nx and split only."""
        names = dict.fromkeys(name for task in tasks for name in task.tasks)
        crossings = sorted({nx for task in tasks for nx in task.crossings})
        several: dict[str, Any] = {"task": (*names,), "nx": (*crossings,)}
        return replace(tasks[0], **{name: each for name, each in several.items() if len(each) > 1})

    @staticmethod
    def most_nx(beads: int) -> int:
        """Return the largest number of crossings for which a rope of so many beads has room."""
        return 11 * beads // 100  # a rope of 100 beads hardly has room for more

    @property
    def is_canonical(self) -> bool:
        """Whether actions and vertices are in the rope's own frame."""
        return self.frame == "canonical"

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks, one or several."""
        return (self.task,) if isinstance(self.task, str) else self.task

    @property
    def crossings(self) -> tuple[int, ...]:
        """The values of nx, one or several."""
        return self.nx if isinstance(self.nx, tuple) else (self.nx,)

    @property
    def name(self) -> str:
        """Tasks and crossings in a dataset's id, such as "tie-nx2" or "tie-convert-nx2-3"."""
        return "-".join([*self.tasks, "nx" + "-".join(map(str, self.crossings))])

    @property
    def singles(self) -> tuple[TaskConfig, ...]:
        """The combinations of one task and one nx, without those that are the same."""
        tasks_by_sides = {
            TASKS[task](nx): replace(self, task=task, nx=nx)
            for task, nx in product(reversed(self.tasks), reversed(self.crossings))
        }
        return tuple(reversed(tasks_by_sides.values()))

    @property
    def sides(self) -> tuple[int, int]:
        """Crossings of the start and of the goal, in the first task."""
        return TASKS[self.tasks[0]](self.crossings[0])

    @property
    def rope_config(self) -> RopeConfig:
        """The rope, with an action's time divided into `integrator_steps`."""
        default = self.rope_at_rest
        return replace(
            default,
            **(self.rope or {}),  # type: ignore[arg-type]
            frame_skip=self.integrator_steps,
            timestep=default.timestep * default.frame_skip / self.integrator_steps,
        )

    @property
    def rope_at_rest(self) -> RopeConfig:
        """The rope as far as a state depends on it: the published one with this shape."""
        from knotgym.rope import RopeConfig

        usual, given = RopeConfig.of(self.beads), self.rope or {}
        shape = [name for name, *_ in Mark.fields(RopeConfig, given, "shape") if name in given]
        return replace(usual, **{name: given[name] for name in shape})  # type: ignore[arg-type]
