import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common import Array
from knotgym.control.planning.batched_search import BatchedSearch
from knotgym.control.planning.moves import AT, Moves, PassTemplate
from knotgym.control.planning.passes import ActOut, PassPlan, PassSearch, PassValues
from knotgym.control.planning.pulls import _guide_to
from knotgym.control.planning.sights import IMAGES, Diagram, Sight
from knotgym.control.policy_config import PassPlannerConfig
from knotgym.rope import Pass
from knotgym.topology import GaussCode, Symmetry, images

FLAT, KINK = GaussCode(), GaussCode.parse("1+c,1-c")
LOOP, KINKED = Diagram(FLAT, (0,)), Diagram(KINK, (1, 2))
GOAL = GaussCode.parse("1+c,1-c,2+a,2-a")
KINKED_TWICE = GaussCode.parse("1+,1-,2+,2-")
NOTHING = PassValues(Moves())
THREE = GaussCode.parse("1+c,1-c,2+a,2-a,3+c,3-c")
ANGLES = np.linspace(0, 2 * np.pi, 40, endpoint=False)
SELDOM, OFTEN = PassTemplate(AT, 20, 80, 1), PassTemplate(AT, 40, 80, 1)


@pytest.fixture(scope="session")
def curve() -> Array:
    """A curve of three crossings: two loops, one inside, and a strand over both."""
    return np.stack(
        [
            np.cos(ANGLES) + 0.9 * np.cos(2 * ANGLES + 0.3),
            np.sin(ANGLES) - 0.8 * np.sin(2 * ANGLES),
            0.1 * np.cos(3 * ANGLES + 0.5),
        ],
        axis=1,
    )


def made_up() -> PassValues:
    """One pass kinks the loop in 6 of 10, another in 9; a third undoes a kink."""
    (loop, k), (kinked, j) = LOOP.canonical(), KINKED.canonical()
    counted = [
        (loop, SELDOM, KINKED.image(k), 6, 10),
        (loop, OFTEN, KINKED.image(k), 9, 10),
        (kinked, PassTemplate(AT, 230, 80, 1), LOOP.image(j), 5, 5),
    ]
    numbers, rows = dict[PassTemplate, int](), dict[tuple[Diagram, int, Diagram], tuple[int, int]]()
    for before, template, after, seen, tried in counted:
        for image in range(IMAGES):
            if before.image(image) == before:  # then its image is as likely
                own = template.image(image, before.nx)
                key = before, numbers.setdefault(own, len(numbers)), after.image(image)
                rows[key] = seen, tried
    return PassValues(Moves([(*key, *counts) for key, counts in rows.items()], [*numbers]))


def test_the_pass_that_succeeds_most_comes_first() -> None:
    values = made_up()
    order = list(values.order(KINK, LOOP))
    best = [values.moves.templates[number].image(image, 0) for number, image, _ in order]
    assert len(best) == 4 and OFTEN in best[:2] and SELDOM in best[2:]  # each with its mirror image
    assert order[0][2] == order[1][2] > order[2][2] > 0
    assert values.reach(KINK, KINKED) == 1.0
    assert list(values.order(KINK, Diagram(FLAT, (1,))))  # the loop walked the other way
    assert not list(values.order(GaussCode.parse("1+,1-,2+,2-"), LOOP))


@pytest.mark.parametrize("image", range(IMAGES))
def test_images_of_a_state_and_goal_have_the_same_order(image: int) -> None:
    values, there = PassValues.of_split(), images(GOAL)[image]
    first = [one[0] for one in values.order(GOAL, LOOP)]
    assert len(first) > 20
    assert first == [one[0] for one in values.order(there, LOOP.image(image))]
    assert values.reach(GOAL, LOOP) == values.reach(there, LOOP.image(image))


def test_a_pass_that_lands_elsewhere_in_the_engine_that_counts_is_not_taken() -> None:
    desk = BatchedSearch(1)
    state, points = desk.ropes.states()[0], desk.ropes.points[0].copy()
    refused = list[Pass]()

    def act_out(move: Pass) -> tuple[Array, int]:
        refused.append(move)  # the rope stays as it was
        return points, 7

    def found(act_out: ActOut | None) -> PassPlan:
        search = PassSearch(PassValues.of_split(), GOAL, PassPlannerConfig(), act_out=act_out)
        ((_, plan),) = desk.run([search.run(state, points)])
        return plan

    first, none = found(None), found(act_out)
    assert first.passes[0].move == refused[0] and not none.passes
    assert none.spent == sum(one.landing.pulls for one in none.tried) + 7 * len(refused)


def test_a_template_on_an_image_is_the_image_of_the_pass(curve: Array) -> None:
    turned = Symmetry(switch=True, reverse=True)
    here, there = Sight.of(np.array([curve, turned.vertices(curve)]))
    most = 100 * (2 * here.diagram.nx + 1)
    every = [
        one for one in PassValues.of_split().moves.templates if max(one.bead, one.target) < most
    ]
    for template in every[::37]:
        before, after = template.on(here, 0), template.on(there, 0b110)
        wanted = turned.beads(np.array(before[:2]), len(curve))
        # rounding to beads may differ by one
        assert (np.abs((wanted - after[:2] + 2) % len(curve) - 2) <= 1).all()
        assert after.side == -before.side


def test_splits_by_code_have_an_order_of_their_own() -> None:
    assert PassValues.of_split("test") is PassValues.of_split("train")
    assert PassValues.of_split("test-code") is PassValues.of_split("train-code")
    assert PassValues.of_split("test-code", every_code=True) is PassValues.of_split("test-code")
    one, other = (
        list(PassValues.of_split(split).order(GOAL, LOOP)) for split in ("train", "test-code")
    )
    assert one and other and one != other
    every = PassValues.of_split("train", every_code=True)
    assert every.reach(GaussCode.parse("1+,1-,2+,2-,3+,4-,4+,3-"), LOOP) > 0.01


# sights of ropes


def diagram_of(points: Array) -> Diagram:
    return Sight.of(points[None])[0].diagram


@given(reverse=st.booleans(), switch=st.booleans(), reflect=st.booleans(), turn=st.floats(0, 6.28))
def test_a_symmetry_of_the_rope_is_the_same_symmetry_of_its_diagram(
    curve: Array, reverse: bool, switch: bool, reflect: bool, turn: float
) -> None:
    moved = Symmetry(reflect=reflect, switch=switch, turn=turn, reverse=reverse)
    image = diagram_of(moved.vertices(curve))
    assert image == diagram_of(curve).image(4 * reverse + 2 * switch + reflect)
    assert image.nx >= 2
    assert image.canonical()[0] == diagram_of(curve).canonical()[0]


def test_a_kink_inside_the_loop_is_told_from_one_outside() -> None:
    radius, height = 1 + 1.8 * np.cos(ANGLES), 0.1 * np.sin(ANGLES + 1)
    inside = np.stack([radius * np.cos(ANGLES), radius * np.sin(ANGLES), height], axis=1)
    eight = np.stack([np.sin(2 * ANGLES + 0.1), np.sin(ANGLES + 0.05), height], axis=1)
    one, other = diagram_of(inside), diagram_of(eight)
    assert one.nx == other.nx == 1
    assert len(one.outer) == 1 and len(other.outer) == 2


def test_codes_on_the_way_to_the_goal_are_nearer_or_those_with_as_many_crossings() -> None:
    guide, blind = (_guide_to(KINKED_TWICE, own) for own in (PassValues.of_split(), NOTHING))
    codes = GaussCode(KINKED_TWICE.visits, "ca"), KINK, FLAT
    far, hops = [guide.distance(code) for code in codes], [guide.hops(code, 9) for code in codes]
    assert far[0] == 0 and far == sorted(far) and len({*far}) == 3 and hops[0] == 0 < hops[1] < 3
    assert 0 < guide.distance(THREE) < guide.distance(FLAT)
    assert blind.distance(KINK) == blind.distance(THREE) < blind.distance(FLAT)
    assert [blind.hops(code, 9) for code in codes] == [0, 9, 9]
