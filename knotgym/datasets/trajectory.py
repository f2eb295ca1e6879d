"""Episodes (T actions and the T + 1 states around them) and hindsight relabelling.

Hindsight relabelling makes a code that the episode reached its goal.

states   s0  s1  s2  s3     action t leads from s[t] to s[t + 1]; no action leaves s3
actions    a0  a1  a2       rewards, terminations and truncations go with the actions
infos    i0  i1  i2  i3     one entry per state; bead, force, applied_share, move and macro_*
                            describe the step that led to the state (none led to s0); expert_action
                            is what the expert would do there
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.common.hdf5_files import Column
from knotgym.envs.reward import SUCCESS_REWARD, success_at_last
from knotgym.rope.towing import TowBound

RELABEL = ("last", "all")

# "steps" is T, "states" T + 1; arrays without either are stored once per episode
_COLUMNS = (
    Column("start_qpos", "float64", (None,), finite=True),
    Column("goal_points", "float64", ("beads", 3), finite=True),
    Column("points", "float64", ("states", "beads", 3), finite=True),
    Column("actions", "float32", ("steps", 6), finite=True),
    Column("rewards", "float64", ("steps",), finite=True),
    Column("terminations", "bool", ("steps",)),
    Column("truncations", "bool", ("steps",)),
)
_INFOS = (
    Column("gauss_code", "text", ("states",)),
    Column("gauss_code_chiral", "text", ("states",)),
    Column("crossings", "int64", ("states",)),
    Column("bead", "int64", ("states",)),
    Column("force", "float64", ("states", 3), finite=True),
    Column("applied_share", "float64", ("states",), finite=True),
    Column("is_success", "bool", ("states",)),
    Column("simulation_failed", "bool", ("states",)),
    Column("move", "text", ("states",)),
    Column("expert_action", "float32", ("states", 6), finite=True),
    Column("macro_start", "bool", ("states",)),
    Column("macro_bead", "int64", ("states",)),
    Column("macro_target", "int64", ("states",)),
    Column("macro_side", "int64", ("states",)),
)
ARRAYS = {column.name: column for column in (*_COLUMNS, *_INFOS)}  # in the order of the digest
INFOS = tuple(column.name for column in _INFOS)
MACRO_INFOS = ("macro_start", "macro_bead", "macro_target", "macro_side")
OPTIONAL = ("move", "expert_action", *MACRO_INFOS)  # infos that an episode may lack


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """T actions, at least one, and the T + 1 states around them.

    Two episodes are equal when their digests are.

    Attributes:
        start_qpos: float64 (nq,); a rope laid at rest there (`Simulation.lay`) and stepped with
            `actions` (`Simulation.act`) passes through `points` bit for bit.
        points: float64 (T + 1, beads, 3), metres.
        goal_points: float64 (beads, 3), metres: a configuration that shows the goal code.
        actions: float32 (T, 6), in [-1, 1].
        rewards: float64 (T,).
        terminations, truncations: bool (T,).
        gauss_code, gauss_code_chiral: str (T + 1,).
        crossings: int64 (T + 1,).
        bead, force: int64 (T + 1,) and float64 (T + 1, 3), newtons: the bead pulled in the step
            that led here and the force applied to it; -1 and 0 at the start.
        applied_share: float64 (T + 1,), applied force / requested force, see `Simulation.step`; 1
            at the start.
        is_success, simulation_failed: bool (T + 1,), as in the environment's infos.
        move: str (T + 1,), the policy's reason for the step, "" at the start; None if the policy
            gives no reasons.
        expert_action: float32 (T + 1, 6), in [-1, 1]: the first action of the expert's plan from
            each state, zeros at the last state; None if the expert wasn't run.
        macro_start: bool (T + 1,), whether the step that led here was the first of a macro-action;
            None, as the other three, if the episode wasn't played in macro-actions.
        macro_bead, macro_target: int64 (T + 1,), bead that the macro-action leads and bead whose
            strand it passes; -1 where no macro-action led.
        macro_side: int64 (T + 1,), +1 over, -1 under, 0 where no macro-action led.
        goal_gauss_code: the code to reach.
        seed: seed of the reset; None if no seed reproduces this episode.
        options: options of the reset: rows `start` and `goal` of the state file.
        policy: name of the policy that acted.
        relabelled: whether the goal is a state that was reached; no reset gives such a goal.
        hold: consecutive steps for which this episode had to show the goal, None for the task's
            value. Demonstrations of curated states continue after the code is reached, until
            the rope lies open.

    Raises:
        InvalidInput: an array has the wrong dtype, shape or length.
    """

    start_qpos: NDArray[np.float64]
    points: NDArray[np.float64]
    goal_points: NDArray[np.float64]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    gauss_code: NDArray[np.str_]
    gauss_code_chiral: NDArray[np.str_]
    crossings: NDArray[np.int64]
    bead: NDArray[np.int64]
    force: NDArray[np.float64]
    applied_share: NDArray[np.float64]
    is_success: NDArray[np.bool_]
    simulation_failed: NDArray[np.bool_]
    move: NDArray[np.str_] | None = None
    expert_action: NDArray[np.float32] | None = None
    macro_start: NDArray[np.bool_] | None = None
    macro_bead: NDArray[np.int64] | None = None
    macro_target: NDArray[np.int64] | None = None
    macro_side: NDArray[np.int64] | None = None
    goal_gauss_code: str
    seed: int | None = None
    options: Mapping[str, int] = field(default_factory=dict)
    policy: str
    relabelled: bool = False
    hold: int | None = None

    def __post_init__(self) -> None:
        if not len(self.actions):
            raise InvalidInput("an episode has at least 1 action, got 0")
        beads = np.shape(self.goal_points)[0]
        sizes = {"steps": len(self), "states": len(self) + 1, "beads": beads}
        for name, array in self.arrays().items():
            kind, shape = ARRAYS[name].kind, ARRAYS[name].shape or ()
            right = tuple(sizes[n] if isinstance(n, str) else n for n in shape)
            fits = array.ndim == len(right) and all(
                n is None or n == m for n, m in zip(right, array.shape, strict=True)
            )
            if not fits or (array.dtype.kind != "U" if kind == "text" else array.dtype != kind):
                raise InvalidInput(
                    f"{name} must be {kind} of shape {right}, got {array.dtype} of shape"
                    f" {array.shape}"
                )

    def __len__(self) -> int:
        """Return T, the number of actions."""
        return len(self.actions)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays that aren't None, by attribute name."""
        return {
            name: np.asarray(getattr(self, name))
            for name in ARRAYS
            if getattr(self, name) is not None
        }

    def attributes(self) -> dict[str, Any]:
        """Return everything but the arrays; every value can be written as JSON."""
        names = ("goal_gauss_code", "seed", "policy", "relabelled", "hold")
        return {
            **{name: getattr(self, name) for name in names},
            "options": {name: int(row) for name, row in self.options.items()},
        }

    def digest(self) -> str:
        """Return the SHA-256 of all arrays and attributes, hexadecimal."""
        hashed = hashlib.sha256(json.dumps(self.attributes(), sort_keys=True).encode())
        for name, array in self.arrays().items():
            whole = (
                "\n".join(array.tolist()).encode()
                if array.dtype.kind == "U"
                else np.ascontiguousarray(array).tobytes()
            )
            kind = "U" if array.dtype.kind == "U" else array.dtype.str
            hashed.update(f"{name} {array.shape} {kind} ".encode() + whole)
        return hashed.hexdigest()


def goals_reached(codes: Sequence[str] | NDArray[np.str_], hold: int = 1) -> list[int]:
    """List the steps at which a new code has been shown for `hold` consecutive states.

    The start's own code doesn't count, and each other code counts once, at its first such step.

    >>> goals_reached(["", "1+,1-", "", "1+,1-", "1-,1+"])
    [1, 4]
    >>> goals_reached(["", "1+,1-", "", "1+,1-", "1+,1-"], hold=2)
    [4]
    """
    first: dict[str, int] = {}
    running = 0
    for step, code in enumerate(codes):
        running = running + 1 if step and code == codes[step - 1] else 1
        if code != codes[0] and running >= hold:
            first.setdefault(str(code), step)
    return sorted(first.values())


def goal_steps(codes: Sequence[str] | NDArray[np.str_], relabel: str, hold: int = 1) -> list[int]:
    """List the steps to cut an episode at: the "last" of `goals_reached`, or "all" of them."""
    if relabel not in RELABEL:
        raise InvalidInput(f"relabel must be {' or '.join(map(repr, RELABEL))}, got {relabel!r}")
    steps = goals_reached(codes, hold)
    return steps if relabel == "all" else steps[-1:]


def codes_in_bounds(
    codes: NDArray[np.str_], points: NDArray[np.float64], tow_limit: float | None
) -> NDArray[np.str_]:
    """Drop the codes, str (T + 1,), from the first state on that exceeds the bound on towing.

    `points` is float64 (T + 1, beads, 3), metres; `tow_limit` that of `TaskConfig`.
    """
    if tow_limit is None:
        return codes
    beyond = TowBound.of_episode(points, tow_limit).exceeded(points)
    return codes[: int(beyond.argmax())] if beyond.any() else codes


def relabelled(
    episode: Episode,
    goal_step: int,
    *,
    hold: int = 1,
    reward: float = SUCCESS_REWARD,
    tow_limit: float | None = None,
) -> Episode:
    """Cut an episode at a state that becomes its goal, reached there for the first time.

    Args:
        episode: the episode to cut; not modified.
        goal_step: the state that becomes the goal, one of `goals_reached`.
        hold: consecutive states that must show the goal code.
        reward: reward for success.
        tow_limit: the task's bound on towing; states that exceed it can't be goals.

    Raises:
        InvalidInput: the goal isn't reached at that state, or is reached earlier.
    """
    codes = codes_in_bounds(episode.gauss_code, episode.points, tow_limit)
    possible = goals_reached(codes, hold)
    if goal_step not in possible:
        raise InvalidInput(
            f"goal_step must be a state that reaches another code first, one of {possible}, got"
            f" {goal_step}"
        )
    outcome = success_at_last(goal_step, reward)
    left = {"steps": goal_step, "states": goal_step + 1}
    cut = {
        name: array[: left[size]]
        for name, array in episode.arrays().items()
        if (size := str((ARRAYS[name].shape or ("",))[0])) in left
    }
    return replace(
        episode,
        **{
            **cut,
            "expert_action": None,  # planned for the original goal
            "goal_points": episode.points[goal_step],
            "goal_gauss_code": str(episode.gauss_code[goal_step]),
            "rewards": outcome.rewards,
            "terminations": outcome.terminated,
            "truncations": outcome.truncated,
            "is_success": np.concatenate([[False], outcome.terminated]),
            "options": {name: row for name, row in episode.options.items() if name != "goal"},
            "relabelled": True,
        },
    )


def relabel_all(
    episodes: Iterable[Episode],
    relabel: str = "last",
    *,
    hold: int = 1,
    reward: float = SUCCESS_REWARD,
    tow_limit: float | None = None,
) -> Iterator[Episode]:
    """Yield every episode cut at each of its `goal_steps`; skip those that show a single code."""
    for episode in episodes:
        codes = codes_in_bounds(episode.gauss_code, episode.points, tow_limit)
        for step in goal_steps(codes, relabel, hold):
            yield relabelled(episode, step, hold=hold, reward=reward, tow_limit=tow_limit)
