"""Episodes: a table of episodes and a table of their steps, in two forms.

A *recording* keeps what can't be computed: where each rope was laid, how it was pulled, and what
for. *Columns* add what follows from that by stepping. `control.sampler` makes both; expanding a
recording is the rollout of a policy that repeats its pulls.

A column is *stepped* by the engine, *derived* by a function, or *given*: by the run (seeds, starts,
goals), by the policy (pulls), or by whom nothing can ask again (labels, a user's own columns). A
recording keeps what is given.

    row          0    1    2         T     an episode of T pulls has T + 1 rows of steps
    observation  s0   s1   s2  ...   sT
    pull         a0   a1   a2        -     what is done in this row's state; zeros in the last row
    reward       r0   r1   r2        0     what that pull brought, and whether it ended the episode

Rows of steps belong to episodes by their lengths alone, so merging sets is appending tables.

A Gauss code takes a row of `visits` (+label over, -label under, in the order of the walk, then
zeros) and a row of `signs` (of label k + 1, then zeros). Both are as wide as the longest code of a
set needs, so a code of any number of crossings fits; sets of different widths are `fitted` first.
"""

import hashlib
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Column, Ids, InvalidInput, Schema, Table, padded
from knotgym.envs import Situation, TaskConfig
from knotgym.rope import FORCE_BINS, TowBound, quantized
from knotgym.topology import CodeArrays, GaussCode

_COLUMNS = tomllib.loads((files("knotgym.datasets") / "episodes.toml").read_text("utf-8"))


def columns_in(*parts: str) -> tuple[Column, ...]:
    """Return the columns of some parts of `episodes.toml`, one part after the other."""
    listed = [item for part in parts for item in _COLUMNS[part].items()]
    return tuple(
        Column(name, **facts)._replace(shape=(*facts.get("shape", ()),)) for name, facts in listed
    )


STARTS = Schema("episodes", columns_in("starts"), "where an episode begins")
_OWN = ("starts", "played", "planned", "setups")
EPISODES = Schema("episodes", columns_in(*_OWN, "goals"), "an episode")
_STEP = "a state, the pull made in it, and what it brought"
_PARTS = ("pulls", "macros", "frames", "labels")
# names of columns that users add begin with the last word
STEPS = Schema("steps", columns_in(*_PARTS), _STEP, own="info/")
MACROS = tuple(column.name for column in columns_in("macros"))
# of both forms, and under the digest of starts and pulls
_CORE = {c.name for c in columns_in("starts", "played", "planned", "pulls") if not c.optional}
_CORE |= {*MACROS, *(c.name for c in columns_in("setups"))}
_PLANNED = {c.name for c in columns_in("planned")}


def _kept(schema: Schema) -> Schema:
    """Return the columns of a recording: all of both forms, and others that are given."""
    kept = [c.name for c in schema.columns if c.name in _CORE or c.origin == "given"]
    return schema.only(*kept)


# its digests are as long as tells episodes apart
_DIGEST = columns_in("digests")[0]._replace(derived=lambda made: made._state_digests())
RECORDED = _kept(EPISODES)
PULLS = _kept(STEPS)._replace(row="a state and the pull made in it")
(_BINS,) = columns_in("bins")
_STORED = (*PULLS.columns, _BINS._replace(unit=f"max_force / {FORCE_BINS}"))
# as files of recordings have them: forces in one of two columns
STORED_PULLS = PULLS._replace(columns=tuple(c._replace(optional=c.name != "bead") for c in _STORED))
STORED_ROWS = RECORDED.extended(_DIGEST)


def _is_claim(column: Column) -> bool:
    """Whether nothing can make a column again, nor does a replay repeat it."""
    return column.origin == "given" and column.name not in _CORE - _PLANNED


_VISITS = ("visits", "goal_visits")  # columns of codes
_OF_CODES = (("visits",), ("labels",))  # shapes of columns as wide as the longest code
RELABEL = ("last", "all")
# the force of each whole number, at the place of its byte
_FORCES = quantized(np.arange(256).astype(np.int8) / FORCE_BINS).astype(np.float32)


class Shown(NamedTuple):
    """States of n ropes, from which a column of a state is `derived`.

    Attributes:
        observation: float64 (n, beads, 3), vertices, metres.
        visits, signs, crossings: their codes, as the columns of these names.
    """

    observation: NDArray[np.float64]
    visits: NDArray[np.int16]
    signs: NDArray[np.int8]
    crossings: Ids


class Episodes(NamedTuple):
    """A set of episodes; a recording if `steps` holds pulls alone.

    Attributes:
        episodes: one row an episode, EPISODES or RECORDED.
        steps: one row a state, STEPS or PULLS.
    """

    episodes: Table
    steps: Table

    @staticmethod
    def of_states(schema: Schema, *given: Any) -> dict[str, NDArray[Any]]:
        """Return the columns of steps that belong to states; `given` are those of `Shown`.

        Raises:
            InvalidInput: nothing says how a column is computed.
        """
        shown = Shown(*given)
        columns: dict[str, NDArray[Any]] = {}
        for c in schema.columns:
            if c.of != "state" or c.origin == "given":
                continue
            if not c.derived and c.name not in Shown._fields:
                raise InvalidInput(
                    f"nothing computes column {c.name} of steps: give it `derived`, a function of"
                    " `Shown`, in knotgym/datasets/episodes.py"
                )
            columns[c.name] = c.derived(shown) if c.derived else getattr(shown, c.name)
        return columns

    @staticmethod
    def schema_beside(steps: Schema) -> Schema:
        """Return the schema of episodes whose steps have these columns."""
        return EPISODES if "observation" in steps.names else RECORDED

    @property
    def offsets(self) -> Ids:
        """First row of steps of each episode, then their number: int64 (n + 1,)."""
        return np.concatenate([[0], np.cumsum(self.episodes["length"] + 1)])

    @property
    def is_recording(self) -> bool:
        """Whether the set holds starts and pulls alone."""
        return "observation" not in self.steps

    def select(self, rows: ArrayLike) -> "Episodes":
        """Return some episodes, by a mask or by their numbers, in that order."""
        chosen = np.arange(self.episodes.rows)[np.asarray(rows) if np.size(rows) else slice(0)]
        steps = Episodes.ranges(self.offsets[chosen], self.episodes["length"][chosen] + 1)
        return Episodes(self.episodes.take(chosen), self.steps.take(steps))

    def recording(self) -> "Episodes":
        """Return the same episodes as starts, pulls and all else that is given."""
        if self.is_recording:
            return self
        kept = Episodes(*(table.only(*_kept(table.schema).names) for table in self))
        columns = {**kept.episodes, _DIGEST.name: self._state_digests()}
        return kept._replace(episodes=Table(kept.episodes.schema.extended(_DIGEST), columns))

    def of_setup(self, setup: ArrayLike) -> "Episodes":
        """Return the episodes with the column `setup`, one number or (n,)."""
        column = columns_in("setups")[0]
        numbers = np.broadcast_to(np.asarray(setup, np.int16), self.episodes.rows)
        schema = self.episodes.schema.extended(column)
        return self._replace(episodes=Table(schema, {**self.episodes, column.name: numbers}))

    def core(self) -> "Episodes":
        """Return the columns that both forms of every set have."""
        return Episodes(*(table.only(*_CORE & {*table}) for table in self))

    def replayed(self) -> "Episodes":
        """Return the columns that a replay gives or repeats, of those that every set has."""
        names = {
            c.name
            for table in self
            for c in table.schema.columns
            if not _is_claim(c) and (c.name in _CORE or not c.optional)
        }
        return Episodes(*(table.only(*names & {*table}) for table in self))

    def claims(self) -> dict[str, Table]:
        """Return each column that nothing can make again, by the name of its table and its own."""
        return {
            f"{table.schema.name}/{c.name}": table.only(c.name)
            for table in self
            for c in table.schema.columns
            if _is_claim(c) and c.name not in _CORE
        }

    def with_claims(self, stored: "Episodes") -> "Episodes":
        """Return the episodes, played again, with what nothing can make again of those stored."""
        tables = list[Table]()
        for made, table in zip(self, stored, strict=True):
            given = (c for c in table.schema.columns if c.origin == "given")
            names = [c.name for c in given if _is_claim(c) or c.name not in made]
            claims = table.only(*names if made.rows == table.rows else ())
            schema = made.schema.extended(*claims.schema.columns)
            tables.append(Table(schema, {**made, **claims}))
        return Episodes(*tables)

    def last(self) -> Ids:
        """Return the row of steps of each episode's last state: int64 (n,)."""
        return self.offsets[1:] - 1

    def episode_of(self) -> Ids:
        """Return the episode of each row of steps: int64 (rows,)."""
        return np.repeat(np.arange(self.episodes.rows), self.episodes["length"] + 1)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns by the names of their tables, such as a journal keeps."""
        return {f"{table.schema.name}/{name}": table[name] for table in self for name in table}

    @staticmethod
    def code_sizes(crossings: int) -> dict[str, int]:
        """Return the sizes that schemas need for codes of up to so many crossings.

        >>> Episodes.code_sizes(3)
        {'visits': 6, 'labels': 3}
        """
        return {"visits": 2 * max(1, crossings), "labels": max(1, crossings)}

    @staticmethod
    def binned(forces: NDArray[np.float32]) -> NDArray[np.int8] | None:
        """Return forces as whole numbers, from which `unbinned` gives every bit; None if it can't.

        Args:
            forces: (n, 3), in units of the largest; it can if they are `quantized`.
        """
        with np.errstate(invalid="ignore"):  # of forces out of range, which no whole number gives
            bins = np.rint(forces * FORCE_BINS).astype(np.int8)
        return bins if Episodes.unbinned(bins).tobytes() == forces.tobytes() else None

    @staticmethod
    def unbinned(bins: NDArray[np.int8]) -> NDArray[np.float32]:
        """Return the forces, in units of the largest, that `binned` has written."""
        return _FORCES[bins.view(np.uint8)]

    @staticmethod
    def ranges(first: ArrayLike, lengths: ArrayLike) -> Ids:
        """Concatenate the ranges of so many whole numbers from each first one on.

        >>> Episodes.ranges([5, 0], [2, 3]).tolist()
        [5, 6, 0, 1, 2]
        """
        counts = np.asarray(lengths, dtype=np.int64)
        ends = np.cumsum(counts)
        starts = np.asarray(first, dtype=np.int64) - (ends - counts)
        return np.repeat(starts, counts) + np.arange(int(counts.sum()))

    @classmethod
    def of(cls, columns: Mapping[str, NDArray[Any]]) -> "Episodes":
        """Return the episodes whose `columns` are given; none is a recording."""
        tables = []
        for schema in (EPISODES, STEPS):
            named = {name.removeprefix(f"{schema.name}/"): columns[name] for name in columns}
            schema = schema.with_own(named)
            present = {name: named[name] for name in schema.names if name in named}
            tables.append(Table(schema.only(*present), present))
        return cls(*tables)

    @classmethod
    def to_repeat(cls, lengths: Ids, pulls: Mapping[str, NDArray[Any]], policy: str) -> "Episodes":
        """Return episodes of so many pulls each, to be played; `pulls` returns these again.

        Args:
            lengths: int64 (n,).
            pulls: columns of PULLS, one row a pull, episode after episode.
            policy: name of the policy that acted.
        """
        schema = PULLS.only(*pulls)
        steps = schema.empty(int(lengths.sum()) + len(lengths))
        # a pull a row there, a state a row here: the last state of an episode has none
        at = np.arange(int(lengths.sum())) + np.repeat(np.arange(len(lengths)), lengths)
        for name, values in steps.items():
            values[at] = pulls[name]
        rows = {"length": lengths, "planner_steps": np.zeros_like(lengths)}
        rows["policy"] = np.full(len(lengths), policy)
        return cls(Table(RECORDED.only(*rows), rows), Table(schema, steps))

    @staticmethod
    def to_begin(start_qpos: ArrayLike, seed: ArrayLike, **more: ArrayLike) -> Table:
        """Return where n episodes begin, to be played: rows of STARTS.

        Args:
            start_qpos: float64 (n, nq), m and 1.
            seed: int64 (n,).
            more: other columns; those that aren't given are zeros.
        """
        schema = STARTS.sized(nq=np.shape(start_qpos)[1])
        given = {"start_qpos": start_qpos, "seed": seed, **more}
        columns = {name: np.asarray(values) for name, values in given.items()}
        return Table(schema, {**schema.empty(len(columns["seed"])), **columns})

    def pulls(self) -> Table:
        """Return the rows of steps in which a pull is made: all but the last of each episode."""
        return self.steps.take(np.delete(np.arange(self.steps.rows), self.last()))

    @classmethod
    def merged(cls, sets: Sequence["Episodes"]) -> "Episodes":
        """Return all episodes, one set after the other."""
        if not sets:
            raise InvalidInput("nothing to merge: give at least one set of episodes")
        return cls(*(Table.joined(tables) for tables in zip(*fitted(sets), strict=True)))

    def distinct(self) -> dict[str, int]:
        """Count the distinct starts (rows of the states), goals (codes) and pairs of both.

        A learner meets no more situations than pairs, however many episodes there are.
        """
        starts, goals = self.episodes["start"], _code_ids(self.episodes["goal_visits"])
        both = {"starts": starts[:, None], "goals": goals[:, None]}
        both["pairs"] = np.hstack([*both.values()])
        return {name: len(np.unique(rows, axis=0)) for name, rows in both.items()}

    def differences(
        self, other: "Episodes", numbers: Sequence[int] | Ids | None = None
    ) -> list[str]:
        """Say in which episode, step and column another set differs in any bit.

        Columns that only one of them has aren't compared, nor those of episodes that are claims,
        nor where a column has no value.

        Args:
            other: the other set.
            numbers: what to call the episodes; by default their places.

        Returns:
            For each episode and column the first difference, in order of the episodes.
        """
        if self.episodes.rows != other.episodes.rows:
            return [f"{other.episodes.rows} episodes, should be {self.episodes.rows}"]
        called = range(self.episodes.rows) if numbers is None else numbers
        return [
            f"episode {called[row]}{f', step {step}' * (step >= 0)}: {name} differs"
            for row, step, name in self.differing(other)
        ]

    @staticmethod
    def missed(goals: ArrayLike, success: ArrayLike) -> list[tuple[Any, tuple[int, int]]]:
        """Count the failed episodes and all of each goal, the most missed first.

        >>> Episodes.missed(["1+,1-", "1+,1-", "1-,1+"], [True, False, True])
        [('1+,1-', (1, 2))]
        """
        every, failed = Counter(np.asarray(goals).tolist()), ~np.asarray(success, bool)
        missed = Counter(np.asarray(goals)[failed].tolist()).most_common()
        return [(goal, (count, every[goal])) for goal, count in missed]

    def differing(self, other: "Episodes") -> list[tuple[int, int, str]]:
        """Return the row, step and column of each of the `differences`; step -1 of an episode's."""
        mine, other = _same_width([self, other])
        differences: list[tuple[int, int, str]] = []
        for name in mine.episodes.keys() & other.episodes.keys():
            rows = _differing(mine.episodes, other.episodes, name)
            differences += [(row, -1, name) for row in rows.tolist()]
        # steps are compared where episodes have as many
        alike = np.flatnonzero(mine.episodes["length"] == other.episodes["length"])
        if len(alike) < mine.episodes.rows:
            mine, other = mine.select(alike), other.select(alike)
        owner, offsets = mine.episode_of(), mine.offsets
        for name in mine.steps.keys() & other.steps.keys():
            rows = _differing(mine.steps, other.steps, name)
            for row in rows[np.unique(owner[rows], return_index=True)[1]].tolist():
                k, step = int(alike[owner[row]]), int(row - offsets[owner[row]])
                differences.append((k, step, name))
        return sorted(differences)

    def codes_held(self, task: TaskConfig) -> tuple[Ids, Ids]:
        """Number the code of each state, and count for how many steps it has been shown.

        Codes that a goal doesn't tell apart, see `envs.Situation.asked`, have one number.

        Returns:
            int64 (rows,) each: the codes, numbered from 0, but -1 where none counts: from the
            first state beyond the bound on towing on, and where the simulation blew up; and the
            steps.
        """
        first = self.offsets[self.episode_of()]
        beyond = np.zeros(self.steps.rows, dtype=bool)
        if task.tow_limit is not None:
            points = self.steps["observation"]
            beyond = TowBound(TowBound.centres(points)[first], task.tow_limit).exceeded(points)
        beyond[self.last()] |= self.episodes["diverged"]
        passed = np.concatenate([[0], np.cumsum(beyond)])
        numbers = _code_ids(Situation.asked(task, self.steps["visits"]))
        numbers[passed[1:] > passed[first]] = -1
        # the state of a reset isn't a step, so that the first step begins to hold a code
        row = np.arange(len(numbers))
        begins = np.append(True, numbers[1:] != numbers[:-1]) | (row - first <= 1)
        held = row - np.maximum.accumulate(np.where(begins, row, 0)) + (row > first)
        return numbers, held

    def goals_reached(self, task: TaskConfig, relabel: str = "all") -> tuple[Ids, Ids]:
        """Find the steps at which an episode has shown a new code for as long as a task asks.

        The start's own code doesn't count, and each other code counts once, at its first such step.

        Args:
            task: for how many consecutive states the code must be shown; and beyond which limit
                on towing states don't count any more.
            relabel: "all" steps, or the "last" of each episode.

        Returns:
            The episode and the step of each, int64 (m,).
        """
        if relabel not in RELABEL:
            known = " or ".join(map(repr, RELABEL))
            raise InvalidInput(f"relabel must be {known}, got {relabel!r}")
        (ids, held), episode, offsets = self.codes_held(task), self.episode_of(), self.offsets
        rows = np.flatnonzero((ids >= 0) & (ids != ids[offsets[episode]]) & (held >= task.hold))
        pairs = episode[rows] * (int(ids.max(initial=0)) + 1) + ids[rows]
        first = rows[np.sort(np.unique(pairs, return_index=True)[1])]
        if relabel == "last":
            first = first[np.diff(episode[first], append=-1) != 0]
        return episode[first], first - offsets[episode[first]]

    def goal_reached(self, task: TaskConfig) -> NDArray[np.bool_]:
        """Return which states show the goal for as many consecutive states as the task asks.

        A start is never one of them, nor a state beyond the bound on towing or in which the
        simulation blew up.

        Returns:
            bool (rows,), for each row of steps.
        """
        (ids, held), episode = self.codes_held(task), self.episode_of()
        rows = self.episodes
        shown = Situation.shown(task, self.steps["visits"], rows["goal_visits"][episode])
        wanted = np.where(rows["hold"] > 0, rows["hold"], task.hold)
        return np.asarray(shown & (ids >= 0) & (held >= wanted[episode]))

    def _state_digests(self) -> NDArray[np.uint8]:
        """Compute the first bytes of the SHA-256 of each episode: uint8 (n, 8).

        It covers the start, all states with their codes, and the pulls; rewards and ends follow.
        """
        (rows, steps), length = self, int(_DIGEST.shape[0])
        digests = np.zeros((rows.rows, length), dtype=np.uint8)
        for row, (first, end) in enumerate(pairwise(self.offsets.tolist())):
            states, pulls = slice(first, end), slice(first, end - 1)
            # codes of sets are padded to different widths, so zeros don't count
            codes = [steps[name][states] for name in ("visits", "signs")]
            parts = [rows["start_qpos"][row], steps["observation"][states], steps["bead"][pulls]]
            parts += [steps["force"][pulls], steps["crossings"][states]]
            parts += [code[code != 0] for code in codes]
            whole = b"".join(part.tobytes() for part in parts)
            digests[row] = np.frombuffer(hashlib.sha256(whole).digest()[:length], dtype=np.uint8)
        return digests

    def digests(self) -> list[bytes]:
        """Hash the start, goal and pulls of each episode; equal episodes have equal digests."""
        (rows, steps), hashed = self, list[bytes]()
        for row, (first, end) in enumerate(pairwise(self.offsets.tolist())):
            whole = hashlib.sha256(rows["start_qpos"][row].tobytes() + rows["goal"][row].tobytes())
            whole.update(np.trim_zeros(rows["goal_visits"][row], "b").tobytes())
            whole.update(steps["bead"][first:end].tobytes() + steps["force"][first:end].tobytes())
            hashed.append(whole.digest())
        return hashed


def fitted(sets: Sequence[Episodes]) -> list[Episodes]:
    """Make sets alike: codes as wide as the longest of all needs, optional columns that any has.

    Other columns aren't copied.

    Raises:
        InvalidInput: a column that some lack has no value for unknown.
    """
    tables = map(Table.alike, zip(*_same_width(sets), strict=True))
    return [Episodes(*pair) for pair in zip(*tables, strict=True)]


def _same_width(sets: Sequence[Episodes]) -> list[Episodes]:
    tables = [table for episodes in sets for table in episodes]
    codes = [table[name] for table in tables for name in _VISITS if name in table]
    most = max([0, *(int(np.count_nonzero(visits, axis=1).max(initial=0)) for visits in codes)])
    sizes = Episodes.code_sizes(most // 2)
    return [Episodes(*(_widened(table, sizes) for table in episodes)) for episodes in sets]


def _code_ids(visits: NDArray[np.int16]) -> Ids:
    """Number distinct codes: equal rows of (n, width) have equal numbers from 0, int64 (n,)."""
    rows = np.ascontiguousarray(visits)
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    return np.unique(keys, return_inverse=True)[1].astype(np.int64)


def gauss_codes(
    visits: NDArray[np.int16], signs: NDArray[np.int8] | None = None
) -> NDArray[np.str_]:
    """Write codes as text, with chirality if signs are given: str (n,).

    Raises:
        InvalidInput: numbers aren't a Gauss code.
    """
    texts = CodeArrays(visits).texts()
    for text in {*texts.tolist()}:
        GaussCode.parse(text)  # which a stranger's numbers needn't be
    if signs is not None:
        texts = CodeArrays(visits, padded(signs, visits.shape[1] // 2)).texts()
    return texts.astype(str)


def _widened(table: Table, sizes: dict[str, int]) -> Table:
    """Return a table whose codes are as wide as `sizes` says; what is cut off is zero."""
    codes = {c.name: sizes[str(c.shape[0])] for c in table.schema.columns if c.shape in _OF_CODES}
    columns = {name: padded(table[name], width) for name, width in codes.items()}
    return Table(table.schema.sized(**sizes), {**table, **columns})


def _differing(table: Table, other: Table, name: str) -> Ids:
    """Return the rows whose values of a column differ in any bit; all if the shapes differ.

    Rows in which the other table has no value of an optional column don't differ.
    """
    (column,), a, b = other.schema.only(name).columns, table[name], other[name]
    if _is_claim(column) and table.schema.name == EPISODES.name:
        return np.zeros(0, dtype=np.int64)
    if a.shape != b.shape:
        return np.arange(min(1, max(len(a), len(b))))
    if a.dtype.kind == "U" or a.dtype != b.dtype:
        return np.flatnonzero((a != b).reshape(len(a), -1).any(axis=1))
    if not a.size:
        return np.zeros(0, dtype=np.int64)
    bits, stored = (np.ascontiguousarray(x).reshape(len(x), -1).view(np.uint8) for x in (a, b))
    unlike = (bits != stored).any(axis=1)
    if column.optional and column.no_value is not None and column.name not in MACROS:
        nothing = np.full((1, stored.shape[1] // b.itemsize), column.no_value, b.dtype)
        unlike &= (stored != nothing.view(np.uint8)).any(axis=1)
    return np.flatnonzero(unlike)
