import numpy as np

from knotgym.control.planning.moves import Moves
from knotgym.control.planning.passes import PassValues
from knotgym.control.planning.pulls import _drawn_index, guide_to
from knotgym.control.planning.sights import Sight
from knotgym.rope import Array
from knotgym.topology import GaussCode

FLAT, GOAL = GaussCode(), GaussCode.parse("1+,1-,2+,2-")
KINK, THREE = GaussCode.parse("1+c,1-c"), GaussCode.parse("1+c,1-c,2+a,2-a,3+c,3-c")


def test_codes_on_the_way_to_the_goal_are_nearer() -> None:
    guide = guide_to(GOAL, PassValues.of_split())
    far = [guide.distance(code) for code in (GaussCode(GOAL.visits, "ca"), KINK, FLAT)]
    assert far[0] == 0 and far == sorted(far) and len({*far}) == 3
    assert guide.hops(KINK) in (1, 2) and 0 < guide.distance(THREE) < guide.distance(FLAT)


def test_where_no_way_is_known_crossings_count() -> None:
    guide = guide_to(GOAL, PassValues(Moves()))
    assert guide.distance(KINK) == guide.distance(THREE) < guide.distance(FLAT)
    assert guide.hops(KINK) is None and guide.hops(GaussCode(GOAL.visits, "ca")) == 0


def test_most_macro_actions_are_of_the_best_passes(curve: Array) -> None:
    values, rng = PassValues.of_split(), np.random.default_rng(0)
    guide, best = guide_to(GOAL, values), list(values.passes(GOAL, Sight.of(curve[None])[0]))
    made = [guide.propose(curve, rng) for _ in range(200)]
    passes = {(move.bead, move.target, move.side) for move, _ in best[:8]}
    led = sum((one.bead, one.target, one.side) in passes for one in made)
    assert (130 < led < 190) if best else led == 0


def test_an_index_is_drawn_as_generators_choose() -> None:
    for seed in range(300):
        weights = np.random.default_rng(seed).random(1 + seed % 40) ** 4
        rng, other = np.random.default_rng(seed), np.random.default_rng(seed)
        drawn = _drawn_index(weights, rng)
        assert drawn == other.choice(len(weights), p=weights / weights.sum())
        assert rng.bit_generator.state == other.bit_generator.state
