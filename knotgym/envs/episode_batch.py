"""Batches of episodes of one task, shared by the single and the vector environment.

Sampling of starts and goals, reset noise, stepping, Gauss codes, rewards and observations are
implemented here; `environment` wraps them in Gymnasium's two interfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.envs.knot_tasks import fitting_tasks, start_nx
from knotgym.envs.observations import (
    SYMBOLS,
    numbers,
    picture_config,
    pixels,
    stacked,
    state,
    symbols,
)
from knotgym.envs.reward import Outcome
from knotgym.envs.tasks import InvalidSetting, TaskConfig
from knotgym.rendering.picture import draw
from knotgym.rope.action_views import ActionView
from knotgym.rope.engines import simulation
from knotgym.rope.model import Array, Rope, RopeConfig
from knotgym.rope.reset_noise import start_qpos
from knotgym.rope.towing import TowBound, centres, distances_towed
from knotgym.states.schema import CODE_SPLITS
from knotgym.states.state_file import States, read_states, shipped, ships, states_file
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT

OWN, SHIPPED = "own", "shipped"  # origin of states: the user's file, or a set that ships


class EpisodeBatch:
    """A batch of `count` independent episodes.

    Attributes:
        config: settings of the task.
        simulation: the ropes.
        view: turns actions of the view `config.action` into pulls.
        codes: the current Gauss code of each rope, with chirality.
        goals: the goal code of each rope.
        steps: int (count,), actions taken since the reset.
        held: int (count,), consecutive steps for which the goal has been shown.
        failed: bool (count,), whether the simulation blew up in the last step.
        start_qpos: float64 (count, nq), generalized positions that each rope was laid at.
        origins: float64 (count, 3), each rope's centre at reset, metres.
        beads: int (count,), bead pulled in the last step; -1 at reset.
        forces: float64 (count, 3), mean force applied to it in the last step, newtons.
        applied_shares: float64 (count,), as of `Simulation`.
    """

    def __init__(self, config: TaskConfig, count: int = 1, threads: int = 1) -> None:
        if count < 1:
            raise InvalidSetting(f"num_envs must be at least 1, got {count}")
        self.config = config
        self.count = count
        self.simulation = simulation(config.engine, count, Rope(config.rope), threads)
        self.view = ActionView(config.action, self.simulation)
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
        self.start_qpos = np.zeros((count, self.simulation.rope.nq))
        self.origins = np.zeros((count, 3))
        self.beads = np.full(count, -1, dtype=np.int64)
        self.forces = np.zeros((count, 3))
        self.applied_shares = np.ones(count)

    def rows(self, side: str) -> NDArray[np.int64]:
        """Return the rows of the state file from which the "start" or the "goal" is sampled."""
        return self._rows[side]

    def goal_rows(self, start: int) -> NDArray[np.int64]:
        """Return the goal rows for an episode that starts in row `start`.

        Goals that show the start's code already are left out.
        """
        rows = self._rows["goal"]
        if self._start_nx != self.config.goal_nx:
            return rows
        return rows[self._goals.gauss_code[rows] != self._starts.gauss_code[start]]

    def begin(
        self, index: int, rng: np.random.Generator, options: dict[str, Any] | None = None
    ) -> None:
        """Restart episode `index`: sample a start and a goal, and lay the rope.

        Args:
            index: which episode.
            rng: source of every draw.
            options: `start` and `goal` choose rows of the respective state files.

        Raises:
            InvalidSetting: an option is unknown, or a row doesn't belong to the task.
        """
        options = dict(options or {})
        start = self._choose(options.pop("start", None), self.rows("start"), "start", rng)
        goal = self._choose(options.pop("goal", None), self.goal_rows(start), "goal", rng)
        if options:
            raise InvalidSetting(
                f"no reset option {', '.join(map(repr, options))}; there is start, goal"
            )
        self.start_row[index], self.goal_row[index] = start, goal
        code = GaussCode.parse(str(self._starts.gauss_code_chiral[start]))
        self.start_qpos[index] = start_qpos(
            self.simulation.rope,
            self._starts.qpos[start],
            self._starts.points[start],
            code,
            self.config.reset_noise,
            rng,
        )
        self.simulation.lay(self.start_qpos[[index]], [index])
        self.origins[index] = centres(self.simulation.points[[index]])[0]
        # the chain engine closes the gaps of a state without noise, so it is read again
        self.codes[index] = label(self.simulation.points[index])
        self.goals[index] = GaussCode.parse(str(self._goals.gauss_code[goal]))
        self.view.reset(index)
        self.steps[index] = self.held[index] = 0
        self.failed[index] = False
        self.beads[index], self.forces[index], self.applied_shares[index] = -1, 0.0, 1.0

    def act(self, actions: ArrayLike, ids: NDArray[np.int64]) -> Outcome:
        """Carry out one action of the view `config.action` in each episode of `ids`.

        Raises:
            InvalidAction: an action is invalid; no rope has moved.
        """
        if self.config.action == "pull":
            return self.step(actions, ids)
        self.view.begin(actions, ids, self.codes)
        total = Outcome(
            np.zeros(len(ids)), np.zeros(len(ids), dtype=bool), np.zeros(len(ids), dtype=bool)
        )
        rows = np.arange(len(ids))
        while len(rows):
            outcome = self.step(self.view.next_pulls(ids[rows]), ids[rows])
            for whole, part in zip(total, outcome, strict=True):
                whole[rows] = part  # rewards before the last pull are 0
            rows = rows[self.view.busy[ids[rows]]]
        return total

    def step(self, actions: ArrayLike, ids: NDArray[np.int64]) -> Outcome:
        """Make one pull (n, 6) in each episode of `ids`; see `reward` for the outcome.

        If a simulation blows up, its rope doesn't move, its episode is truncated and `failed` set.
        """
        simulation = self.simulation
        self.beads[ids], requested = simulation.read_actions(actions, ids)
        self.failed[ids] = ~simulation.step(self.beads[ids], requested, ids)
        self.applied_shares[ids] = simulation.applied_shares[ids]
        self.forces[ids] = self.applied_shares[ids, None] * requested
        for index, code in zip(ids, label_many(simulation.points[ids]), strict=True):
            self.codes[index] = code
        reached = np.array(
            [self.codes[index].matches(self.goals[index]) for index in ids], dtype=bool
        )
        towed = np.zeros(len(ids), dtype=bool)
        if self.config.tow_limit is not None:
            towed = (
                distances_towed(simulation.points[ids], self.origins[ids]) > self.config.tow_limit
            )
        self.steps[ids] += 1
        self.held[ids] = np.where(reached & ~towed, self.held[ids] + 1, 0)
        outcome = self.config.reward_rule.outcome(
            self.held[ids], self.steps[ids], self.failed[ids], towed
        )
        self.view.pulled(ids, self.codes, outcome.terminated | outcome.truncated)
        return outcome

    def tow_bound(self, index: int) -> TowBound | None:
        """Return the bound on towing of rope `index`; None without a `tow_limit`."""
        if self.config.tow_limit is None:
            return None
        return TowBound(self.origins[index].copy(), self.config.tow_limit)

    def picture(self, index: int) -> NDArray[np.uint8]:
        """Draw the rope on the left and its goal on the right: (views * size, 2 size, 3 or 4)."""
        goal = int(self.goal_row[index])
        if goal not in self._goal_images:
            self._goal_images[goal] = draw(self._goals.points[goal], self._picture)
        seen: NDArray[np.uint8] = pixels(
            self.simulation.points[index][None], self._goal_images[goal], self._picture
        )[0]
        return seen

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Return the picture without depth: uint8 (views * size, 2 size, 3)."""
        return np.ascontiguousarray(self.picture(index)[..., :3])

    def state(self, index: int) -> NDArray[np.float32]:
        """Return the vertices of the rope, then of its goal: float32 (6 beads,), metres."""
        seen: NDArray[np.float32] = state(
            self.simulation.points[index][None], self._goals.points[self.goal_row[index]]
        )[0]
        return seen

    def symbols(self, index: int) -> NDArray[np.int16]:
        """Return the encoded Gauss codes of the rope and of its goal: int16 (2, SYMBOLS)."""
        encoded: NDArray[np.int16] = symbols([self.codes[index]], self.goals[index])[0]
        return encoded

    def goal_points(self, index: int) -> Array:
        """Return a copy of the goal configuration, float64 (beads, 3), metres."""
        return self._goals.points[self.goal_row[index]].copy()

    def observation(self, index: int) -> Any:
        """Return the observation of episode `index`, of the kind `config.observation`."""
        if self.config.observation == "pixels":
            return self._pixels(index)
        if self.config.observation == "state":
            return self.state(index)
        if self.config.observation == "symbolic":
            return self.symbols(index)
        return {"pixels": self._pixels(index), "state": self.state(index)}

    def info(self, index: int) -> dict[str, Any]:
        """Return the `info` of episode `index`, the same keys at every step; arrays are copies.

        With `numeric_infos` every value is a NumPy array. Codes are int16 (SYMBOLS,), see
        `observations.numbers`; chirality is int16 (SYMBOLS // 2,), one sign per crossing; the
        origins of states are True for SHIPPED.
        """
        code, goal = self.codes[index], self.goals[index]
        info = {
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
        if self.config.action == "macro":
            info["macro_pulls"] = int(self.view.pulls[index])
        if not self.config.numeric_infos:
            return info
        numeric = {
            "gauss_code": numbers(code.visits),
            "gauss_code_chiral": numbers(code.signs, SYMBOLS // 2),
            "goal_gauss_code": numbers(goal.visits),
            **{name: origin == SHIPPED for name, origin in self._came_from.items()},
        }
        return {name: np.asarray(numeric.get(name, value)) for name, value in info.items()}

    def _pixels(self, index: int) -> NDArray[np.uint8]:
        seen = self.picture(index)
        return stacked(seen) if self.config.layout == "stacked" else seen

    def _choose(
        self, row: object, rows: NDArray[np.int64], name: str, rng: np.random.Generator
    ) -> int:
        nx = self._start_nx if name == "start" else self.config.goal_nx
        # drawn even if unused, so that the noise that follows doesn't depend on options
        drawn = int(rows[rng.integers(len(rows))])
        if row is None:
            return drawn
        if isinstance(row, np.ndarray) and not row.ndim:  # from numeric infos
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
    """States of a task's starts or goals, their origin (OWN or SHIPPED), and their nx."""

    states: States
    origin: str
    nx: int


def state_origins(config: TaskConfig) -> dict[str, str]:
    """Return the origin of a task's states, OWN or SHIPPED, for `start` and for `goal`.

    Raises:
        InvalidSetting: there are no such states.
    """
    starts, goals = _sides(config)
    return {"start": starts.origin, "goal": goals.origin}


def _sides(config: TaskConfig) -> tuple[_TaskSide, _TaskSide]:
    """Return the states from which a task's starts and goals are sampled.

    They come from the requested file. Only plain loops come from the set that ships, if the file
    has none in either split.

    Raises:
        InvalidSetting: there are none, or starts and goals are of different knot types.
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
            f" end as {', '.join(knots[1])}, and no action changes the knot type;"
            f" {_fit(config, own)}"
        )
    codes = goals.states.gauss_code[goals.states.rows(goals.nx, config.split)[: config.max_goals]]
    if starts.nx == goals.nx and len(set(codes.tolist())) < 2:
        raise InvalidSetting(
            f"a tie to nx = {goals.nx} starts at the simplest diagram of {knots[0][0]} in {path},"
            f" which shows its only goal's code already; {_fit(config, own)}"
        )
    return starts, goals


def _side(config: TaskConfig, path: Path, own: States, nx: int) -> _TaskSide:
    """Return the states with nx crossings from which a side of the task is sampled."""
    states, origin = own, SHIPPED if ships(config.states) else OWN
    if nx == 0 and not (states.nx == 0).any():
        path, origin = shipped(), SHIPPED
        states = _of_our_rope(path)
    if not len(states.rows(nx, config.split)):
        if config.split in CODE_SPLITS and len(states.rows(nx, config.split[:-5])):
            raise InvalidSetting(
                f"split {config.split!r} has no state with nx = {nx} in {path}: there are too few"
                " diagrams to hold one out; use split 'train' or 'test'"
            )
        if set(own.knot.tolist()) not in (set(), {UNKNOT}):
            advice = _fit(config, own)
        elif there := sorted(set(states.split[states.nx == nx].tolist())):
            advice = f"Use split {' or '.join(map(repr, there))}"
        else:
            advice = f"Generate some: knotgym-generate --nx {nx}"
        raise InvalidSetting(
            f"no states with nx = {nx} in split {config.split!r} of {path}, needed by task"
            f" {config.task!r} with nx = {config.nx}; it has {_contents(states)}."
            f" {advice}"
        )
    return _TaskSide(states, origin, nx)


def _fit(config: TaskConfig, own: States) -> str:
    """Return which tasks fit the states of a file, as text for errors."""
    knots = sorted(set(own.knot.tolist()))
    if len(knots) > 1:
        return f"these states are {', '.join(knots)}: keep one type, with knotgym dataset select"
    return f"tasks that fit these states of {knots[0]}: {fitting_tasks(own, config.split)}"


def _of_our_rope(path: Path) -> States:
    """Read the states of a file; raise InvalidSetting if they were made for another rope."""
    states = _read(path, path.stat().st_mtime_ns if path.exists() else 0)
    # states at rest don't depend on the integrator's step, so the default rope is compared
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
    """List the crossings and splits of a file, as in "nx 0 (train, test), 3 (test)"."""
    splits = {
        nx: ", ".join(dict.fromkeys(states.split[states.nx == nx].tolist()))
        for nx in sorted(set(states.nx.tolist()))
    }
    return "nx " + ", ".join(f"{nx} ({of})" for nx, of in splits.items()) if splits else "no rows"


@lru_cache(maxsize=4)
def _read(path: Path, written: int) -> States:
    """Read states without pictures, cached by the time at which the file was `written`."""
    return read_states(path, images=False)


def _few(rows: Sequence[int] | NDArray[np.int64]) -> str:
    shown = [str(row) for row in rows[:8]]
    return ", ".join(shown) + (", ..." if len(rows) > 8 else "")
