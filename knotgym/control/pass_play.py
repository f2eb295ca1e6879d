"""Play that counts what passes do: towards goals, with passes tried in proportion to their promise.

Starts and goals are those of a task's split, so nothing is learned from held-out states. An episode
is a search of `MacroLanes`: a thousand run side by side.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import Count, NonNegative, Share, configuration
from knotgym.common.streams import Stream, generator
from knotgym.control.macro_lanes import Landing, Search, Trial
from knotgym.control.pass_counts import COUNTED_NX, DiagramValues, PassChoice, PassCounts, templates
from knotgym.control.seen_diagrams import SeenDiagram, canonical_image, seen_diagram
from knotgym.control.transition_counts import ArcCoordinates
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.rope.macro_actions import LONGEST
from knotgym.rope.model import Array
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import codes_of
from knotgym.topology.symmetry import diagram_form


@configuration
class PassPlayConfig:
    """Settings of play.

    Attributes:
        passes: of an episode, at most.
        steps: actions of an episode, at most.
        explored: share of passes drawn among all, however little they promise.
        greedy: share of episodes in which every pass is the most promising.
        bonus: added to the value of a pass that was never tried; it falls with the square root of
            the number of tries.
    """

    passes: Count = 14
    steps: Count = 50
    explored: Share = 0.25
    greedy: Share = 0.3
    bonus: NonNegative = 0.15


class Starts(NamedTuple):
    """Where episodes of a task begin, and the goals that it has.

    Attributes:
        states: of the chain engine, at rest, float64 (n, states).
        points: float64 (n, beads, 3), metres.
        codes: n codes with chirality.
        goals: the distinct codes of the split's goals, without chirality.
    """

    states: Array
    points: Array
    codes: list[GaussCode]
    goals: list[GaussCode]

    def draw(self, rng: np.random.Generator) -> tuple[int, GaussCode]:
        """Draw a start and a goal that it doesn't show."""
        row = int(rng.integers(len(self.codes)))
        goals = [goal for goal in self.goals if not self.codes[row].matches(goal)]
        return row, goals[int(rng.integers(len(goals)))]


def draw_starts(task: TaskConfig, count: int, rng: np.random.Generator) -> Starts:
    """Reset a task `count` times."""
    episodes = EpisodeBatch(task)
    qpos, codes = [], []
    for _ in range(count):
        episodes.begin(0, rng)
        qpos.append(episodes.simulation.qpos([0])[0])
        codes.append(episodes.codes[0])
    simulation = ChainSimulation(count)
    simulation.lay(np.array(qpos))
    return Starts(simulation.states(), simulation.points.copy(), codes, episodes.side_codes("goal"))


def goals_not_held_out(task: TaskConfig) -> list[GaussCode]:
    """Return the split's goals, and the unknot's other codes that aren't held out.

    Held out are the codes of test goals and their images (reversed, crossings switched), which look
    the same in a canonical frame; in the split by code, all codes of their diagrams.
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


class PassPlay:
    """Plays episodes and counts their passes.

    Attributes:
        counts: what passes did so far.
        values: of the counts when `learn` was last called.
    """

    def __init__(self, counts: PassCounts, config: PassPlayConfig) -> None:
        self.counts, self._config = counts, config
        self.learn()

    def learn(self) -> None:
        """Take the counts so far into the values."""
        self.values = DiagramValues(self.counts)
        self._tried: dict[SeenDiagram, NDArray[np.int64]] = {}
        tried = Counter[tuple[SeenDiagram, int]]()
        for (before, template, _), count in self.counts.seen.items():
            tried[before, template] += count
        for (before, template), count in tried.items():
            self._of(before)[template] = count

    def episode(
        self, start: Array, points: Array, goal: GaussCode, rng: np.random.Generator
    ) -> Search[bool]:
        """Play an episode; return whether it reached the goal."""
        state, left = start, self._config.steps
        greedy = rng.random() < self._config.greedy
        for _ in range(self._config.passes):
            crossings = find_crossings(points)
            diagram = seen_diagram(points, crossings)
            if diagram.nx > COUNTED_NX:
                return False
            choice = self._choose(goal, diagram, rng, greedy)
            arcs = ArcCoordinates(crossings, len(points))
            template = templates(diagram.nx)[choice.template]
            move = template.on(arcs, choice.element, diagram.nx, len(points))
            outcome: Landing = yield Trial(state, move, goal, min(LONGEST, left))
            after = None
            if outcome.code != diagram.code and outcome.code.nx <= COUNTED_NX:
                after = seen_diagram(outcome.points, find_crossings(outcome.points))
            self.counts.record(diagram, choice, after)
            self._of(diagram.image(choice.element))[choice.template] += 1
            if outcome.code.matches(goal):
                return True
            left -= max(1, outcome.pulls)
            if left <= 0:
                return False
            state, points = outcome.state, outcome.points
        return False

    def _choose(
        self, goal: GaussCode, diagram: SeenDiagram, rng: np.random.Generator, greedy: bool
    ) -> PassChoice:
        order = self.values.order(goal, diagram)
        if order and greedy:
            return order[0]
        if not order or rng.random() < self._config.explored:
            # any pass; among two drawn, the one tried less often
            element = order[0].element if order else canonical_image(diagram)[1]
            drawn = rng.integers(len(templates(diagram.nx)), size=2).tolist()
            tried = self._of(diagram.image(element))
            return PassChoice(min(drawn, key=lambda k: int(tried[k])), element)
        tried = self._of(diagram.image(order[0].element))
        numbers = np.array([choice.template for choice in order])
        promise = np.array([choice.value for choice in order])
        promise += self._config.bonus / np.sqrt(tried[numbers] + 1)
        return order[int(np.argmax(promise))]

    def _of(self, first: SeenDiagram) -> NDArray[np.int64]:
        if first not in self._tried:
            self._tried[first] = np.zeros(len(templates(first.nx)), dtype=np.int64)
        return self._tried[first]


def searches(
    play: PassPlay, starts: list[Starts], count: int, seed: int, round: int
) -> Iterator[Search[bool]]:
    """Yield the episodes of a round; each draws from a stream of its own."""
    for number in range(count):
        rng = generator(Stream.PASS_PLAY, seed, round, number)
        of = starts[number % len(starts)]
        row, goal = of.draw(rng)
        yield play.episode(of.states[row], of.points[row], goal, rng)
