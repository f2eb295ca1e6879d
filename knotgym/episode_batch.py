"""Episodes of one task, many at once: what the single and the vector environment share.

Rows are drawn from the state file, laid with noise that keeps their Gauss code, stepped, labelled,
rewarded and shown here; `env.py` only dresses this in Gymnasium's two interfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.datasets.splits import fitting_tasks, start_nx
from knotgym.datasets.states import States, read_states, shipped, ships, states_file
from knotgym.rendering.observations import (
    SYMBOLS,
    numbers,
    picture_config,
    pixels,
    stacked,
    state,
    symbols,
)
from knotgym.rendering.picture import draw
from knotgym.reset_noise import start_qpos
from knotgym.reward import Outcome
from knotgym.rope import Array, Rope, RopeConfig
from knotgym.simulation import Simulation
from knotgym.tasks import CODE_SPLITS, InvalidSetting, TaskConfig
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.towing import TowBound, centres, distances_towed

OWN, SHIPPED = "own", "shipped"  # the state file asked for, or the one that ships


class EpisodeBatch:
    """`count` episodes side by side; episode i is never touched by what the others do.

    Attributes:
        config: the task.
        simulation: the ropes.
        codes: the Gauss code each rope shows now, with chirality.
        goals: the code each rope shall show.
        steps: int (count,), actions taken since the reset.
        held: int (count,), consecutive steps the goal has been shown.
        failed: bool (count,), the simulation blew up in the last step.
        origins: float64 (count, 3), metres, where each rope's centre was at reset.
        beads: int (count,), pulled in the last step; -1 at reset.
        forces: float64 (count, 3), newtons, applied to them in the last step.
        applied_shares: float64 (count,), of the forces asked for, see `Simulation.step`.
    """

    def __init__(self, config: TaskConfig, count: int = 1, threads: int = 1) -> None:
        self.config = config
        self.count = count
        self.simulation = Simulation(count, Rope(config.rope), threads)
        self._picture = picture_config(config)
        starts, goals = _sides(config)
        self._starts, self._goals = starts.states, goals.states
        self._start_nx = starts.nx
        self._rows = {
            "start": starts.states.rows(starts.nx, config.split),
            "goal": goals.states.rows(goals.nx, config.split)[: config.max_goals],
        }
        self._came_from = {"start_states": starts.origin, "goal_states": goals.origin}
        self._goal_images: dict[int, NDArray[np.uint8]] = {}
        self.codes = [GaussCode(())] * count
        self.goals = [GaussCode(())] * count
        self.start_row = np.zeros(count, dtype=np.int64)
        self.goal_row = np.full(count, -1, dtype=np.int64)  # until the first reset
        self.steps = np.zeros(count, dtype=np.int64)
        self.held = np.zeros(count, dtype=np.int64)
        self.failed = np.zeros(count, dtype=bool)
        self.origins = np.zeros((count, 3))
        self.beads = np.full(count, -1, dtype=np.int64)
        self.forces = np.zeros((count, 3))
        self.applied_shares = np.ones(count)

    def rows(self, side: str) -> NDArray[np.int64]:
        """The rows of the state file that the "start" or the "goal" is drawn from."""
        return self._rows[side]

    def goal_rows(self, start: int) -> NDArray[np.int64]:
        """The rows that the goal of an episode from a start row is drawn from: no goal shows the
        start's code.
        """
        rows = self._rows["goal"]
        if self._start_nx != self.config.goal_nx:
            return rows
        return rows[self._goals.gauss_code[rows] != self._starts.gauss_code[start]]

    def begin(
        self, index: int, rng: np.random.Generator, options: dict[str, Any] | None = None
    ) -> None:
        """Start episode `index` over: draw a start and a goal, lay the rope.

        Args:
            index: which episode.
            rng: every draw comes from it.
            options: `start` and `goal` name rows of the state file each comes from; others are
                refused.
        """
        wanted = dict(options or {})
        start = self._choose(wanted.pop("start", None), self.rows("start"), "start", rng)
        goal = self._choose(wanted.pop("goal", None), self.goal_rows(start), "goal", rng)
        if wanted:
            raise InvalidSetting(
                f"no reset option {', '.join(map(repr, wanted))}; there is start, goal"
            )
        self.start_row[index], self.goal_row[index] = start, goal
        code = GaussCode.parse(str(self._starts.gauss_code_chiral[start]))
        self.simulation.lay(
            start_qpos(
                self.simulation.rope,
                self._starts.qpos[start],
                self._starts.points[start],
                code,
                self.config.reset_noise,
                rng,
            ),
            [index],
        )
        self.origins[index] = centres(self.simulation.points[[index]])[0]
        self.codes[index] = code
        self.goals[index] = GaussCode.parse(str(self._goals.gauss_code[goal]))
        self.steps[index] = self.held[index] = 0
        self.failed[index] = False
        self.beads[index], self.forces[index], self.applied_shares[index] = -1, 0.0, 1.0

    def step(self, actions: ArrayLike, ids: NDArray[np.int64]) -> Outcome:
        """Take one action in each episode of `ids`; see `reward` for what it pays.

        A rope whose simulation blew up stays where it was, is truncated, and `failed` says so.
        """
        simulation = self.simulation
        self.beads[ids], asked = simulation.read_actions(actions, ids)
        self.failed[ids] = ~simulation.step(self.beads[ids], asked, ids)
        self.applied_shares[ids] = simulation.applied_shares[ids]
        self.forces[ids] = self.applied_shares[ids, None] * asked
        for index, code in zip(ids, label_many(simulation.points[ids]), strict=True):
            self.codes[index] = code
        reached = np.array(
            [self.codes[index].matches(self.goals[index]) for index in ids], dtype=bool
        )
        towed = np.zeros(len(ids), dtype=bool)
        if self.config.tow_limit is not None:
            far = distances_towed(self.simulation.points[ids], self.origins[ids])
            towed = far > self.config.tow_limit
        self.steps[ids] += 1
        self.held[ids] = np.where(reached & ~towed, self.held[ids] + 1, 0)
        return self.config.reward_rule.outcome(
            self.held[ids], self.steps[ids], self.failed[ids], towed
        )

    def tow_bound(self, index: int) -> TowBound | None:
        """Where the centre of rope `index` may be; None where it may be anywhere."""
        if self.config.tow_limit is None:
            return None
        return TowBound(self.origins[index].copy(), self.config.tow_limit)

    def picture(self, index: int) -> NDArray[np.uint8]:
        """The rope now, left, and its goal, right: uint8 (views * size, 2 size, 3 or 4)."""
        goal = int(self.goal_row[index])
        if goal not in self._goal_images:
            self._goal_images[goal] = draw(self._goals.points[goal], self._picture)
        seen: NDArray[np.uint8] = pixels(
            self.simulation.points[index][None], self._goal_images[goal], self._picture
        )[0]
        return seen

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """The picture without its depth: uint8 (views * size, 2 size, 3)."""
        return np.ascontiguousarray(self.picture(index)[..., :3])

    def state(self, index: int) -> NDArray[np.float32]:
        """Vertices of the rope now, then of its goal, metres: float32 (6 beads,)."""
        seen: NDArray[np.float32] = state(
            self.simulation.points[index][None], self._goals.points[self.goal_row[index]]
        )[0]
        return seen

    def symbols(self, index: int) -> NDArray[np.int16]:
        """Gauss codes of the rope now, and of its goal: int16 (2, SYMBOLS)."""
        told: NDArray[np.int16] = symbols([self.codes[index]], self.goals[index])[0]
        return told

    def goal_points(self, index: int) -> Array:
        """The goal's exemplar, float64 (beads, 3), metres; a copy."""
        return self._goals.points[self.goal_row[index]].copy()

    def observation(self, index: int) -> Any:
        """What the agent of episode `index` sees, as `config.observation` says."""
        if self.config.observation == "pixels":
            return self._pixels(index)
        if self.config.observation == "state":
            return self.state(index)
        if self.config.observation == "symbolic":
            return self.symbols(index)
        return {"pixels": self._pixels(index), "state": self.state(index)}

    def info(self, index: int) -> dict[str, Any]:
        """Labels and counts of episode `index`, the same keys at every step; arrays are copies.

        With `numeric_infos` every value is a NumPy array. Codes are int16 (SYMBOLS,), see
        `observations.numbers`; the chiral one is int16 (SYMBOLS // 2,), a sign a crossing; whose
        states they are is True for SHIPPED.
        """
        code, goal = self.codes[index], self.goals[index]
        told = {
            "gauss_code": str(code),
            "gauss_code_chiral": code.chiral,
            "goal_gauss_code": str(goal),
            "crossings": code.nx,
            "is_success": bool(self.held[index] >= self.config.hold and not self.failed[index]),
            "simulation_failed": bool(self.failed[index]),
            "start": int(self.start_row[index]),
            "goal": int(self.goal_row[index]),
            **self._came_from,
            "bead": int(self.beads[index]),
            "force": self.forces[index].copy(),
            "applied_share": float(self.applied_shares[index]),
        }
        if not self.config.numeric_infos:
            return told
        numeric = {
            "gauss_code": numbers(code.visits),
            "gauss_code_chiral": numbers(code.signs, SYMBOLS // 2),
            "goal_gauss_code": numbers(goal.visits),
            **{name: origin == SHIPPED for name, origin in self._came_from.items()},
        }
        return {name: np.asarray(numeric.get(name, value)) for name, value in told.items()}

    def _pixels(self, index: int) -> NDArray[np.uint8]:
        seen = self.picture(index)
        return stacked(seen) if self.config.layout == "stacked" else seen

    def _choose(
        self, row: object, rows: NDArray[np.int64], name: str, rng: np.random.Generator
    ) -> int:
        nx = self._start_nx if name == "start" else self.config.goal_nx
        # drawn even if unused: the noise that follows doesn't depend on options
        drawn = int(rows[rng.integers(len(rows))])
        if row is None:
            return drawn
        if isinstance(row, np.ndarray) and not row.ndim:  # as numeric infos say it
            row = row.item()
        if isinstance(row, bool) or not isinstance(row, (int, np.integer)) or row not in rows:
            few = self.config.max_goals if name == "goal" else None
            first = "" if few is None else f", of the first {few}"
            raise InvalidSetting(
                f"{name} must be a row with nx = {nx} of the {self.config.split} split{first}:"
                f" {_few(rows)}; got {row!r}"
            )
        return int(row)


class _TaskSide(NamedTuple):
    """What a side of a task draws from: states, whose they are (OWN or SHIPPED), and their nx."""

    states: States
    origin: str
    nx: int


def state_origins(config: TaskConfig) -> dict[str, str]:
    """Where the states of a task come from: OWN or SHIPPED for `start` and for `goal`.

    Raises:
        InvalidSetting: they cannot be had.
    """
    starts, goals = _sides(config)
    return {"start": starts.origin, "goal": goals.origin}


def _sides(config: TaskConfig) -> tuple[_TaskSide, _TaskSide]:
    """The states that a task's starts, and those that its goals, are drawn from.

    They come from the file asked for; plain loops, and they alone, from the set that ships where
    that file has none of either split.

    Raises:
        InvalidSetting: there are none, or no rope can be pulled from a start to a goal.
    """
    path = states_file(config.states)
    own = _of_our_rope(path)
    starts, goals = (_side(config, path, own, nx) for nx in (start_nx(config, own), config.goal_nx))
    knots = [
        sorted(set(side.states.knot[side.states.rows(side.nx, config.split)].tolist()))
        for side in (starts, goals)
    ]
    if len({*knots[0], *knots[1]}) > 1:
        raise InvalidSetting(
            f"task {config.task!r} with nx = {config.nx} would start as {', '.join(knots[0])} and"
            f" end as {', '.join(knots[1])}, and no pull changes the knot type; {_fit(config, own)}"
        )
    codes = goals.states.gauss_code[goals.states.rows(goals.nx, config.split)[: config.max_goals]]
    if starts.nx == goals.nx and len(set(codes.tolist())) < 2:
        raise InvalidSetting(
            f"a tie to nx = {goals.nx} starts at the least diagram of {knots[0][0]} in {path},"
            f" which shows its only goal's code already; {_fit(config, own)}"
        )
    return starts, goals


def _side(config: TaskConfig, path: Path, own: States, nx: int) -> _TaskSide:
    """The states with nx crossings that a side of the task draws from."""
    states, origin = own, SHIPPED if ships(config.states) else OWN
    if nx == 0 and not (states.nx == 0).any():
        path, origin = shipped(), SHIPPED
        states = _of_our_rope(path)
    if not len(states.rows(nx, config.split)):
        if config.split in CODE_SPLITS and len(states.rows(nx, config.split[:-5])):
            raise InvalidSetting(
                f"split {config.split!r} has no state with nx = {nx} of {path}: too few diagrams"
                " are shown to hold one out; give split 'train' or 'test'"
            )
        if set(own.knot.tolist()) not in (set(), {UNKNOT}):
            advice = _fit(config, own)
        elif there := sorted(set(states.split[states.nx == nx].tolist())):
            advice = f"Give split {' or '.join(map(repr, there))}"
        else:
            advice = f"Make some: knotgym-generate --nx {nx}"
        raise InvalidSetting(
            f"no states with nx = {nx} in split {config.split!r} of {path}, asked for by task"
            f" {config.task!r} with nx = {config.nx}; it has {_contents(states)}."
            f" {advice}"
        )
    return _TaskSide(states, origin, nx)


def _fit(config: TaskConfig, own: States) -> str:
    """Which tasks go with the states of a file."""
    knots = sorted(set(own.knot.tolist()))
    if len(knots) > 1:
        return f"these states are {', '.join(knots)}: keep one type, with knotgym dataset select"
    return f"tasks that fit these states of {knots[0]}: {fitting_tasks(own, config.split)}"


def _of_our_rope(path: Path) -> States:
    """The states of a file, refused if made for another rope."""
    states = _read(path, path.stat().st_mtime_ns if path.exists() else 0)
    # the usual rope's, however finely an action is integrated: a configuration at rest fits
    made_for, ours = states.attributes.get("rope"), RopeConfig().fingerprint
    if made_for != ours:
        raise InvalidSetting(f"{path} was made for rope model {made_for}, this version has {ours}")
    beads = RopeConfig().beads
    if states.points.shape[1] != beads:
        raise InvalidSetting(
            f"{path} has ropes of {states.points.shape[1]} vertices, its rope model {beads}"
        )
    return states


def _contents(states: States) -> str:
    """Which crossings and splits a file has, as "nx 0 (train, test), 3 (test)"."""
    splits = {
        nx: ", ".join(dict.fromkeys(states.split[states.nx == nx].tolist()))
        for nx in sorted(set(states.nx.tolist()))
    }
    return "nx " + ", ".join(f"{nx} ({of})" for nx, of in splits.items()) if splits else "no rows"


@lru_cache(maxsize=4)
def _read(path: Path, written: int) -> States:
    """States without pictures, read once a process, and again when the file was `written` anew."""
    return read_states(path, images=False)


def _few(rows: Sequence[int] | NDArray[np.int64]) -> str:
    shown = [str(row) for row in rows[:8]]
    return ", ".join(shown) + (", ..." if len(rows) > 8 else "")
