"""Demonstrations for the clone, made in the chain engine: a hundred times as fast as episodes.

A demonstration is a way that the demonstrator finds from a start to a goal, with the rope at rest
before every pass. Most begin after passes that were not tried out before: random ones, or some of
the demonstrator's first choices. So the clone also sees states that a demonstrator doesn't lead to,
above all those in which its own mistakes end.

Most passes that a search tries lead nowhere, but many of them are right for another goal. The table
of passes knows which: a pass that made a goal much likelier to be reached is learned as a choice
for that goal.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.streams import Stream, generator
from knotgym.control.demonstrator import (
    Decision,
    DemonstratorConfig,
    find_way,
    passes_in_order,
    random_pass,
)
from knotgym.control.macro_lanes import Landing, MacroLanes, Search, Trial
from knotgym.control.pass_counts import COUNTED_NX, DiagramValues, shipped_values
from knotgym.control.pass_play import Starts, draw_starts
from knotgym.control.seen_diagrams import SeenDiagram, seen_diagram
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.clone_config import CloneConfig, DemonstrationsConfig
from knotgym.learn.clone_data import DecidedStep, Decisions, as_if_asked, gathered, join, none
from knotgym.rope.model import Array
from knotgym.runs.progress import Progress, Status
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import images

# a goal and the way to it: empty if none was found, None if the passes before led there already
# and all passes tried
_Found = tuple[GaussCode, list[Decision] | None, list[DecidedStep]]

_LIKELIER = 1.5  # times as likely as before a goal must be after a pass that counts as right for it
_TOLD, _FIRST = 0.6, 3  # share of the passes before that are among the first of the order


def demonstrated_tasks(config: DemonstrationsConfig) -> list[TaskConfig]:
    """Return the tasks that are demonstrated."""
    if not config.episodes:
        return []
    return [
        TaskConfig(task=task, nx=nx, split=config.split, observation="state", engine="chain")
        for task in config.task
        for nx in config.nx
    ]


def demonstrate(
    clone: CloneConfig, number: int, progress: Progress
) -> tuple[Decisions, dict[str, Any]]:
    """Make demonstrations of each task.

    Args:
        clone: says which, and what is learned from them.
        number: of the first episode.
        progress: where to show progress.

    Returns:
        Their decisions; and for each task the share of demonstrations that reached their goal, and
        the share of decisions for the first pass of the fixed order.
    """
    config, values = clone.demonstrations, shipped_values(clone.demonstrations.split)
    demonstrator = DemonstratorConfig(budget=config.budget)
    lanes = MacroLanes(config.lanes, demonstrator.macro_actions)
    parts, told = [none()], dict[str, Any]()
    tasks, done = demonstrated_tasks(config), 0
    drawn_starts = [
        draw_starts(task, config.starts, generator(Stream.DEMONSTRATION_STARTS, clone.seed, place))
        for place, task in enumerate(tasks)
    ]
    other_goals = OtherGoals(values, [goal for starts in drawn_starts for goal in starts.goals])

    def status() -> Status:
        return Status(done, config.episodes * len(tasks), "demonstrations")

    for place, (task, starts) in enumerate(zip(tasks, drawn_starts, strict=True)):
        ways = dict[int, _Found]()
        searches = _searches(values, starts, demonstrator, clone, place)
        for episode, found in lanes.run(searches):
            ways[episode], done = found, done + 1
            progress.show(status)
        for episode, (goal, way, tries) in sorted(ways.items()):
            steps = [_step(decision) for decision in way or []]
            # the codes on a way are other goals, too
            reached = [] if config.others else steps
            parts.append(gathered(reached, steps, goal, number + episode, clone))
            if config.others:
                rng = generator(Stream.DEMONSTRATION_GOALS, clone.seed, place, episode)
                parts.append(as_if_asked(other_goals.draw(tries, rng), number + episode))
        number += config.episodes
        asked = [way for _, way, _ in ways.values() if way is not None]
        ranks = np.array([decision.rank for way in asked for decision in way])
        told[f"{task.task} {task.nx}"] = {
            "reached": float(np.mean([bool(way) for way in asked])),
            "decisions": len(ranks),
            "first_choices": float(np.mean(ranks == 1)) if len(ranks) else None,
        }
    progress.show(status, last=True)
    return join(parts), told


def _searches(
    values: DiagramValues,
    starts: Starts,
    demonstrator: DemonstratorConfig,
    clone: CloneConfig,
    place: int,
) -> Iterator[Search[_Found]]:
    for episode in range(clone.demonstrations.episodes):
        rng = generator(Stream.DEMONSTRATION, clone.seed, place, episode)
        row, goal = starts.draw(rng)
        wander = int(rng.integers(clone.demonstrations.wander + 1))
        start = starts.states[row], starts.points[row]
        way = _way(values, goal, demonstrator, *start, wander, rng)
        yield _with_tries(goal, way, *start)


def _with_tries(
    goal: GaussCode, search: Search[list[Decision] | None], state: Array, points: Array
) -> Search[_Found]:
    """Run a search from a state; return its goal, what it finds, and all passes that it tries."""
    tries = list[DecidedStep]()
    # states by identity: all that are tried from were landed in before
    known = {id(state): (state, points, label(points))}
    try:
        trial = next(search)
        while True:
            landing: Landing = yield trial
            _, before, code = known[id(trial.state)]
            tries.append(
                DecidedStep(
                    before.astype(np.float32),
                    landing.points.astype(np.float32),
                    code,
                    landing.code,
                    trial.move,
                )
            )
            known[id(landing.state)] = landing.state, landing.points, landing.code
            trial = search.send(landing)
    except StopIteration as stop:
        return goal, stop.value, tries


class OtherGoals:
    """Finds goals for which a pass was right, whatever it was tried for."""

    def __init__(self, values: DiagramValues, goals: list[GaussCode]) -> None:
        """Take goals; their codes from any base bead, walked either way or mirrored, are others."""
        self._values = values
        codes = dict[GaussCode, None]()
        for goal in goals:
            for visit in range(max(1, 2 * goal.nx)):
                codes |= dict.fromkeys(one.plain for one in images(goal.plain.rebased(visit)))
        self._goals = sorted(codes, key=lambda code: code.visits)
        self._reached: dict[SeenDiagram, NDArray[np.float64]] = {}

    def draw(
        self, tries: list[DecidedStep], rng: np.random.Generator
    ) -> list[tuple[DecidedStep, GaussCode]]:
        """Return the passes that are right for some goal, each with one such goal."""
        drawn = list[tuple[DecidedStep, GaussCode]]()
        for step in tries:
            if step.before == step.after or max(step.before.nx, step.after.nx) > COUNTED_NX:
                continue
            before, after = self._chances(step.points), self._chances(step.landed)
            right = np.flatnonzero((before > 0) & (after > _LIKELIER * before))
            if len(right):
                drawn.append((step, self._goals[int(rng.choice(right))]))
        return drawn

    def _chances(self, points: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the chance to reach each goal from a rope."""
        rope = points.astype(np.float64)
        diagram = seen_diagram(rope, find_crossings(rope))
        if diagram not in self._reached:
            chances = [self._values.reach(goal, diagram) for goal in self._goals]
            self._reached[diagram] = np.array(chances)
        return self._reached[diagram]


def _way(
    values: DiagramValues,
    goal: GaussCode,
    config: DemonstratorConfig,
    state: Array,
    points: Array,
    wander: int,
    rng: np.random.Generator,
) -> Search[list[Decision] | None]:
    """Find a way after some passes that weren't tried out."""
    for _ in range(wander):
        move, told = random_pass(len(points), rng), rng.random() < _TOLD
        if told and (first := [*islice(passes_in_order(values, goal, points), _FIRST)]):
            move = first[int(rng.integers(len(first)))]
        landing: Landing = yield Trial(state, move, goal)
        state, points = landing.state, landing.points
        if landing.code.matches(goal):
            return None
    way, _ = yield from find_way(values, goal, config, state, points)
    return way


def _step(decision: Decision) -> DecidedStep:
    points, landed = (one.astype(np.float32) for one in (decision.points, decision.landing.points))
    codes = decision.code, decision.landing.code
    return DecidedStep(points, landed, *codes, decision.move, decision.missed)
