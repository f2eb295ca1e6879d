"""The one loop that plays: any policy, either engine, hundreds of ropes side by side.

Each rope is in a *lane* of an `EpisodeBatch`. A lane whose episode is over takes the next seed at
once. What happens in an episode depends on its own seed alone: not on its lane, nor on what is
played beside it.

A `Policy` is a description; its `player` acts in the lanes of one batch, so nothing is left over
from an earlier run. A player may leave lanes out while it plans: the others go on without them.

After a change run `pytest tests/control/test_policies.py`: an episode must depend on its own seed
alone; then `python benchmarks/golden.py --compare tests/data/golden.json`: nothing may differ.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Counts, Ids, InvalidInput, InvalidPolicy, Schema, Stream, Table, padded
from knotgym.datasets import MACROS, STEPS, Episodes
from knotgym.envs import EpisodeBatch, TaskConfig

_CODES = ("visits", "signs")  # columns that widen with the longest code

# Of speed and memory alone: no result depends on these three. `benchmarks/pairs.py`
# measures what they are about.
LANES = 256  # ropes side by side, by default
_BLOCK = 64  # starts that are drawn and laid together
_MOST_BYTES = 2**28  # of the steps of episodes under way; more lanes than fit aren't used


class Pulls(NamedTuple):
    """One pull in each of n lanes.

    Attributes:
        ids: int64 (n,), the lanes, in increasing order.
        beads: int64 (n,), pulled at their centres.
        forces: float32 (n, 3), in units of the largest force, in [-1, 1].
        macros: int64 (n, 4), the macro-action that each pull is part of: whether it is the first
            pull, then the bead, target and side; zeros where it is part of none. None if the policy
            doesn't say.
        given: other columns of the pulls, by their names in the table of steps, such as how likely
            they were: (n, ...) each. None for none.
    """

    ids: Ids
    beads: NDArray[np.int64]
    forces: NDArray[np.float32]
    macros: NDArray[np.int64] | None = None
    given: Mapping[str, NDArray[Any]] | None = None


# a user's own columns: (batch, ids) -> name -> values (n, ...) of the states that n lanes are in
Columns = Callable[[EpisodeBatch, Ids], Mapping[str, NDArray[Any]]]


class Player(Protocol):
    """A policy at work in the lanes of one batch.

    A player may also have `names`, the name of the policy in each lane, if they differ.

    Attributes:
        planned: int64 (lanes,), pulls that it has simulated for the episode in a lane.
    """

    planned: NDArray[np.int64]

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        """Start new episodes in lanes; all random draws for each must come from its generator."""

    def act(self, ids: Ids) -> Pulls:
        """Choose pulls in some of the lanes `ids`, which are in increasing order.

        Lanes that are left out wait while the policy plans; they are among the next `ids` again.
        """


class Policy(Protocol):
    """A way to act, which any number of batches can use.

    Attributes:
        name: stored with its episodes.
    """

    @property
    def name(self) -> str: ...

    def compatible_task(self, task: TaskConfig, /) -> TaskConfig:
        """Return the task with the observation that this policy needs.

        Raises:
            InvalidPolicy: the task lacks something that the policy needs, such as a view.
        """

    def player(self, batch: EpisodeBatch, /) -> Player:
        """Return a player for the lanes of a batch."""


@dataclass(frozen=True)
class SimplePolicy:
    """A policy put together from its parts, which are those of `Policy`."""

    name: str
    player: Callable[[EpisodeBatch], Player]
    compatible_task: Callable[[TaskConfig], TaskConfig] = lambda task: task


def rollouts(
    policy: Policy,
    task: TaskConfig,
    seeds: Sequence[int] | Table,
    *,
    lanes: int = LANES,
    keep: Schema | None = STEPS,
    attempt: int = 0,
    adviser: Policy | None = None,
    columns: Columns | None = None,
) -> Episodes:
    """Play an episode for every seed, and return them in that order.

    Args:
        policy: the policy that acts.
        task: the environment; the policy may replace its observation.
        seeds: of the episodes, each as after `env.reset(seed=...)`; or a table with the columns of
            `episodes.STARTS`, to begin where those episodes did.
        lanes: ropes side by side. Changes nothing but the time that it takes.
        keep: columns of steps to keep; None for none.
        attempt: changes the policy's random draws, not the starts.
        adviser: policy whose pull is stored at every state as `expert_action`, and not made.
        columns: computes further columns of each state, stored as `info/NAME`.

    Raises:
        InvalidPolicy: the policy doesn't fit the task, or its pulls aren't valid.
    """
    task = policy.compatible_task(task)
    wanted = seeds.rows if isinstance(seeds, Table) else len(seeds)
    seeds, todo = (seeds, wanted) if wanted else ([0], 1)  # a batch has at least one rope
    most = _MOST_BYTES // ((task.horizon + 1) * (12 * task.beads + 256))  # all steps kept
    batch = EpisodeBatch(task, max(1, min(lanes, todo, most)))
    coming = _Coming(batch, seeds)
    player = policy.player(batch)
    record = _Record(batch, keep, todo, columns)
    advice = None if adviser is None else _Advice(adviser.player(batch), batch)
    while True:
        free = np.flatnonzero(batch.number < 0)
        ids = coming.begin(free)
        if len(ids):
            # A stream of its own for each episode and attempt, apart from the one that drew its
            # start: a policy that draws more or less changes no start.
            draws = [Stream.POLICY.generator(max(0, s), attempt) for s in batch.seed[ids].tolist()]
            player.begin(ids.copy(), draws)
            record.begin(ids)
        playing = np.flatnonzero(batch.number >= 0)
        if not len(playing):
            return record.whole() if wanted else record.whole().select([])
        # copies go in and come out: a player may keep, change and reuse its arrays
        pulls = _checked(player.act(playing.copy()), playing, batch, policy.name)
        # every lane plans; asking again lets their searches go on
        if not len(pulls.ids):
            continue
        record.before(pulls, advice.given(pulls.ids) if advice is not None else None)
        outcome = batch.pull(pulls.ids, pulls.beads, pulls.forces)
        record.after(pulls.ids, *outcome)
        over = pulls.ids[outcome.terminated | outcome.truncated]
        for index in over.tolist():
            planned = sum(int(by.planned[index]) for by in (player, advice) if by is not None)
            names = getattr(player, "names", None)
            record.end(index, policy.name if names is None else str(names[index]), planned)
        # an episode that goes on counts by its share of the horizon
        left = (task.horizon - batch.steps[over]).sum()
        Counts.end_item(float(len(pulls.ids) + left) / task.horizon)
        # freed only now, so that the next episodes begin together
        batch.number[over] = -1


def _checked(pulls: Pulls, playing: Ids, batch: EpisodeBatch, name: str) -> Pulls:
    """Return a copy of a player's pulls, if they can be made."""
    try:
        n = len(pulls.ids)
        arrays: list[Any] = [(pulls.ids, np.int64, (n,)), (pulls.beads, np.int64, (n,))]
        arrays.append((pulls.forces, np.float32, (n, 3)))
        if pulls.macros is not None:
            arrays.append((pulls.macros, np.int64, (n, 4)))
        fits = all(array.dtype == kind and array.shape == shape for array, kind, shape in arrays)
        # in increasing order, and among those that were asked
        fits = fits and bool(np.array_equal(pulls.ids, playing[np.isin(playing, pulls.ids)]))
        fits = fits and bool((np.abs(pulls.forces) <= 1).all())
        fits = fits and bool(((pulls.beads >= 0) & (pulls.beads < batch.task.beads)).all())
    except (AttributeError, TypeError):
        fits = False
    if not fits:
        raise InvalidPolicy(
            f"policy {name} must return Pulls of the ropes that it is asked about: ids and beads"
            " int64 (n,), forces float32 (n, 3) in [-1, 1]"
        )
    macros = None if pulls.macros is None else pulls.macros.copy()
    others = {name: np.array(values) for name, values in (pulls.given or {}).items()}
    return Pulls(pulls.ids.copy(), pulls.beads.copy(), pulls.forces.copy(), macros, others)


class _Coming:
    """Begins episodes in free lanes.

    The first ones begin together. Later ones are drawn and laid in blocks in a batch of their own,
    because one start alone takes nearly as long as many.
    """

    def __init__(self, batch: EpisodeBatch, seeds: Sequence[int] | Table) -> None:
        self._batch, self._seeds = batch, seeds
        self._todo = seeds.rows if isinstance(seeds, Table) else len(seeds)
        self._begun = 0  # episodes begun in lanes
        self._spare: Any = None  # a batch
        self._ready = np.empty(0, np.int64)  # rows of it with the next episodes

    def begin(self, free: Ids) -> Ids:
        """Begin the next episodes in free lanes; return those that were needed."""
        ids = left = free[: self._todo - self._begun]
        if not self._begun:
            self._lay(self._batch, ids)
            self._number(ids)
            return ids
        while len(left):
            if not len(self._ready):
                # the last block is no larger than what is left to play
                self._ready = np.arange(min(_BLOCK, self._todo - self._begun))
                self._spare = self._spare or EpisodeBatch(self._batch.task, len(self._ready))
                self._lay(self._spare, self._ready)
            rows, self._ready = np.split(self._ready, [len(left)])
            some, left = left[: len(rows)], left[len(rows) :]
            self._batch.copy_from(self._spare, rows, some)
            self._number(some)
        return ids

    def _lay(self, batch: EpisodeBatch, ids: Ids) -> None:
        some = slice(self._begun, self._begun + len(ids))
        if isinstance(self._seeds, Table):
            batch.restore(ids, self._seeds.take(some))
        else:
            batch.begin(ids, [*self._seeds[some]])

    def _number(self, ids: Ids) -> None:
        self._batch.number[ids] = np.arange(self._begun, self._begun + len(ids))
        self._begun += len(ids)


class _Advice:
    """What another policy would do in each state; it is asked once a state, without its past."""

    def __init__(self, player: Player, batch: EpisodeBatch) -> None:
        self._player, self._batch = player, batch
        self.planned = np.zeros(batch.count, dtype=np.int64)

    def given(self, ids: Ids) -> Pulls:
        """Return pulls in the states of lanes that are about to move on."""
        seeds, steps = self._batch.seed[ids].tolist(), self._batch.steps[ids]
        self.planned[ids[steps == 0]] = 0
        beads = np.zeros(len(ids), dtype=np.int64)
        forces = np.zeros((len(ids), 3), dtype=np.float32)
        # a generator for each (episode, step): advice doesn't depend on the states before
        keys = zip(seeds, steps.tolist(), strict=True)
        rngs = [Stream.EXPERT_LABEL.generator(max(0, seed), step) for seed, step in keys]
        self._player.begin(ids, rngs)
        waiting = ids
        while len(waiting):
            pulls = self._player.act(waiting)
            rows = np.searchsorted(ids, pulls.ids)
            beads[rows], forces[rows] = pulls.beads, pulls.forces
            waiting = np.setdiff1d(waiting, pulls.ids, assume_unique=True)
        self.planned[ids] += self._player.planned[ids]
        return Pulls(ids, beads, forces)


class _Record:
    """What is kept of the episodes under way, in arrays (lanes, horizon + 1, ...)."""

    def __init__(
        self, batch: EpisodeBatch, keep: Schema | None, todo: int, columns: Columns | None
    ) -> None:
        self._batch, self._own = batch, columns if keep is not None else None
        names = keep.names if keep is not None else []
        self._schema = self._sized((keep or STEPS).only(*names))
        self._states = {c.name for c in self._schema.columns if c.of == "state"}
        self._unfilled: set[str] | None = {*names}  # until the first pull was made
        self._episodes = self._sized(Episodes.schema_beside(self._schema))
        length = batch.task.horizon + 1
        self._steps = {
            name: column.reshape(batch.count, length, *column.shape[1:])
            for name, column in self._schema.empty(batch.count * length).items()
        }
        # results by episode, in the order of the seeds
        self._rows: list[dict[str, Any]] = [{} for _ in range(todo)]
        self._parts: list[dict[str, NDArray[Any]]] = [{} for _ in range(todo)]
        self._totals = np.zeros(batch.count)
        self._success = np.zeros(batch.count, dtype=bool)

    def begin(self, ids: Ids) -> None:
        """Episodes begin in lanes."""
        self._totals[ids], self._success[ids] = 0.0, False
        self._see(ids)

    def before(self, pulls: Pulls, advised: Pulls | None) -> None:
        """Keep the pulls that will be made, and those that an adviser would make."""
        if unknown := {*(pulls.given or ())} - {*STEPS.names}:
            raise InvalidPolicy(f"no column {', '.join(sorted(unknown))} of steps for its pulls")
        chosen: dict[str, NDArray[Any]] = {"bead": pulls.beads, "force": pulls.forces}
        chosen |= pulls.given or {}
        if pulls.macros is not None:
            chosen |= dict(zip(MACROS, pulls.macros.T, strict=True))
        for name, by in (("action", pulls), ("expert_action", advised)):
            if name in self._steps and by is not None:
                chosen[name] = self._batch.simulation.actions(by.beads, by.forces, by.ids)
        for name, values in chosen.items():
            self._put(name, pulls.ids, values)

    def after(self, ids: Ids, rewards: NDArray[np.float64], *ends: NDArray[np.bool_]) -> None:
        """Keep what came of the pulls, and the states that they led to."""
        batch = self._batch
        self._success[ids] |= batch.successes(ids)
        self._totals[ids] += rewards
        names = "reward", "terminated", "truncated", "applied_fraction"
        for name, values in zip(names, (rewards, *ends, batch.applied_shares[ids]), strict=True):
            # The batch counts the pull already, and what came of it belongs to the state that it
            # was made in.
            self._put(name, ids, values, -1)
        self._see(ids)
        if self._unfilled is not None:
            self._drop(self._unfilled)
            self._unfilled = None

    def _drop(self, unfilled: set[str]) -> None:
        """Drop what no policy gives, such as macro-actions; other columns must be filled."""
        drop = {c.name for c in self._schema.columns if c.optional and c.origin == "given"}
        if lacking := unfilled - drop:
            raise InvalidInput(
                f"nothing fills column {', '.join(sorted(lacking))} of steps: a column of a state"
                " is `derived`, one of a pull is filled in knotgym/control/sampler.py, or given by"
                " a policy, see `Pulls`"
            )
        for name in unfilled:
            del self._steps[name]

    def end(self, index: int, policy: str, planned: int) -> None:
        """Copy the rows of the episode in a lane, which is over."""
        batch, number = self._batch, int(self._batch.number[index])
        length = int(batch.steps[index])
        for name, column in self._steps.items():
            if name not in self._states:
                column[index, length] = 0  # no pull is made in the last state
        self._parts[number] = {
            name: column[index, : length + 1].copy() for name, column in self._steps.items()
        }
        hold = int(batch.hold[index])
        row = {
            "seed": batch.seed[index],
            "start": batch.start_row[index],
            "goal": batch.goal_row[index],
            "start_qpos": batch.start_qpos[index].copy(),
            "policy": policy,
            "goal_visits": batch.wanted[index].copy(),
            "hold": 0 if hold == batch.task.hold else hold,
            "length": length,
            "success": self._success[index],
            "diverged": batch.failed[index],
            "return_": self._totals[index],
            "planner_steps": planned,
        }
        if "observation" in self._steps:
            row["goal_points"] = batch.goal_points(index).astype(np.float32)
        self._rows[number] = row

    def whole(self) -> Episodes:
        """Return all episodes."""
        # goals were kept at the width that codes had then; all get the final one
        width = 2 * self._batch.signs.shape[1]
        rows: dict[str, Any] = {}
        never = [c.name for c in self._episodes.columns if c.optional and c.origin == "given"]
        self._episodes = self._episodes.without(*never)
        if unknown := {*self._episodes.names} - {*self._rows[0], *self._episodes.derived()}:
            raise InvalidInput(
                f"nothing fills column {', '.join(sorted(unknown))} of episodes: it is filled in"
                " knotgym/control/sampler.py"
            )
        stored = self._sized(self._episodes.without(*self._episodes.derived()))
        for column in stored.columns:
            values = [row[column.name] for row in self._rows]
            if column.name == "goal_visits":
                values = [padded(value, width) for value in values]
            rows[column.name] = np.array(values, None if column.dtype == "text" else column.dtype)
        schema = self._schema.only(*self._steps)
        steps: dict[str, NDArray[Any]] = {}
        for column in schema.columns:
            parts = [part[column.name] for part in self._parts]
            if column.name in _CODES:
                full = self._steps[column.name].shape[2]
                parts = [padded(part, full) for part in parts]
            steps[column.name] = np.concatenate(parts)
        made = Episodes(Table(stored, rows), Table(self._sized(schema), steps))
        derived = {name: of(made) for name, of in self._episodes.derived().items()}
        made = made._replace(
            episodes=Table(self._sized(self._episodes), {**made.episodes, **derived})
        )
        # columns as narrow as the longest code that occurs, so that a file doesn't depend on the
        # batch
        return Episodes.merged([made])

    def _sized(self, schema: Schema) -> Schema:
        batch = self._batch
        sizes = Episodes.code_sizes(batch.signs.shape[1])
        return schema.sized(beads=batch.task.beads, nq=batch.start_qpos.shape[1], **sizes)

    def _see(self, ids: Ids) -> None:
        batch = self._batch
        if self._own is not None:
            self._see_own(self._own, ids)
        if not self._states:
            return
        codes = (batch.visits[ids], batch.signs[ids], batch.crossings[ids])
        shown = Episodes.of_states(self._schema, batch.simulation.points[ids], *codes)
        for name, values in shown.items():
            if name in _CODES and values.shape[1] > self._steps[name].shape[2]:
                self._steps[name] = padded(self._steps[name], values.shape[1])
            self._put(name, ids, values)

    def _see_own(self, columns: Columns, ids: Ids) -> None:
        """Keep a user's own columns of the states in lanes."""
        with InvalidInput.instead("columns of your own", Exception):
            for own_name, given in columns(self._batch, ids.copy()).items():
                name, values = f"{STEPS.own}{own_name}", np.asarray(given)
                if name not in self._steps:  # each, at the first state
                    self._add(name, values)
                self._put(name, ids, values)

    def _add(self, name: str, values: NDArray[Any]) -> None:
        if not name.removeprefix(STEPS.own).isidentifier() or values.dtype.kind not in "biuf":
            raise InvalidInput(
                f"{name} should be a name of Python's, and numbers, got {values!r:.80}"
            )
        self._schema = self._schema.extended(*STEPS.with_own({name: values}).only(name).columns)
        self._states.add(name)
        lanes = self._batch.count, self._batch.task.horizon + 1
        self._steps[name] = np.zeros((*lanes, *values.shape[1:]), values.dtype)

    def _put(self, name: str, ids: Ids, values: Any, back: int = 0) -> None:
        if name in self._steps:
            self._steps[name][ids, self._batch.steps[ids] + back] = values
            if self._unfilled:
                self._unfilled.discard(name)
