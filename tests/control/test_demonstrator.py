from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidFile, InvalidPolicy
from knotgym.control.demonstrator import Demonstrator
from knotgym.control.macro_lanes import Landing, MacroLanes, Search, Trial
from knotgym.control.old_policies import make_policy
from knotgym.control.pass_counts import (
    EVERY_CODE,
    PASSES,
    DiagramValues,
    PassChoice,
    PassCounts,
    shipped_values,
    template_images,
    templates,
)
from knotgym.control.pass_play import goals_not_held_out
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import rollout
from knotgym.control.seen_diagrams import SeenDiagram, seen_diagram
from knotgym.control.transition_counts import ELEMENTS, ArcCoordinates
from knotgym.datasets.episode_verification import episode_faults
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import Pass
from knotgym.rope.model import Array, Rope
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import codes_of
from knotgym.topology.symmetry import Symmetry, diagram_form

FLAT, KINK = GaussCode(), GaussCode.parse("1+c,1-c")
LOOP, KINKED = SeenDiagram(FLAT, (0,)), SeenDiagram(KINK, (1, 2))
TASK = TaskConfig(task="tie", nx=2, observation="state", engine="chain")
ANGLES = np.linspace(0, 2 * np.pi, 40, endpoint=False)
# a curve of three crossings: two loops, one inside, and a strand over both
CURVE = np.stack(
    [
        np.cos(ANGLES) + 0.9 * np.cos(2 * ANGLES + 0.3),
        np.sin(ANGLES) - 0.8 * np.sin(2 * ANGLES),
        0.1 * np.cos(3 * ANGLES + 0.5),
    ],
    axis=1,
)


def diagram_of(points: Array) -> SeenDiagram:
    return seen_diagram(points, find_crossings(points))


@given(st.booleans(), st.booleans(), st.booleans(), st.floats(0, 6.28))
def test_a_symmetry_of_the_rope_is_the_same_symmetry_of_its_diagram(
    reverse: bool, switch: bool, reflect: bool, turn: float
) -> None:
    moved = Symmetry(reflect=reflect, switch=switch, turn=turn, reverse=reverse)
    image = diagram_of(moved.configuration(CURVE))
    assert image == diagram_of(CURVE).transformed((reverse, switch, reflect))
    assert image.nx >= 2


def limacon(inward: bool) -> Array:
    """A curve with one crossing: a kink inside the loop, or the two lobes of an eight."""
    if inward:
        radius = 1 + 1.8 * np.cos(ANGLES)
        x, y = radius * np.cos(ANGLES), radius * np.sin(ANGLES)
    else:
        x, y = np.sin(2 * ANGLES + 0.1), np.sin(ANGLES + 0.05)
    return np.stack([x, y, 0.1 * np.sin(ANGLES + 1)], axis=1)


def test_a_kink_inside_the_loop_is_told_from_one_outside() -> None:
    inward, eight = diagram_of(limacon(True)), diagram_of(limacon(False))
    assert inward.nx == eight.nx == 1
    assert len(inward.outer) == 1 and len(eight.outer) == 2


def counts() -> PassCounts:
    """Made-up counts: one pass kinks the loop in 6 of 10, another in 9; a third undoes a kink."""
    made = PassCounts()
    for template, kinks in ((4, 6), (7, 9)):
        for k in range(10):
            made.record(LOOP, PassChoice(template, 0), KINKED if k < kinks else None)
    for _ in range(5):
        made.record(KINKED, PassChoice(2, 0), LOOP)
    return made


def test_the_pass_that_succeeds_most_comes_first() -> None:
    values = DiagramValues(counts())
    order = values.order(KINK, LOOP)
    moves = [(choice.template, choice.element) for choice in order]
    best = [template_images(0, element)[template] for template, element in moves]
    assert len(best) == 4 and 7 in best[:2] and 4 in best[2:]  # each with its mirror image
    assert order[0].value == order[1].value > order[2].value > 0
    assert values.reach(KINK, KINKED) == 1.0
    assert values.order(KINK, SeenDiagram(FLAT, (1,)))  # the loop walked the other way
    assert not values.order(GaussCode.parse("1+,1-,2+,2-"), LOOP)


@pytest.mark.parametrize("element", range(len(ELEMENTS)))
def test_images_of_a_state_and_goal_have_the_same_order(element: int) -> None:
    values = shipped_values()
    goal = GaussCode.parse("1+c,1-c,2+a,2-a")
    reverse, switch, reflect = ELEMENTS[element]
    there = goal.reversed() if reverse else goal
    there = there.mirrored() if switch else there
    there = there.reflected() if reflect else there
    first, second = values.order(goal, LOOP), values.order(there, LOOP.image(element))
    assert len(first) > 20
    assert [one.template for one in first] == [one.template for one in second]
    assert values.reach(goal, LOOP) == values.reach(there, LOOP.image(element))


def test_a_template_on_an_image_is_the_image_of_the_pass() -> None:
    crossings = find_crossings(CURVE)
    arcs = ArcCoordinates(crossings, len(CURVE))
    turned = Symmetry(switch=True, reverse=True)
    image = turned.configuration(CURVE)
    other = ArcCoordinates(find_crossings(image), len(image))
    element = ELEMENTS.index((True, True, False))
    for template in templates(crossings.nx)[::37]:
        before = template.on(arcs, 0, crossings.nx, len(CURVE))
        after = template.on(other, element, crossings.nx, len(CURVE))
        wanted = turned.beads(np.array(before[:2]), len(CURVE))
        # rounding to beads may differ by one
        assert (np.abs((wanted - after[:2] + 2) % len(CURVE) - 2) <= 1).all()
        assert after.side == -before.side


def test_counts_survive_a_file_and_a_changed_one_is_refused(tmp_path: Path) -> None:
    path, made = tmp_path / "passes.h5", counts()
    made.save(path)
    assert PassCounts.load(path).seen == made.seen
    with h5py.File(path, "r+") as file:
        file["seen"][0] = 77
    with pytest.raises(InvalidFile, match="SHA-256"):
        PassCounts.load(path)


@pytest.mark.parametrize("path", [*PASSES.values(), EVERY_CODE], ids=lambda path: path.stem)
def test_the_shipped_counts_are_small(path: Path) -> None:
    assert path.stat().st_size < 300_000


@pytest.mark.thorough
def test_counts_towards_every_code_promise_more_where_train_has_no_goal() -> None:
    task = TaskConfig(task="tie", nx=4, split="train", observation="state")
    own_goals = EpisodeBatch(task).side_codes("goal")
    others = [code for code in codes_of(UNKNOT, 4) if code not in own_goals][::12]
    own, every = (
        sum(shipped_values(every_code=every).reach(goal, LOOP) for goal in others)
        for every in (False, True)
    )
    assert every > own
    assert shipped_values("test-code", every_code=True) is shipped_values("test-code")


def test_splits_by_code_have_an_order_of_their_own() -> None:
    assert shipped_values("test") is shipped_values("train")
    assert shipped_values("test-code") is shipped_values("train-code")
    goal = GaussCode.parse("1+c,1-c,2+a,2-a")
    one, other = (shipped_values(split).order(goal, LOOP) for split in ("train", "test-code"))
    assert one and other and one != other


def test_searches_find_the_same_in_any_company() -> None:
    lanes = MacroLanes(3, MacroActionConfig())
    states, _ = lanes.at_rest(lanes.simulation.qpos([0, 1]))

    def search(bead: int) -> Search[Landing]:
        outcome = yield Trial(states[0], Pass(bead, bead + 14, 1), KINK)
        outcome = yield Trial(outcome.state, Pass(70, 50, -1), KINK)
        return outcome

    together = dict(lanes.run(search(bead) for bead in (20, 30, 40, 50)))
    for number, bead in enumerate((20, 30, 40, 50)):
        ((_, alone),) = lanes.run([search(bead)])
        assert np.array_equal(alone.points, together[number].points)


def test_a_pass_that_tows_the_rope_too_far_ends_there() -> None:
    lanes = MacroLanes(1, MacroActionConfig())
    (state,), points = lanes.at_rest(lanes.simulation.qpos([0]))

    def search(limit: float) -> Search[Landing]:
        bound = TowBound.of_episode(points, limit)
        return (yield Trial(state, Pass(20, 70, 1), KINK, bound=bound))

    ((_, whole),) = lanes.run([search(1.0)])
    ((_, short),) = lanes.run([search(0.01)])
    assert not whole.towed and whole.pulls > 1
    assert short.towed and 0 < short.pulls < whole.pulls


def test_the_same_state_gets_the_same_action() -> None:
    policy, episodes = Demonstrator(), EpisodeBatch(TASK, 2)
    for index in range(2):
        episodes.begin(index, np.random.default_rng(3))
        policy.begin(episodes, index, np.random.default_rng(index))
    first = policy.act(episodes, np.array([0, 1]))
    assert first.macros is not None
    assert np.array_equal(first.actions[0], first.actions[1]) and first.macros[0, 0] == 1
    # a look in the middle of an episode is a look at its start
    for _ in range(4):
        episodes.step(policy.act(episodes, np.array([0, 1])).actions, np.array([0, 1]))
    policy.replan(0)
    policy.begin(episodes, 1, np.random.default_rng(9))
    again = policy.act(episodes, np.array([0, 1]))
    assert np.array_equal(again.actions[0], again.actions[1])


def test_a_way_in_the_engine_of_the_episode_leads_to_the_goal() -> None:
    played = rollout(TASK, Demonstrator(), [0, 1, 2, 3], 0)
    assert all(one.success for one in played)
    for one in played:
        episode = one.episode
        assert episode.macro_start is not None and episode.macro_bead is not None
        begun = np.flatnonzero(episode.macro_start)
        assert begun[0] == 1 and np.array_equal(episode.macro_bead[begun], episode.bead[begun])
        assert episode.move is not None
        assert all(str(why).startswith(("choice", "planner")) for why in episode.move[1:])


@pytest.mark.thorough
def test_play_goes_on_to_another_goal_and_its_record_verifies() -> None:
    task = replace(TASK, endless=True, horizon=60)
    (played,) = rollout(task, make_policy(PolicyConfig(policy="play")), [2], 0)
    episode = played.episode
    assert len(episode) == 60 and not episode.terminations.any() and episode.truncations[-1]
    assert episode.move is not None
    sought = [str(move).partition(" to ")[2] for move in episode.move[1:]]
    changes = [step for step in range(1, 60) if sought[step] != sought[step - 1]]
    assert len(changes) >= 2 and "" in sought  # the plain loop, too
    # a goal is left when it is shown
    reached = [episode.gauss_code[step] == sought[step - 1] for step in changes]
    assert sum(reached) >= len(changes) - 1
    assert played.success and (episode.rewards == 5.0 * episode.is_success[1:]).all()
    assert episode_faults(episode, task, Rope(task.rope)) == []
    assert episode_faults(episode, replace(task, endless=False), Rope(task.rope))


def test_play_in_a_task_that_ends_at_the_goal_is_refused() -> None:
    with pytest.raises(InvalidPolicy, match="must be endless; give --endless"):
        rollout(TASK, make_policy(PolicyConfig(policy="play")), [0], 0)


@pytest.mark.parametrize("split", ["train", "train-code"])
def test_with_every_code_no_held_out_goal_is_demonstrated(split: str) -> None:
    train, test = (
        TaskConfig(task="tie", nx=4, split=own, observation="state")
        for own in (split, split.replace("train", "test"))
    )
    goals = goals_not_held_out(train)
    own, held_out = (EpisodeBatch(one).side_codes("goal") for one in (train, test))
    assert goals[: len(own)] == own
    added = {*goals[len(own) :]}
    assert len(added) == len(goals) - len(own) > 200
    images = {one for code in held_out for one in (code, code.reversed())}
    assert not added & {*images, *(one.mirrored() for one in images)}
    if split == "train-code":
        assert not {*map(diagram_form, added)} & {*map(diagram_form, held_out)}
