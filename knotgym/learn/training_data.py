"""What learners are trained on: states and pulls of datasets, decisions, and searched passes.

A clone imitates passes that the expert's search finds, and learns what it tried in vain. A search
begins in a start of the task, after up to _RANDOM_PREFIX random passes, so that ropes lie in more
ways than the states of a set. All of its passes are examples: those that lead to the goal are to be
imitated; others didn't work. Where a pass led to another code, that code is one more goal that it
works for. Beads may be numbered from any other one: then the rope shows the goal's place in the
code, and the code that it ends in, read from there.
"""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Stream
from knotgym.control import (
    BatchedSearch,
    PassPlan,
    PassPlannerConfig,
    PassSearch,
    PassValues,
    TriedPass,
)
from knotgym.datasets import Episodes
from knotgym.envs import EpisodeBatch, Marked, TaskConfig
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.train_config import CloneConfig
from knotgym.rope import Pass
from knotgym.runs import Result
from knotgym.states import SPLITS
from knotgym.topology import CodeArrays, GaussCode, label

TOGETHER = 250  # searches of one call
_ROPES = 128  # that are searched in side by side
# Of these only the budget has a measurement.
_RANDOM_PREFIX = 2  # random passes before a search, at most
# A search that finds a way finds it early: at tie nx 3 one of budget 2,000 simulates 240 pulls on
# average, most of them in searches that fail.
_SEARCH = PassPlannerConfig(budget=500)
_IN_VAIN, _ELSEWHERE = 4, 4  # passes of a search that are kept as such examples, at most
_MOST_CROSSINGS = 6  # of a goal; the network sees no more
Row = tuple[Array, GaussCode, Pass, bool]


class TrainingData(NamedTuple):
    """States and pulls of all episodes, one after the other.

    Attributes:
        frames: float32 (n, BEADS, 3), every state of every episode, metres.
        beads: int64 (n,), bead pulled by the action that led to each state; -1 for a first state.
        forces: float32 (n, 3), force of that action, in units of the largest.
        starts: int64 (episodes,), index of each episode's first state.
    """

    frames: NDArray[np.float32]
    beads: NDArray[np.int64]
    forces: NDArray[np.float32]
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, sets: Sequence[Episodes]) -> "TrainingData":
        """Return the states and pulls of sets of episodes."""
        parts, before = list[TrainingData](), 0
        for dataset in sets:
            steps, starts = dataset.steps, dataset.offsets[:-1]
            # a row holds the pull made in its state; here it belongs to the state that it led to
            beads = np.roll(steps["bead"].astype(np.int64), 1)
            forces = np.roll(steps["force"] * steps["applied_fraction"][:, None], 1, axis=0)
            beads[starts] = -1
            parts.append(cls(steps["observation"], beads, forces, before + starts))
            before += steps.rows
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class Examples(NamedTuple):
    """n decisions in the canonical frame, in few bytes.

    Attributes:
        points, marks, code, goal: float16 and int8, all that the network sees, as of `Marked`.
        macros: int8 (n, 3): bead, strand, 0 for under or 1 for over.
        worked: bool (n,), whether it was on a way to the goal; the other decisions aren't
            imitated, but the network learns that they don't work there.
        episodes: int64 (n,), number of the episode; episodes are held out whole.
    """

    points: NDArray[np.float16]
    marks: NDArray[np.int8]
    code: NDArray[np.int8]
    goal: NDArray[np.int8]
    macros: NDArray[np.int8]
    worked: NDArray[np.bool_]
    episodes: NDArray[np.int64]

    @classmethod
    def of(cls, played: Episodes, first: int = 0) -> "Examples":
        """Return the passes of a set of episodes; the numbers of episodes begin at `first`."""
        steps, episodes = played.steps, played.episodes
        # other macro-actions, which the scripted policy has too, pass no strand
        beads = steps["observation"].shape[1]
        passes = (steps["macro_side"] != 0) & (steps["macro_target"] < beads)
        # the first pull of each: there the policy saw the state and chose
        chosen = np.flatnonzero(steps["macro_start"] & passes)
        number = played.episode_of()[chosen]
        macros = [steps[f"macro_{name}"][chosen] for name in ("bead", "target", "side")]
        return _examples(
            steps["observation"][chosen],
            CodeArrays(np.asarray(episodes["goal_visits"][number], np.int16)).objects(),
            np.stack(macros, axis=1).astype(np.int64),
            episodes["success"][number],
            first + number,
        )


def _examples(
    points: NDArray[np.floating],
    goals: Sequence[GaussCode],
    macros: NDArray[np.int64],
    worked: NDArray[np.bool_],
    episodes: NDArray[np.int64],
) -> Examples:
    """Bring n decisions into the canonical frame.

    Args:
        points: (n, beads, 3), metres, where each macro-action begins; taken as float32.
        goals: n codes; chirality is ignored.
        macros: int64 (n, 3): bead to lead, bead of the strand to pass, +1 over or -1 under.
        worked, episodes: as of `Examples`.
    """
    seen = Marked.of(points.astype(np.float32), goals)
    chosen = seen.frames.macros(np.column_stack([macros[:, :2], macros[:, 2] > 0]), BEADS)
    marks, code, goal, small = (column.astype(np.int8) for column in (*seen[1:4], chosen))
    return Examples(seen.points.astype(np.float16), marks, code, goal, small, worked, episodes)


def demonstrate(config: CloneConfig, task: str, nx: int, first: int) -> Result:
    """Search ways in some starts of a task; return the columns of `Examples`."""
    numbers = range(first, min(first + TOGETHER, config.demonstrations))
    place = config.task.index(task), nx
    setup = TaskConfig(task=task, nx=nx, split=config.split, states=config.states)
    setup = replace(setup, observation="state", engine="chain")
    seeds = [Stream.DEMONSTRATION.derived_seed(config.seed, *place, k) for k in numbers]
    batch, ids = EpisodeBatch(setup, len(seeds)), np.arange(len(seeds))
    batch.begin(ids, seeds)
    values = PassValues.of_split(config.split, every_code=True)
    rngs = [Stream.DEMONSTRATION.generator(seed) for seed in seeds]
    states, goals = batch.simulation.states(ids), batch.goals_of(ids)
    prefixes = [
        [Pass.drawn(setup.beads, rng) for _ in range(rng.integers(_RANDOM_PREFIX + 1))]
        for rng in rngs
    ]
    given = zip(states, batch.simulation.points[ids].copy(), goals, prefixes, strict=True)
    # numbered by the order in which they were given, though they end in any order
    search = BatchedSearch(_ROPES)
    plans = dict(search.run(_found(*asked, values) for asked in given))
    # a code that is held out is no goal, wherever passes lead
    elsewhere = 0 if SPLITS[config.split].by_code else _ELSEWHERE
    rows = [
        (first + k, *row)
        for k in sorted(plans)
        for row in _shown(plans[k], goals[k], config.copies, elsewhere, rngs[k])
    ]
    # none where the order of the passes knows no way to any of the goals
    episodes, points, codes, macros, worked = zip(*rows, strict=True) if rows else ((),) * 5
    return _examples(
        np.array(points, dtype=np.float32).reshape(-1, setup.beads, 3),
        codes,
        np.array(macros, dtype=np.int64).reshape(-1, 3),
        np.array(worked, dtype=np.bool_),
        np.array(episodes, dtype=np.int64),
    )._asdict()


def _found(
    state: Array, points: Array, goal: GaussCode, prefix: Sequence[Pass], values: PassValues
) -> Generator[Any, Any, PassPlan]:
    """Search a way from where random passes lead, unless they lead to the goal."""
    for move in prefix:
        landing = yield from BatchedSearch.try_pass(state, move, goal)
        # a start that shows its goal would have nothing to find
        if landing.lost or landing.code.matches(goal):
            break
        state, points = landing.state, landing.points
    return (yield from PassSearch(values, goal, _SEARCH).run(state, points))


def _shown(
    plan: PassPlan, goal: GaussCode, copies: int, elsewhere: int, rng: np.random.Generator
) -> Iterator[Row]:
    """Yield the examples of a search: points, goal, macro-action, and whether it works."""
    beads = len(plan.tried[0].points) if plan.tried else 0
    leading = {id(tried) for tried in plan.passes}
    some = partial(_some, rng=rng)
    for tried in some([tried for tried in plan.tried if _leads_elsewhere(tried, goal)], elsewhere):
        yield _numbered(tried, int(rng.integers(beads)), tried.landing.points)
    # by identity, as two tries of one pass from one state are different examples
    vain = [tried for tried in plan.tried if id(tried) not in leading]
    if not plan.passes:
        yield from ((tried.points, goal, tried.move, False) for tried in some(vain, _IN_VAIN))
        return
    # the rope ends where the goal's code is shown, from whichever bead it is read
    end = plan.passes[-1].landing.points
    for base in (0, *rng.choice(np.arange(1, beads), copies, replace=False).tolist()):
        yield from (_numbered(tried, base, end)[:3] + (True,) for tried in plan.passes)
        yield from (_numbered(tried, base, end) for tried in some(vain, _IN_VAIN))


def _numbered(tried: TriedPass, base: int, end: Array) -> Row:
    """Number the beads of a pass from `base`; its goal is the code of `end`, read from there.

    It works if it leads to that code. From bead 0 a pass in vain doesn't, from another it may.
    """
    count, (bead, target, side) = len(end), tried.move
    before, after = tried.points, tried.landing.points
    start, landed, wanted = (np.roll(points, -base, axis=0) for points in (before, after, end))
    goal = label(wanted).plain
    move = Pass((bead - base) % count, (target - base) % count, side)
    return start, goal, move, label(landed).matches(goal)


def _leads_elsewhere(tried: TriedPass, goal: GaussCode) -> bool:
    code, here = tried.landing.code, label(tried.points)
    known = code.matches(goal) or code.matches(here) or tried.landing.lost
    return not known and code.nx <= _MOST_CROSSINGS


def _some(passes: Sequence[TriedPass], most: int, *, rng: np.random.Generator) -> list[TriedPass]:
    # drawn without replacement, then in the order of the search
    chosen = rng.permutation(len(passes))[:most]
    return [passes[k] for k in np.sort(chosen).tolist()]
