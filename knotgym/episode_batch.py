"""Episodes of one task, many at once: what the single and the vector environment share.

Rows are drawn from the state file, laid with noise that keeps their Gauss code, stepped, labelled,
rewarded and shown here; `env.py` only dresses this in Gymnasium's two interfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.datasets.states import States, read_states, shipped, states_file
from knotgym.rendering.observations import picture_config, pixels, state
from knotgym.rendering.picture import draw
from knotgym.reset_noise import start_qpos
from knotgym.reward import Outcome
from knotgym.rope import Array, Rope, RopeConfig
from knotgym.simulation import Simulation
from knotgym.tasks import InvalidSetting, TaskConfig
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode


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
    """

    def __init__(self, config: TaskConfig, count: int = 1, threads: int = 1) -> None:
        self.config = config
        self.count = count
        self.simulation = Simulation(count, Rope(config.rope), threads)
        self._picture = picture_config(config)
        self._starts = _side(config, config.start_nx)
        self._goals = _side(config, config.goal_nx)
        self._goal_images: dict[int, NDArray[np.uint8]] = {}
        self.codes = [GaussCode(())] * count
        self.goals = [GaussCode(())] * count
        self.start_row = np.zeros(count, dtype=np.int64)
        self.goal_row = np.full(count, -1, dtype=np.int64)  # until the first reset
        self.steps = np.zeros(count, dtype=np.int64)
        self.held = np.zeros(count, dtype=np.int64)
        self.failed = np.zeros(count, dtype=bool)
        self.beads = np.full(count, -1, dtype=np.int64)
        self.forces = np.zeros((count, 3))

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
        start, start_states = self._choose(wanted.pop("start", None), self._starts, "start", rng)
        goal, goal_states = self._choose(wanted.pop("goal", None), self._goals, "goal", rng)
        if wanted:
            raise InvalidSetting(
                f"no reset option {', '.join(map(repr, wanted))}; there is start, goal"
            )
        self.start_row[index], self.goal_row[index] = start, goal
        code = GaussCode.parse(str(start_states.gauss_code_chiral[start]))
        self.simulation.lay(
            start_qpos(
                self.simulation.rope,
                start_states.qpos[start],
                start_states.points[start],
                code,
                self.config.reset_noise,
                rng,
            ),
            [index],
        )
        self.codes[index] = code
        self.goals[index] = GaussCode.parse(str(goal_states.gauss_code[goal]))
        self.steps[index] = self.held[index] = 0
        self.failed[index] = False
        self.beads[index], self.forces[index] = -1, 0.0

    def step(self, actions: ArrayLike, ids: NDArray[np.int64]) -> Outcome:
        """Take one action in each episode of `ids`; see `reward` for what it pays.

        A rope whose simulation blew up stays where it was, is truncated, and `failed` says so.
        """
        simulation = self.simulation
        self.beads[ids], self.forces[ids] = simulation.read_actions(actions, ids)
        self.failed[ids] = ~simulation.step(self.beads[ids], self.forces[ids], ids)
        for index, code in zip(ids, label_many(simulation.points[ids]), strict=True):
            self.codes[index] = code
        reached = np.array(
            [self.codes[index].matches(self.goals[index]) for index in ids], dtype=bool
        )
        self.steps[ids] += 1
        self.held[ids] = np.where(reached, self.held[ids] + 1, 0)
        return self.config.reward_rule.outcome(self.held[ids], self.steps[ids], self.failed[ids])

    def picture(self, index: int) -> NDArray[np.uint8]:
        """The rope now, left, and its goal, right: uint8 (size, 2 size, 3)."""
        goal = int(self.goal_row[index])
        if goal not in self._goal_images:
            self._goal_images[goal] = draw(self._goals.points[goal], self._picture)
        seen: NDArray[np.uint8] = pixels(
            self.simulation.points[index][None], self._goal_images[goal], self._picture
        )[0]
        return seen

    def state(self, index: int) -> NDArray[np.float32]:
        """Vertices of the rope now, then of its goal, metres: float32 (6 beads,)."""
        seen: NDArray[np.float32] = state(
            self.simulation.points[index][None], self._goals.points[self.goal_row[index]]
        )[0]
        return seen

    def goal_points(self, index: int) -> Array:
        """The goal's exemplar, float64 (beads, 3), metres; a copy."""
        return self._goals.points[self.goal_row[index]].copy()

    def observation(self, index: int) -> Any:
        """What the agent of episode `index` sees, as `config.observation` says."""
        if self.config.observation == "pixels":
            return self.picture(index)
        if self.config.observation == "state":
            return self.state(index)
        return {"pixels": self.picture(index), "state": self.state(index)}

    def info(self, index: int) -> dict[str, Any]:
        """Labels and counts of episode `index`, the same keys at every step; arrays are copies."""
        code, goal = self.codes[index], self.goals[index]
        return {
            "gauss_code": str(code),
            "gauss_code_chiral": code.chiral,
            "goal_gauss_code": str(goal),
            "crossings": code.nx,
            "is_success": bool(self.held[index] >= self.config.hold and not self.failed[index]),
            "simulation_failed": bool(self.failed[index]),
            "start": int(self.start_row[index]),
            "goal": int(self.goal_row[index]),
            "bead": int(self.beads[index]),
            "force": self.forces[index].copy(),
        }

    def _choose(
        self, row: object, side: States, name: str, rng: np.random.Generator
    ) -> tuple[int, States]:
        nx = self.config.start_nx if name == "start" else self.config.goal_nx
        rows = side.rows(nx, self.config.split)
        # drawn even if unused: the noise that follows doesn't depend on options
        drawn = int(rows[rng.integers(len(rows))])
        if row is None:
            return drawn, side
        if isinstance(row, bool) or not isinstance(row, (int, np.integer)) or row not in rows:
            raise InvalidSetting(
                f"{name} must be a row with nx = {nx} of the {self.config.split} split:"
                f" {_few(rows)}; got {row!r}"
            )
        return int(row), side


def _side(config: TaskConfig, nx: int) -> States:
    """The states that a side of the task draws from.

    They come from the file asked for, or for want of rows there from the one that ships.
    """
    paths = [states_file(config.states), shipped()]
    for path in paths:
        states = _read(path, path.stat().st_mtime_ns if path.exists() else 0)
        # the usual rope's, however finely an action is integrated: a configuration at rest fits
        made_for, ours = states.attributes.get("rope"), RopeConfig().fingerprint
        if made_for != ours:
            raise InvalidSetting(
                f"{path} was made for rope model {made_for}, this version has {ours}"
            )
        if len(states.rows(nx, config.split)):
            return states
    raise InvalidSetting(
        f"no states with nx = {nx} in split {config.split!r} of {paths[0]}; make some:"
        f" knotgym-generate --nx {nx}"
    )


@lru_cache(maxsize=4)
def _read(path: Path, written: int) -> States:
    """States without pictures, read once a process, and again when the file was `written` anew."""
    return read_states(path, images=False)


def _few(rows: Sequence[int] | NDArray[np.int64]) -> str:
    shown = [str(row) for row in rows[:8]]
    return ", ".join(shown) + (", ..." if len(rows) > 8 else "")
