"""Batches of episodes of one task, shared by the single and the vector environment.

Sampling of starts and goals, reset noise, stepping, Gauss codes, rewards and observations are
implemented here; `environment` wraps them in Gymnasium's two interfaces.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidInput
from knotgym.envs.marked import join, mark
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
from knotgym.envs.task_states import SHIPPED, task_sides
from knotgym.envs.tasks import TaskConfig
from knotgym.rendering.picture import draw
from knotgym.rope.action_views import ActionView
from knotgym.rope.engines import simulation
from knotgym.rope.model import Array, Rope
from knotgym.rope.reset_noise import start_qpos
from knotgym.rope.towing import TowBound, centres, distances_towed
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode


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
            raise InvalidInput(f"num_envs must be at least 1, got {count}")
        self.config = config
        self.count = count
        self.simulation = simulation(config.engine, count, Rope(config.rope), threads)
        self.view = ActionView(config.action, self.simulation)
        self._picture = picture_config(config)
        starts, goals = task_sides(config)
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

    def side_codes(self, side: str) -> list[GaussCode]:
        """Return the distinct codes of the "start" or "goal" states, without chirality, sorted."""
        states = self._starts if side == "start" else self._goals
        codes = {*states.gauss_code[self._rows[side]].tolist()}
        return [_parsed(str(code)) for code in sorted(codes)]

    def begin(
        self, index: int, rng: np.random.Generator, options: dict[str, Any] | None = None
    ) -> None:
        """Restart episode `index`; see `begin_many`."""
        self.begin_many(np.array([index]), [rng], options)

    def begin_many(
        self,
        ids: NDArray[np.int64],
        rngs: Sequence[np.random.Generator],
        options: dict[str, Any] | None = None,
    ) -> None:
        """Restart the episodes `ids`: sample starts and goals, and lay the ropes.

        Args:
            ids: which episodes.
            rngs: one for each of them, the source of its draws.
            options: `start` and `goal` choose rows of the respective state files.

        Raises:
            InvalidInput: an option is unknown, or a row doesn't belong to the task.
        """
        if not len(ids):
            return
        given = dict(options or {})
        own_start, own_goal = given.pop("start", None), given.pop("goal", None)
        if given:
            raise InvalidInput(f"no reset option {', '.join(map(repr, given))}; use start or goal")
        rows = []
        for rng in rngs:
            start = self._choose(own_start, self.rows("start"), "start", rng)
            rows.append((start, self._choose(own_goal, self.goal_rows(start), "goal", rng)))
        starts, goals = np.array(rows).T
        self.start_row[ids], self.goal_row[ids] = starts, goals
        self.start_qpos[ids] = start_qpos(
            self.simulation.rope,
            self._starts.qpos[starts],
            self._starts.points[starts],
            [_parsed(str(text)) for text in self._starts.gauss_code_chiral[starts]],
            self.config.reset_noise,
            rngs,
        )
        self.simulation.lay(self.start_qpos[ids], ids)
        self.origins[ids] = centres(self.simulation.points[ids])
        # the chain engine closes the gaps of a state without noise, so it is read again
        codes = label_many(self.simulation.points[ids])
        for index, code, goal in zip(ids.tolist(), codes, goals.tolist(), strict=True):
            self.codes[index] = code
            self.goals[index] = _parsed(str(self._goals.gauss_code[goal]))
        self.view.reset(ids)
        self.steps[ids] = self.held[ids] = 0
        self.failed[ids] = False
        self.beads[ids], self.forces[ids], self.applied_shares[ids] = -1, 0.0, 1.0

    def act(self, actions: ArrayLike, ids: NDArray[np.int64]) -> Outcome:
        """Carry out one action of the view `config.action` in each episode of `ids`.

        Raises:
            InvalidInput: an action is invalid; no rope has moved.
        """
        if self.config.action == "pull":
            return self.step(actions, ids)
        self.view.begin(actions, ids)
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
        reached = np.zeros(len(ids), dtype=bool)
        labelled = label_many(simulation.points[ids])
        for row, (index, code) in enumerate(zip(ids.tolist(), labelled, strict=True)):
            self.codes[index] = code
            reached[row] = code.visits == self.goals[index].visits
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
        self.view.pulled(ids, outcome.terminated | outcome.truncated)
        return outcome

    def tow_bound(self, index: int) -> TowBound | None:
        """Return the bound on towing of rope `index`; None without a `tow_limit`."""
        if self.config.tow_limit is None:
            return None
        return TowBound(self.origins[index].copy(), self.config.tow_limit)

    def picture(self, index: int) -> NDArray[np.uint8]:
        """Draw the rope on the left and its goal on the right: (views * size, 2 size, 3 or 4)."""
        drawn: NDArray[np.uint8] = self._pictures(np.array([index]))[0]
        return drawn

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Return the picture without depth: uint8 (views * size, 2 size, 3)."""
        return np.ascontiguousarray(self.picture(index)[..., :3])

    def state(self, index: int) -> NDArray[np.float32]:
        """Return the vertices of the rope, then of its goal: float32 (6 beads,), metres."""
        seen: NDArray[np.float32] = self._states(np.array([index]))[0]
        return seen

    def symbols(self, index: int) -> NDArray[np.int16]:
        """Return the encoded Gauss codes of the rope and of its goal: int16 (2, SYMBOLS)."""
        encoded: NDArray[np.int16] = symbols([self.codes[index]], [self.goals[index]])[0]
        return encoded

    def goal_points(self, index: int) -> Array:
        """Return a copy of the goal configuration, float64 (beads, 3), metres."""
        return self._goals.points[self.goal_row[index]].copy()

    def observation(self, index: int) -> Any:
        """Return the observation of episode `index`, of the kind `config.observation`."""
        seen = self.observations(np.array([index]))
        if isinstance(seen, dict):
            return {name: array[0] for name, array in seen.items()}
        return seen[0]

    def observations(self, ids: NDArray[np.int64]) -> Any:
        """Return the observations of the episodes `ids`: an array (n, ...), or a dict of such."""
        if self.config.observation == "symbolic":
            every = ids.tolist()
            return symbols([self.codes[i] for i in every], [self.goals[i] for i in every])
        if self.config.observation == "marked":
            goals = [self.goals[index] for index in ids.tolist()]
            return join(mark(self.simulation.points[ids], goals))
        seen: dict[str, NDArray[Any]] = {}
        if self.config.observation != "state":
            pictures = self._pictures(ids)
            seen["pixels"] = stacked(pictures) if self.config.layout == "stacked" else pictures
        if self.config.observation != "pixels":
            seen["state"] = self._states(ids)
        return seen if self.config.observation == "both" else seen[self.config.observation]

    def info(self, index: int) -> dict[str, Any]:
        """Return the `info` of episode `index`, the same keys at every step; arrays are copies.

        With `numeric_infos` every value is a NumPy array. Codes are int16 (SYMBOLS,), see
        `observations.numbers`; chirality is int16 (SYMBOLS // 2,), one sign per crossing; the
        origins of states are True for SHIPPED.
        """
        return self.info_rows(np.array([index]))[0]

    def info_rows(self, ids: NDArray[np.int64]) -> list[dict[str, Any]]:
        """Return the `info` of each of the episodes `ids`."""
        columns = self.infos(ids)
        if self.config.numeric_infos:
            values = [list(map(np.asarray, column)) for column in columns.values()]
        else:
            values = [
                list(column) if column.ndim > 1 else column.tolist() for column in columns.values()
            ]
        return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]

    def infos(self, ids: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return the `info` of the episodes `ids` as arrays (n, ...), which are copies."""
        every = ids.tolist()
        codes, goals = [self.codes[i] for i in every], [self.goals[i] for i in every]
        if self.config.numeric_infos:
            shown = [
                np.array([numbers(code.visits) for code in codes]),
                np.array([numbers(code.signs, SYMBOLS // 2) for code in codes]),
                np.array([numbers(goal.visits) for goal in goals]),
            ]
            origins = [np.full(len(ids), one == SHIPPED) for one in self._came_from.values()]
        else:
            shown = [
                np.array([_text(code) for code in codes], dtype=object),
                np.array([_text(code, chiral=True) for code in codes], dtype=object),
                np.array([_text(goal) for goal in goals], dtype=object),
            ]
            origins = [np.full(len(ids), one, dtype=object) for one in self._came_from.values()]
        failed = self.failed[ids]
        infos = {
            **dict(zip(("gauss_code", "gauss_code_chiral", "goal_gauss_code"), shown, strict=True)),
            "crossings": np.array([code.nx for code in codes]),
            "is_success": self.config.reward_rule.reached(self.held[ids], failed),
            "simulation_failed": failed,
            "start": self.start_row[ids],
            "goal": self.goal_row[ids],
            **dict(zip(self._came_from, origins, strict=True)),
            "bead": self.beads[ids],
            "force": self.forces[ids],
            "applied_share": self.applied_shares[ids],
        }
        if self.config.action == "macro":
            infos["macro_pulls"] = self.view.pulls[ids]
        return infos

    def _states(self, ids: NDArray[np.int64]) -> NDArray[np.float32]:
        return state(self.simulation.points[ids], self._goals.points[self.goal_row[ids]])

    def _pictures(self, ids: NDArray[np.int64]) -> NDArray[np.uint8]:
        goals = self.goal_row[ids].tolist()
        for goal in set(goals) - self._goal_images.keys():
            self._goal_images[goal] = draw(self._goals.points[goal], self._picture)
        return pixels(
            self.simulation.points[ids], [self._goal_images[goal] for goal in goals], self._picture
        )

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
            raise InvalidInput(
                f"{name} must be a row with nx = {nx} of the {self.config.split} split{first}:"
                f" {_few(rows)}; got {row!r}"
            )
        return int(row)


@lru_cache(maxsize=1024)
def _parsed(text: str) -> GaussCode:
    return GaussCode.parse(text)


@lru_cache(maxsize=2**14)
def _text(code: GaussCode, chiral: bool = False) -> str:
    return code.chiral if chiral else str(code)


def _few(rows: Sequence[int] | NDArray[np.int64]) -> str:
    shown = [str(row) for row in rows[:8]]
    return ", ".join(shown) + (", ..." if len(rows) > 8 else "")
