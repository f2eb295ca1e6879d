"""The episode engine: many episodes of one task, one rope each, as arrays.

Starts and goals, reset noise, stepping, Gauss codes, rewards and observations are implemented here.
`environment` wraps a batch in Gymnasium's two interfaces, `control.sampler` plays policies in one.
What happens in an episode depends on its seed and its pulls, not on the episodes beside it.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, Ids, InvalidInput, padded
from knotgym.envs.observations import OBSERVATIONS, Frames, Observer, parsed
from knotgym.envs.reward import Outcome, Situation
from knotgym.envs.task_states import TaskSide, task_sides
from knotgym.envs.tasks import TaskConfig
from knotgym.rope import ActionView, Rope, TowBound, simulation
from knotgym.topology import CodeArrays, GaussCode

Seed = int | np.random.Generator
Options = Mapping[str, Any] | None
Meanwhile = Callable[[], None] | None


class EpisodeBatch:
    """A batch of `count` independent episodes; the arrays have one row per rope.

    Attributes:
        task: settings of the task.
        space: of the observation of one episode.
        simulation: the ropes.
        starts, goals: the states that starts and goals are sampled from.
        rows: "start" or "goal" -> int64 (n,), the rows of them that are sampled.
        number: int64 (count,), number of the episode in its run; -1 for none.
        seed: int64 (count,), the seed of each episode; -1 if it began from a generator.
        start_row, goal_row: int64 (count,), rows of `starts` and `goals`; -1 until the first reset.
        start_qpos: float64 (count, nq), generalized positions that each rope was laid at.
        hold: int64 (count,), consecutive steps for which the goal must be shown.
        steps: int64 (count,), pulls since the reset.
        held: int64 (count,), consecutive steps for which the goal has been shown.
        visits, signs, crossings: the Gauss codes now, see `topology.CodeArrays`.
        wanted: int16 (count, 2 width), the visits of the goals' codes.
        shown: bool (count,), whether a rope shows its goal.
        failed: bool (count,), whether the simulation blew up in the last step.
        towed: bool (count,), whether a rope's centre is beyond `tow_limit`.
        centre: float64 (count, 3), of each rope at reset, metres.
        beads: int64 (count,), bead pulled in the last step; -1 at reset.
        forces: float64 (count, 3), mean force applied to it in the last step, newtons.
        applied_shares: float64 (count,), as of `Simulation`.
    """

    def __init__(self, task: TaskConfig, count: int = 1, threads: int = 1) -> None:
        if count < 1:
            raise InvalidInput(f"num_envs must be at least 1, got {count}")
        self.task, self.count = task, count
        self.simulation = simulation(task.engine, count, Rope(task.rope_config), threads)
        self.view = ActionView(task.action, self.simulation)
        self._observer = Observer(task)
        self.space = OBSERVATIONS[task.observation].space_of(task)
        self._sides = task_sides(task)
        self.starts, self.goals = (side.states for side in self._sides[0])
        self.rows = {
            name: np.unique(np.concatenate([side.rows for side in same]))
            for name, same in zip(("start", "goal"), zip(*self._sides, strict=True), strict=True)
        }
        self._clearances: dict[int, float] = {}
        # goal row -> its picture, and how its episodes look
        self._goal_images: dict[int, tuple[NDArray[np.uint8], Any]] = {}
        self.number, self.seed = np.full((2, count), -1, dtype=np.int64)
        self.start_row, self.goal_row = np.full((2, count), -1, dtype=np.int64)
        self.start_qpos = np.zeros((count, self.simulation.rope.nq))
        self.hold = np.full(count, task.hold, dtype=np.int64)
        self.steps, self.held = np.zeros((2, count), dtype=np.int64)
        self.visits, self.signs, self.crossings = CodeArrays.read(self.simulation.points)
        self.wanted = np.zeros_like(self.visits)
        self.shown, self.failed, self.towed = np.zeros((3, count), dtype=bool)
        self.centre, self.forces = np.zeros((2, count, 3))
        self.beads = np.full(count, -1, dtype=np.int64)
        self.applied_shares = np.ones(count)
        self._fresh: dict[str, NDArray[Any]] = {}  # a row of each array, before any episode

    # beginning

    def goal_rows(self, start: int) -> Ids:
        """Return the goal rows for an episode that starts in row `start`.

        Goals that show the start's code already are left out.
        """
        fitting = [goals for starts, goals in self._sides if start in starts.rows]
        return np.unique(np.concatenate([self._goals_from(start, goals) for goals in fitting]))

    def _goals_from(self, start: int, goals: TaskSide) -> Ids:
        """Return the goals of a single task for an episode that starts in row `start`."""
        if self.starts.nx[start] != goals.nx:
            return goals.rows
        return goals.rows[self.goals.gauss_code[goals.rows] != self.starts.gauss_code[start]]

    def side_codes(self, side: str) -> list[GaussCode]:
        """Return the distinct codes of the "start" or "goal" states, without chirality, sorted."""
        states = self.starts if side == "start" else self.goals
        codes = {*states.gauss_code[self.rows[side]].tolist()}
        return [parsed(str(code)) for code in sorted(codes)]

    def begin(self, ids: Ids, seeds: Sequence[Seed], options: Options = None) -> None:
        """Begin episodes as `env.reset(seed=...)` does: draw starts and goals, lay the ropes.

        Args:
            ids: which ropes, in increasing order.
            seeds, options: as of `drawn`, a seed for each of them.
        """
        if len(ids):
            self.restore(ids, self.drawn(seeds, options))

    def drawn(self, seeds: Sequence[Seed], options: Options = None) -> dict[str, NDArray[Any]]:
        """Draw starts and goals; return the columns of `restore` without laying a rope.

        Many at once take a fraction of the time of as many one by one, and start the same.

        Args:
            seeds: the draws of each episode come from `np.random.default_rng(seed)`, or from a
                generator that is given.
            options: `start` and `goal` choose rows of the state files.

        Raises:
            InvalidInput: an option is unknown, or a row doesn't belong to the task.
        """
        given = dict(options or {})
        own_start, own_goal = given.pop("start", None), given.pop("goal", None)
        if given:
            raise InvalidInput(f"no reset option {', '.join(map(repr, given))}; use start or goal")
        rngs = [np.random.default_rng(seed) for seed in seeds]
        rows = np.empty((2, len(rngs)), dtype=np.int64)
        sides = self._sides
        if len(sides) > 1 and options:  # those that the given rows are of; if none, they're refused
            sides = [
                pair
                for pair in sides
                if own_start in (None, *pair[0].rows) and own_goal in (None, *pair[1].rows)
            ] or sides
        for row, rng in enumerate(rngs):
            # drawn among all, so that what follows doesn't depend on options
            drawn = int(rng.integers(len(self._sides))) if len(self._sides) > 1 else 0
            starts, goals = sides[drawn % len(sides)]
            start = self._choose(own_start, starts.rows, "start", rng)
            goal = self._choose(own_goal, self._goals_from(start, goals), "goal", rng)
            rows[:, row] = start, goal
        starts = rows[0]
        for row in set(starts.tolist()) - self._clearances.keys():
            points = np.require(self.starts.points[row], np.float64, ["C", "W"])
            self._clearances[row] = self.simulation.rope.least_clearance(points)
        qpos = self.simulation.rope.start_qpos(
            self.starts.qpos[starts],
            self.starts.points[starts],
            [parsed(str(text)) for text in self.starts.gauss_code_chiral[starts]],
            self.task.reset_noise,
            rngs,
            [self._clearances[row] for row in starts.tolist()],
        )
        # a seed of the caller's own may be larger than any that is stored
        known = [
            -1 if isinstance(seed, np.random.Generator) or seed >= 2**63 else seed for seed in seeds
        ]
        columns = {"seed": np.array(known, dtype=np.int64), "start": starts, "goal": rows[1]}
        return {**columns, "start_qpos": qpos}

    def restore(self, ids: Ids, rows: Mapping[str, ArrayLike]) -> None:
        """Begin episodes where others began.

        Args:
            ids: which ropes, in increasing order.
            rows: the columns `seed`, `start`, `goal` and `start_qpos` of `datasets.episodes`, and
                `goal_visits` and `hold` where an episode has a goal of its own.
        """
        self._fresh = self._fresh or {name: array[0].copy() for name, array in self._per_rope()}
        for name, column in self._per_rope():
            # codes, which may be wider now, are read below
            column[ids] = self._fresh[name] if column[0].shape == self._fresh[name].shape else 0
        self.seed[ids], self.start_row[ids] = rows["seed"], rows["start"]
        self.goal_row[ids], self.start_qpos[ids] = rows["goal"], rows["start_qpos"]
        hold = np.asarray(rows.get("hold", 0))
        self.hold[ids] = np.where(hold, hold, self.task.hold)
        self.simulation.set_qpos(self.start_qpos[ids], ids)
        self.centre[ids] = TowBound.centres(self.simulation.points[ids])
        if "goal_visits" in rows:
            goals = CodeArrays(np.asarray(rows["goal_visits"], dtype=np.int16)).objects()
        else:
            goals = [parsed(str(code)) for code in self.goals.gauss_code[self.goal_row[ids]]]
        self._seek(ids, goals)
        self.view.reset(ids)

    def _seek(self, ids: Ids, goals: Sequence[GaussCode]) -> None:
        """Replace the goals' codes of ropes; `goal_row` and the goals' pictures stay."""
        visits = CodeArrays.of(goals, self.wanted.shape[1] // 2).visits
        self._widen(visits.shape[1])
        self.wanted[ids] = visits
        self._read(ids)

    def copy_from(self, other: "EpisodeBatch", rows: Ids, ids: Ids) -> None:
        """Go on with episodes of another batch of the same task, in ropes `ids` of this one."""
        self.simulation.restore(other.simulation.states(rows), ids)
        width = max(self.visits.shape[1], other.visits.shape[1])
        self._widen(width)
        other._widen(width)
        for name, column in self._per_rope():
            column[ids] = getattr(other, name)[rows]
        self.view.reset(ids)

    def _per_rope(self) -> list[tuple[str, NDArray[Any]]]:
        """Return the arrays that have a row per rope, by their names; a subclass may add some.

        The episodes' numbers stay as they are when episodes begin or are copied.
        """
        arrays = [(name, of) for name, of in vars(self).items() if isinstance(of, np.ndarray)]
        return [(name, array) for name, array in arrays if name != "number"]

    # acting

    def pull(
        self, ids: Ids, beads: Ids, forces: NDArray[np.floating], meanwhile: Meanwhile = None
    ) -> Outcome:
        """Pull a bead of each rope; if a simulation blows up, its rope stays as it was.

        Args:
            ids: which ropes, in increasing order.
            beads: int64 (n,), pulled at their centres.
            forces: (n, 3), in units of the largest force, each component in [-1, 1].
            meanwhile: as of `Simulation.step`; it may begin episodes of other ropes.

        Returns:
            Rewards, and which episodes end; see `reward`.
        """
        newtons, before = forces.astype(np.float64) * self.simulation.max_force, self.visits[ids]
        failed = ~self.simulation.step(beads, newtons, ids, meanwhile)
        shares = self.simulation.applied_shares[ids]
        self.failed[ids], self.beads[ids], self.applied_shares[ids] = failed, beads, shares
        self.forces[ids] = shares[:, None] * newtons
        self._read(ids)
        bound = self.tow_bound(ids)
        towed = bound.exceeded(self.simulation.points[ids]) if bound else np.False_
        self.towed[ids] = towed
        self.steps[ids] += 1
        self.held[ids] = np.where(self.shown[ids] & ~towed, self.held[ids] + 1, 0)
        codes, counts = (self.visits[ids], self.wanted[ids]), (self.held[ids], self.hold[ids])
        seen = Situation(*codes, *counts, self.steps[ids], failed, towed, before)
        return seen.outcome(self.task)

    def successes(self, ids: Ids) -> NDArray[np.bool_]:
        """Return which of the episodes `ids` are successes at their last step: bool (n,)."""
        return Situation.reached(self.held[ids], self.hold[ids], self.failed[ids])

    def act(self, actions: ArrayLike, ids: Ids, meanwhile: Meanwhile = None) -> Outcome:
        """Take one action of the task's view in each episode of `ids`, with all of its pulls.

        The other arguments are those of `pull`.

        Raises:
            InvalidInput: an action is invalid; no rope has moved.
        """
        if self.task.is_canonical:
            actions = self.world_actions(self.view, actions, ids)
        self.view.begin(actions, ids)
        total = Outcome(np.zeros(len(ids)), *np.zeros((2, len(ids)), dtype=bool))
        rows = np.arange(len(ids))
        while len(rows):
            last = self.pull(ids[rows], *self.view.pulls_of(ids[rows]), meanwhile)
            meanwhile = None
            self.view.pulled(ids[rows], last.terminated | last.truncated)
            total.rewards[rows] += last.rewards
            total.terminated[rows], total.truncated[rows] = last.terminated, last.truncated
            rows = rows[self.view.busy[ids[rows]]]
        return total

    def world_actions(self, view: ActionView, actions: ArrayLike, ids: Ids) -> NDArray[Any]:
        """Map actions of a view from the canonical frames of ropes into the world.

        Raises:
            InvalidInput: an action is invalid.
        """
        from knotgym.envs.marked import Marked

        points = self.simulation.points[ids]
        checked, frames = view.check(actions, ids), Marked.of(points, self.goals_of(ids)).frames
        to_world = view.kind.to_world
        assert to_world is not None  # `TaskConfig` refuses such a frame
        return to_world(frames, checked, points, self.simulation.rope.config.reach)

    def tow_bound(self, index: int | Ids, share: float = 1.0) -> TowBound | None:
        """Return where ropes must stay, at a share of the `tow_limit`; None without one."""
        limit = self.task.tow_limit
        return None if limit is None else TowBound(self.centre[index].copy(), share * limit)

    # seeing

    def codes_of(self, ids: Ids) -> list[GaussCode]:
        """Return the Gauss codes of ropes, with chirality."""
        return CodeArrays(self.visits[ids], self.signs[ids]).objects()

    def goals_of(self, ids: Ids) -> list[GaussCode]:
        """Return the goals' codes, without chirality."""
        return CodeArrays(self.wanted[ids]).objects()

    def goal_points(self, index: int) -> Array:
        """Return a copy of the goal configuration, float64 (beads, 3), metres."""
        return self.goals.points[self.goal_row[index]].copy()

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Draw the rope on the left and its goal on the right: uint8 (views * size, 2 size, 3)."""
        rope, goal = self._pictures(np.array([index]), np.arange(2))
        return np.concatenate([rope, goal], axis=1)[..., :3].copy()

    def observation(self, index: int) -> Any:
        """Return the observation of episode `index`, of the kind `task.observation`."""
        return Observer.map_parts(self.observations(np.array([index])), itemgetter(0))

    def observations(self, ids: Ids) -> Any:
        """Return the observations of the episodes `ids`: an array (n, ...), or a dict of such."""
        kind, ropes = OBSERVATIONS[self.task.observation], np.arange(len(ids))
        return kind.observe(self.task, self._frames(ids), ropes, ropes + len(ids))

    def halves(self, ids: Ids) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the halves of observations, those of the ropes and those of their goals.

        A half of one row, as of codes, is returned without its first axis.
        """
        kind = OBSERVATIONS[self.task.observation]
        both = kind.halves(self._frames(ids), np.arange(2 * len(ids)))
        rope, goal = np.split(both[:, 0] if both.shape[1] == 1 else both, 2)
        return rope, goal

    def _frames(self, ids: Ids) -> Frames:
        """Return the ropes `ids` as frames, and after them their goals."""
        return Frames(
            self.simulation.points[ids],
            self.visits[ids],
            self.goals.points[self.goal_row[ids]],
            self.wanted[ids],
            partial(self._pictures, ids),
            self.simulation.threads,
        )

    def info_rows(self, ids: Ids) -> list[dict[str, Any]]:
        """Return the `info` of some episodes, the same keys at every step; arrays are copies.

        With `numeric_infos` every value is a NumPy array. Codes are int16 (SYMBOLS,), see
        `Observer.symbols`; chirality is int16 (SYMBOLS // 2,), one sign per crossing.
        """
        columns = self.infos(ids)
        if self.task.numeric_infos:
            values = [list(map(np.asarray, column)) for column in columns.values()]
        else:
            values = [
                list(column) if column.ndim > 1 else column.tolist() for column in columns.values()
            ]
        return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]

    def infos(self, ids: Ids) -> dict[str, NDArray[Any]]:
        """Return the `info` of the episodes `ids` as arrays (n, ...), which are copies."""
        shown: tuple[Any, Any, Any]
        if self.task.numeric_infos:
            cut = self._observer.symbols
            signs = cut(self.signs[ids], Observer.SYMBOLS // 2)
            shown = cut(self.visits[ids]), signs, cut(self.wanted[ids])
        else:
            seen = self.visits[ids]
            chiral, goals = CodeArrays(seen, self.signs[ids]), CodeArrays(self.wanted[ids])
            shown = CodeArrays(seen).texts(), chiral.texts(), goals.texts()
        infos = {
            "gauss_code": shown[0],
            "gauss_code_chiral": shown[1],
            "goal_gauss_code": shown[2],
            "crossings": self.crossings[ids],
            "is_success": self.successes(ids),
            "simulation_failed": self.failed[ids],
            "start": self.start_row[ids],
            "goal": self.goal_row[ids],
            "bead": self.beads[ids],
            "force": self.forces[ids],
            "applied_share": self.applied_shares[ids],
        }
        if self.view.kind.is_macro:
            infos["macro_pulls"] = self.view.pulls[ids]
        return infos

    def _read(self, ids: Ids) -> None:
        """Read the codes of ropes after they moved, or of their goals."""
        points, threads = self.simulation.points, self.simulation.threads
        codes = CodeArrays.read(points, self.visits.shape[1] // 2, threads, ids)
        self._widen(codes.visits.shape[1])
        self.visits[ids], self.signs[ids], self.crossings[ids] = codes
        self.shown[ids] = Situation.shown(self.task, codes.visits, self.wanted[ids])

    def _widen(self, columns: int) -> None:
        """Make room for codes of so many visits."""
        columns = max(columns, self.visits.shape[1])
        self.visits, self.wanted = padded(self.visits, columns), padded(self.wanted, columns)
        self.signs = padded(self.signs, columns // 2)

    def _pictures(self, ids: Ids, frames: Ids) -> NDArray[np.uint8]:
        """Draw frames in increasing order, as `_frames` numbers them."""
        ropes, goals = ids[frames[frames < len(ids)]], ids[frames[frames >= len(ids)] - len(ids)]
        for row in {*self.goal_row[ids].tolist()} - self._goal_images.keys():
            rope = self.goals.points[[row]]
            shown = self._observer.appearances([(row, rope[0])])
            self._goal_images[row] = self._observer.draw_ropes(rope, shown)[0], shown[0]
        looks = [self._goal_images[row][1] for row in self.goal_row[ropes].tolist()]
        points, threads = self.simulation.points[ropes], self.simulation.threads
        drawn = self._observer.draw_ropes(points, looks, threads)
        kept = [self._goal_images[row][0] for row in self.goal_row[goals].tolist()]
        return np.concatenate([drawn, kept]) if kept else drawn

    def _choose(self, row: object, rows: Ids, name: str, rng: np.random.Generator) -> int:
        # drawn even if unused, so that the noise that follows doesn't depend on options
        drawn = int(rows[rng.integers(len(rows))])
        if row is None:
            return drawn
        given = np.asarray(row)  # numeric infos hold such arrays
        if given.dtype.kind not in "iu" or given.ndim or given not in rows:
            few = self.task.max_goals if name == "goal" else None
            first = "" if few is None else f", of the first {few}"
            rows = self.rows[name] if len(self._sides) > 1 else rows
            shown = ", ".join(map(str, rows[:8])) + (", ..." if len(rows) > 8 else "")
            numbers = sorted({pair[name == "goal"].nx for pair in self._sides})
            crossings = ", ".join(map(str, numbers))
            raise InvalidInput(
                f"{name} must be a row with nx = {crossings} of the {self.task.split}"
                f" split{first}: {shown}; got {row!r}"
            )
        return int(given)
