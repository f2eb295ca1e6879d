import numpy as np
import pytest

from knotgym.control.planning.batched_search import BatchedSearch, Orders, Report, Search, Trial
from knotgym.rope import Haul, Pass
from knotgym.topology import GaussCode

KINK = GaussCode.parse("1+c,1-c")


@pytest.fixture
def ropes() -> BatchedSearch:
    return BatchedSearch(3)


def two_passes(ropes: BatchedSearch, bead: int) -> Search[Report]:
    state = np.array(START[0])
    _, ((_, landing),) = yield Orders({0: Trial(state, Pass(bead, bead + 14, 1), 10, KINK)})
    _, ((_, landing),) = yield Orders({0: Trial(landing.state, Pass(70, 50, -1), 10, KINK)})
    return landing


START = [BatchedSearch(1).ropes.states()[0]]


def test_searches_find_the_same_in_any_company(ropes: BatchedSearch) -> None:
    beads = (20, 30, 40, 50)
    together = dict(ropes.run(two_passes(ropes, bead) for bead in beads))
    assert sorted(together) == [0, 1, 2, 3]
    for number, bead in enumerate(beads):
        ((_, alone),) = ropes.run([two_passes(ropes, bead)])
        assert np.array_equal(alone.points, together[number].points)
        assert alone.pulls == together[number].pulls


def one_trial(trial: Trial) -> Search[list[Report]]:
    reports = [(yield Orders({0: trial}))[1][0][1]]
    while not reports[-1].over:
        reports.append((yield Orders({}))[1][0][1])
    return reports


def test_a_watched_trial_reports_every_change_and_its_pulls(ropes: BatchedSearch) -> None:
    move = Pass(20, 34, 1)
    ((_, reports),) = ropes.run([one_trial(Trial(START[0], move, 10, KINK, watch=True))])
    assert [report.over for report in reports] == [False] * (len(reports) - 1) + [True]
    last = reports[-1]
    assert last.beads.tolist() == [20] * last.pulls and last.forces.shape == (last.pulls, 3)
    # the pulls lead there again, bit for bit
    ropes.ropes.restore(START[0][None], [0])
    for bead, force in zip(last.beads, last.forces.astype(np.float64), strict=True):
        ropes.ropes.step([bead], force[None] * ropes.ropes.max_force, [0])
    assert np.array_equal(ropes.ropes.states([0])[0], last.state)


def test_a_haul_pulls_two_beads_in_turn(ropes: BatchedSearch) -> None:
    haul = Haul.drawn(100, np.random.default_rng(1))
    trial = Trial(START[0], haul, haul.steps, KINK, watch=True)
    ((_, reports),) = ropes.run([one_trial(trial)])
    assert reports[-1].beads.tolist() == [haul.pull(step)[0] for step in range(haul.steps)]
