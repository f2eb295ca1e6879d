"""Demonstrations for the clone, made in the chain engine: a hundred times as fast as episodes.

A demonstration is a way that the demonstrator finds from a start to a goal, with the rope at rest
before every pass. Most begin after passes that were not tried out before: random ones, or some of
the demonstrator's first choices. So the clone also sees states that a demonstrator doesn't lead to,
above all those in which its own mistakes end.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from knotgym.common.streams import Stream, generator
from knotgym.control.demonstrator import (
    Decision,
    DemonstratorConfig,
    find_way,
    passes_in_order,
    random_pass,
)
from knotgym.control.macro_lanes import Landing, MacroLanes, Search, Trial
from knotgym.control.pass_counts import DiagramValues, shipped_values
from knotgym.control.pass_play import Starts, draw_starts
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.clone_config import CloneConfig, DemonstrationsConfig
from knotgym.learn.clone_data import DecidedStep, Decisions, gathered, join, none
from knotgym.rope.model import Array
from knotgym.runs.progress import Progress, Status
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import codes_of
from knotgym.topology.symmetry import diagram_form

# a goal and the way to it: empty if none was found, None if the passes before led there already
_Found = tuple[GaussCode, list[Decision] | None]

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
    config = clone.demonstrations
    values = shipped_values(config.split, every_code=config.every_code)
    demonstrator = DemonstratorConfig(budget=config.budget)
    lanes = MacroLanes(config.lanes, demonstrator.macro_actions)
    parts, rates = [none()], dict[str, Any]()
    tasks, done = demonstrated_tasks(config), 0

    def status() -> Status:
        return Status(done, config.episodes * len(tasks), "demonstrations")

    for place, task in enumerate(tasks):
        rng = generator(Stream.DEMONSTRATION_STARTS, clone.seed, place)
        starts = draw_starts(task, config.starts, rng)
        if config.every_code:
            starts = starts._replace(goals=goals_not_held_out(task))
        ways = dict[int, _Found]()
        searches = _searches(values, starts, demonstrator, clone, place)
        for episode, found in lanes.run(searches):
            ways[episode], done = found, done + 1
            progress.show(status)
        for episode, (goal, way) in sorted(ways.items()):
            steps = [_step(decision) for decision in way or []]
            parts.append(gathered(steps, steps, goal, number + episode, clone))
        number += config.episodes
        searched = [way for _, way in ways.values() if way is not None]
        ranks = np.array([decision.rank for way in searched for decision in way])
        rates[f"{task.task} {task.nx}"] = {
            "reached": float(np.mean([bool(way) for way in searched])),
            "decisions": len(ranks),
            "first_choices": float(np.mean(ranks == 1)) if len(ranks) else None,
        }
    progress.show(status, last=True)
    return join(parts), rates


def goals_not_held_out(task: TaskConfig) -> list[GaussCode]:
    """Return the split's goals, and the unknot's other codes that aren't held out.

    Held out are the codes of test goals and their images (reversed, crossings switched), which look
    the same to the clone; in the split by code, all codes of their diagrams.
    """
    own, test = (
        EpisodeBatch(replace(task, split=split)).side_codes("goal")
        for split in (task.split, task.split.replace("train", "test"))
    )
    form = diagram_form if task.split == "train-code" else _least_image
    held_out = {form(code) for code in test}
    every = codes_of(UNKNOT, task.nx) if task.task != "unknot" else ()
    return own + [code for code in every if code not in own and form(code) not in held_out]


def _least_image(code: GaussCode) -> GaussCode:
    walked = code.plain, code.plain.reversed()
    return min((*walked, *(one.mirrored() for one in walked)), key=lambda one: one.visits)


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
        yield _way(values, goal, demonstrator, starts.states[row], starts.points[row], wander, rng)


def _way(
    values: DiagramValues,
    goal: GaussCode,
    config: DemonstratorConfig,
    state: Array,
    points: Array,
    wander: int,
    rng: np.random.Generator,
) -> Search[_Found]:
    """Find a way after some passes that weren't tried out."""
    for _ in range(wander):
        move, in_order = random_pass(len(points), rng), rng.random() < _IN_ORDER
        if in_order and (first := [*islice(passes_in_order(values, goal, points), _FIRST)]):
            move, _ = first[int(rng.integers(len(first)))]
        landing: Landing = yield Trial(state, move, goal)
        state, points = landing.state, landing.points
        if landing.code.matches(goal):
            return goal, None
    way, _ = yield from find_way(values, goal, config, state, points)
    return goal, way


def _step(decision: Decision) -> DecidedStep:
    points, landed = (one.astype(np.float32) for one in (decision.points, decision.landing.points))
    codes = decision.code, decision.landing.code
    return DecidedStep(points, landed, *codes, decision.move, decision.missed)
