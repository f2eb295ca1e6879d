"""Demonstrations for the clone, made in the chain engine: a hundred times as fast as episodes.

A demonstration is a way that the demonstrator finds from a start to a goal, with the rope at rest
before every pass. Most begin after passes that were not tried out before: random ones, some of the
demonstrator's first choices, or those of an earlier clone (DAgger: Ross et al., 2011). So the clone
also sees states that a demonstrator doesn't lead to, above all those in which its own mistakes end.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knotgym.common.streams import Stream, generator
from knotgym.control.demonstrator import (
    DemonstratorConfig,
    FoundWay,
    Tried,
    find_way,
    passes_in_order,
    random_pass,
)
from knotgym.control.macro_lanes import Landing, MacroLanes, Search, Trial
from knotgym.control.pass_counts import DiagramValues, shipped_values
from knotgym.control.pass_play import Starts, draw_starts, goals_not_held_out
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.clone_config import CloneConfig, DemonstrationsConfig
from knotgym.learn.clone_data import (
    NO_MACRO,
    DecidedStep,
    Decisions,
    Macro,
    gathered,
    join,
    load_decisions,
    none,
    save_decisions,
)
from knotgym.learn.clone_network import CloneNetwork
from knotgym.learn.clone_policy import choose_macros, load_clone
from knotgym.rope.engines import CHAIN
from knotgym.rope.macro_actions import Pass
from knotgym.rope.model import Array
from knotgym.runs.compilation import compile_first
from knotgym.runs.executors import executor
from knotgym.runs.progress import Progress, Status
from knotgym.topology.gauss import GaussCode

# a goal and what a look for it found; None if the passes before led there already
_Sought = tuple[GaussCode, FoundWay | None]

_TOGETHER = 1000  # demonstrations of a part, which is one worker's work and one file
_IN_ORDER, _FIRST = 0.6, 3  # share of the passes before that are among the first of the order


def demonstrated_tasks(config: DemonstrationsConfig) -> list[TaskConfig]:
    """Return the tasks that are demonstrated."""
    if not config.episodes:
        return []
    return [
        TaskConfig(task=task, nx=nx, split=config.split, observation="state", engine="chain")
        for task in config.task
        for nx in config.nx
    ]


class Part(NamedTuple):
    """Demonstrations of one task, that are made together.

    Attributes:
        clone: settings.
        place: of the task among `demonstrated_tasks`.
        first: number of the first of them among those of the task.
        episodes: number of demonstrations.
        before: number of episodes before those of the task.
    """

    clone: CloneConfig
    place: int
    first: int
    episodes: int
    before: int

    @property
    def task(self) -> TaskConfig:
        """What is demonstrated."""
        return demonstrated_tasks(self.clone.demonstrations)[self.place]


def demonstrations(
    clone: CloneConfig, before: int, folder: Path, workers: int, progress: Progress
) -> tuple[Decisions, dict[str, Any]]:
    """Make the demonstrations that a training asks for; parts that a folder holds are kept.

    Args:
        clone: says which, and what is learned from them.
        before: number of the first episode.
        folder: for the parts; a later call makes those that are missing.
        workers: processes, 0 for one per core.
        progress: where to show progress.

    Returns:
        Their decisions; and for the card, of each task the share of demonstrations that reached
        their goal, and the share of decisions for the first pass of the fixed order.
    """
    parts = _parts(clone, before)
    paths = [folder / f"demonstrations-{number}.safetensors" for number in range(len(parts))]
    missing = [both for both in zip(paths, parts, strict=True) if not both[0].exists()]
    total = sum(part.episodes for part in parts)
    done = total - sum(part.episodes for _, part in missing)
    if missing:
        compile_first(progress, CHAIN, workers)
        progress.stage("making demonstrations in the chain engine")
        with executor(workers) as pool:
            made = pool.map(_demonstrate, [part for _, part in missing])
            for (path, part), own in zip(missing, made, strict=True):
                save_decisions(path, *own)
                done += part.episodes
                progress.show(partial(Status, done, total, "demonstrations"))
    gained, counts = [none()], dict[str, Counter[str]]()
    for path, part in zip(paths, parts, strict=True):
        own = load_decisions(path)
        gained.append(own[0])
        counts.setdefault(f"{part.task.task} {part.task.nx}", Counter()).update(own[1])
    decisions = join(gained)
    rates = {
        task: {
            "reached": own["reached"] / max(1, own["searched"]),
            "decisions": int(own["decisions"]),
            "first_choices": own["first_choices"] / max(1, own["decisions"]),
        }
        for task, own in counts.items()
    }
    facts = {"demonstrations": rates, "demonstrations_sha256": decisions.digest} if parts else {}
    return decisions, facts


def _parts(clone: CloneConfig, before: int) -> list[Part]:
    """Divide demonstrations into parts; `before` episodes have numbers already."""
    count = clone.demonstrations.episodes
    return [
        Part(clone, place, first, min(_TOGETHER, count - first), before + place * count)
        for place in range(len(demonstrated_tasks(clone.demonstrations)))
        for first in range(0, count, _TOGETHER)
    ]


def _demonstrate(part: Part) -> tuple[Decisions, dict[str, float]]:
    """Make demonstrations; return their decisions and counts for the rates."""
    clone, config = part.clone, part.clone.demonstrations
    values = shipped_values(config.split, every_code=config.every_code)
    demonstrator = DemonstratorConfig(budget=config.budget)
    lanes = MacroLanes(config.lanes, demonstrator.macro_actions)
    searches = _searches(values, _starts(clone, part.place), demonstrator, part)
    gained = [none()]
    ways = [way for _, way in sorted(lanes.run(searches), key=lambda one: one[0])]
    for episode, (goal, found) in enumerate(ways, part.before + part.first):
        if found is not None:
            steps, ends = _steps(found)
            gained.append(gathered(steps, steps, goal, episode, clone, ends))
    searched = [found.way for _, found in ways if found is not None]
    ranks = [decision.rank for way in searched for decision in way]
    counts = {
        "searched": float(len(searched)),
        "reached": float(sum(bool(way) for way in searched)),
        "decisions": float(len(ranks)),
        "first_choices": float(ranks.count(1)),
    }
    return join(gained), counts


@lru_cache(maxsize=1)
def _starts(clone: CloneConfig, place: int) -> Starts:
    """Return where the demonstrations of a task begin; a worker makes several parts of a task."""
    task = demonstrated_tasks(clone.demonstrations)[place]
    rng = generator(Stream.DEMONSTRATION_STARTS, clone.seed, place)
    starts = draw_starts(task, clone.demonstrations.starts, rng)
    if clone.demonstrations.every_code:
        starts = starts._replace(goals=goals_not_held_out(task))
    return starts


def _searches(
    values: DiagramValues,
    starts: Starts,
    demonstrator: DemonstratorConfig,
    part: Part,
) -> Iterator[Search[_Sought]]:
    config = part.clone.demonstrations
    for episode in range(part.first, part.first + part.episodes):
        rng = generator(Stream.DEMONSTRATION, part.clone.seed, part.place, episode)
        row, goal = starts.draw(rng)
        before = [partial(_untried, values, goal, rng=rng)] * int(rng.integers(config.wander + 1))
        if config.led:
            choose = partial(_clone_choice, part.clone, goal, rng=rng)
            before += [choose] * int(rng.integers(config.led + 1))
        state, points = starts.states[row], starts.points[row]
        yield _way(values, goal, demonstrator, state, points, before)


def _untried(
    values: DiagramValues, goal: GaussCode, points: Array, rng: np.random.Generator
) -> Pass:
    """Choose a random pass, or one of the first in the order."""
    move, in_order = random_pass(len(points), rng), rng.random() < _IN_ORDER
    if in_order and (first := [*islice(passes_in_order(values, goal, points), _FIRST)]):
        move, _ = first[int(rng.integers(len(first)))]
    return move


def _clone_choice(
    clone: CloneConfig, goal: GaussCode, points: Array, rng: np.random.Generator
) -> Pass:
    """Choose a pass as the clone given by `start` would in play."""
    values = shipped_values(clone.demonstrations.split, every_code=True) if clone.guided else None
    heat = np.array([clone.play.temperature])
    (macro,) = choose_macros(_start(clone), points[None], [goal], heat, [rng], values)
    bead, target, side = macro.tolist()
    return Pass(bead, target, 2 * side - 1)


@lru_cache(maxsize=1)
def _start(clone: CloneConfig) -> CloneNetwork:
    """Load the network that training goes on from; once in each worker."""
    return load_clone(Path(clone.start)).network


def _way(
    values: DiagramValues,
    goal: GaussCode,
    config: DemonstratorConfig,
    state: Array,
    points: Array,
    before: Sequence[Callable[[Array], Pass]],
) -> Search[_Sought]:
    """Find a way after some passes that weren't tried out."""
    for choose in before:
        landing: Landing = yield Trial(state, choose(points), goal)
        state, points = landing.state, landing.points
        if landing.code.matches(goal):
            return goal, None
    found = yield from find_way(values, goal, config, state, points)
    return goal, found


def _steps(found: FoundWay) -> tuple[list[DecidedStep], list[DecidedStep]]:
    """Return the steps on the way that was found, and the states of dead ends.

    What was tried in vain stands with each: at a state of the way, what came before its pass; at
    others everything.
    """
    tried: dict[int, list[Tried]] = {}
    for one in found.tried:
        tried.setdefault(id(one.points), []).append(one)
    way = list[DecidedStep]()
    for points, code, move, _, landing in found.way:
        *missed, _ = tried.pop(id(points))
        way.append(_step(points, landing.points, code, landing.code, move, missed))
    nowhere = GaussCode()  # where steps that aren't imitated led doesn't matter
    dead = [
        _step(own[0].points, own[0].points, nowhere, nowhere, NO_MACRO, own)
        for own in tried.values()
    ]
    return way, dead


def _step(
    points: Array,
    landed: Array,
    before: GaussCode,
    after: GaussCode,
    macro: Macro,
    missed: list[Tried],
) -> DecidedStep:
    single = points.astype(np.float32), landed.astype(np.float32)
    return DecidedStep(*single, before, after, macro, tuple(one.move for one in missed))
