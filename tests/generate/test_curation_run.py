"""A job tasks what is lacking, accepts what is asked for, and says so when it can't be had."""

from collections import Counter
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.control.action_sequence import ActionSequence, step_ropes
from knotgym.control.planner_config import PlannerConfig
from knotgym.generate.states import curation_run as curation
from knotgym.generate.states.archive import Archive, ArchiveConfig
from knotgym.generate.states.candidates import Candidate, CandidateTask, make_candidate
from knotgym.generate.states.code_frequencies import FrequencyConfig, frequencies
from knotgym.generate.states.curation_run import CurationRun, search_config, start_of
from knotgym.generate.states.curves import LoopConfig
from knotgym.generate.states.generate_config import GenerateConfig, InvalidGenerateConfig
from knotgym.generate.states.search import Replay, advance, confirm, new_archive
from knotgym.generate.states.targeted_search import TargetPlan, reach
from knotgym.quality.measures import Limits
from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.simulation import Simulation
from knotgym.runs.executors import InProcess
from knotgym.runs.run_options import NotEnough
from knotgym.topology.gauss import GaussCode

from ..conftest import curled, trefoil
from ..small_job import SMALL

# What no rope meets; few loops are drawn in vain.
HOPELESS = replace(SMALL.candidate, limits=Limits(crossing_angle=91.0), loop=LoopConfig(draws=2))


def config(**changes: Any) -> GenerateConfig:
    return replace(SMALL, **{"nx": (0, 1), "count": 4, **changes})


def done(job: CurationRun) -> CurationRun:
    for batch in job.batches():
        for _ in batch.follow(InProcess()):
            pass
    return job


@pytest.fixture(scope="module")
def finished(searched: Archive) -> CurationRun:
    """Two states with one crossing."""
    return done(CurationRun.begin(config(nx=(1,), count=2), archive=deepcopy(searched)))


@pytest.fixture(scope="module")
def targeted() -> CurationRun:
    """A job that is to show every code with two crossings; copied before it grows."""
    return CurationRun.begin(config(nx=(2,), every_code=1))


@pytest.fixture(scope="module")
def reached(targeted: CurationRun) -> TargetPlan:
    """What comes of the first of its targets."""
    return reach(curation._targets(deepcopy(targeted), search_config(targeted.config))[0])


def accepted(job: CurationRun) -> Iterator[tuple[int, Candidate]]:
    return ((nx, one) for nx, candidates in job.accepted.items() for one in candidates)


def signature(job: CurationRun) -> list[object]:
    """What a job came to, every bit of it, but for the time it took."""
    took = [
        (nx, one.code, one.seed, one.qpos.tobytes(), one.actions.tobytes())
        for nx, one in accepted(job)
    ]
    return [took, job.rejected, job.tried, job.cycle, job.actions, job.archive.growth]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"nx": (7,)}, "from 0 to 6, got 7"),
        ({"nx": (-1,)}, "from 0 to 6, got -1"),
        ({"nx": (2, 2)}, "different numbers of crossings"),
        ({"nx": ()}, "got none"),
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"attempts": 0}, "attempts must be at least 1, got 0"),
        ({"wave": 0}, "wave must be at least 1, got 0"),
        ({"every_code": -1}, "every_code must be at least 0, got -1"),
        ({"balance": "odd"}, '"even" or "empirical", got \'odd\''),
        ({"split_by": "row"}, '"state" or "code", got \'row\''),
        ({"train_share": 1.5}, r"in \[0, 1\], got 1.5"),
        ({"train_share": float("nan")}, r"in \[0, 1\], got nan"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
    ],
)
def test_nonsense_is_refused_in_one_line(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(InvalidGenerateConfig, match=problem) as caught:
        config(**changes)
    assert "\n" not in str(caught.value)


def test_a_knot_has_no_diagram_with_too_few_crossings() -> None:
    with pytest.raises(InvalidGenerateConfig, match="no diagram of 3_1 has 2 crossings"):
        CurationRun.begin(config(knot="3_1", nx=(2,)))


def test_natural_balance_is_for_the_unknot() -> None:
    with pytest.raises(InvalidGenerateConfig, match="empirical balance"):
        CurationRun.begin(config(knot="3_1", nx=(3,), balance="empirical"))


def test_a_curve_with_more_crossings_than_asked_for_begins_a_job_all_the_same(
    tmp_path: Path,
) -> None:
    np.save(tmp_path / "curled.npy", curled(4))
    odd = config(knot=str(tmp_path / "curled.npy"), nx=(1,), count=1)
    job = CurationRun.begin(odd)
    assert job.knot == "0_1" and search_config(odd).max_nx == 4
    assert advance(job.archive, search_config(odd), InProcess()) >= 0


def test_an_archive_whose_ways_begin_elsewhere_is_refused(rope: Rope) -> None:
    knotted = new_archive(search_config(config()), rope.from_curve(trefoil()))
    with pytest.raises(InvalidGenerateConfig, match="begin at another curve"):
        CurationRun.begin(config(), archive=knotted)


def test_an_archive_of_another_rope_is_refused() -> None:
    heavy = new_archive(replace(search_config(config()), rope=RopeConfig(density=2000.0)))
    with pytest.raises(InvalidGenerateConfig, match="move another rope"):
        CurationRun.begin(config(), archive=heavy)


def test_a_loaded_archive_of_another_search_is_gone_on_from(
    searched: Archive, tmp_path: Path
) -> None:
    searched.save(tmp_path / "archive.h5")
    job = CurationRun.begin(config(seed=9, nx=(2,)), archive=Archive.load(tmp_path / "archive.h5"))
    assert len(job.archive.codes(2)) == len(searched.codes(2))


def test_codes_share_the_count_evenly() -> None:
    assert set(CurationRun.begin(config(nx=(2,), count=20)).shares[2].values()) == {3}


def test_every_code_is_wanted_as_often_as_asked() -> None:
    job = CurationRun.begin(config(nx=(2,), every_code=5))
    assert job.wanted(2) == 8 * 5 and set(job.shares[2].values()) == {5} and job.existing == {2: 8}


def test_a_finished_job_has_what_was_asked_for(finished: CurationRun) -> None:
    assert finished.done() and finished.accepted.keys() == {1}
    assert Counter(str(one.code) for one in finished.accepted[1]) == {"1+,1-": 1, "1-,1+": 1}


def test_a_finished_job_tells_what_its_cycles_came_to(finished: CurationRun) -> None:
    assert finished.cycle == len(finished.growth) > 0
    last = finished.growth[-1]
    assert last["accepted"] == {"1": len(finished.accepted[1])}
    assert last["known"] == {"1": len(finished.archive.codes(1))}
    assert last["steps"] == finished.steps() > finished.archive.growth[0]["actions"]


def test_accepted_states_have_no_faults_and_the_crossings_asked_for(finished: CurationRun) -> None:
    candidates = list(accepted(finished))
    assert len(candidates) == 2
    assert all(one.faults == () and one.code.nx == nx for nx, one in candidates)


def test_every_instance_has_a_seed_of_its_own(finished: CurationRun) -> None:
    seeds = [one.seed for _, one in accepted(finished)]
    assert len(seeds) == len(set(seeds)) and all(seed[1] == finished.config.seed for seed in seeds)


def test_a_finished_job_can_be_run_again_and_does_nothing(finished: CurationRun) -> None:
    before = signature(finished)
    assert signature(done(finished)) == before


def test_a_copy_is_rejected_as_a_near_duplicate(finished: CurationRun) -> None:
    job = CurationRun.begin(config(nx=(1,)))
    for _ in range(2):
        curation._judge(job, 1, finished.accepted[1][0])
    assert len(job.accepted[1]) == 1 and job.rejected[1] == {"near-duplicate": 1}


def test_what_an_instance_brings_home_goes_into_the_archive(searched: Archive) -> None:
    job = CurationRun.begin(config(nx=(1,), wave=8), archive=deepcopy(searched))
    better = next(
        one
        for one in map(make_candidate, (task for _, task in curation._tasks(job, {})))
        if one.elites
    )
    curation._judge(job, 1, better)
    assert any(one is better.elites[0] for one in job.archive.leading_to(better.code))
    assert all(not one.elites for one in job.accepted[1])


def test_a_state_of_another_knot_is_rejected(finished: CurationRun) -> None:
    job = CurationRun.begin(config(nx=(3,), knot="3_1"))
    curation._judge(job, 3, replace(finished.accepted[1][0], faults=()))
    assert job.accepted[3] == [] and job.rejected[3] == {"knot type changed": 1}


def test_rejections_are_counted_by_reason(finished: CurationRun) -> None:
    job = CurationRun.begin(config(nx=(1,)))
    curation._judge(job, 1, replace(finished.accepted[1][0], faults=("margin", "clearance")))
    assert job.accepted[1] == [] and job.rejected[1] == {"margin": 1, "clearance": 1}


def test_a_code_that_has_its_share_gets_no_more(finished: CurationRun) -> None:
    job = CurationRun.begin(config(nx=(1,), count=2))
    one = finished.accepted[1][0]
    elsewhere = replace(one, points=one.points * 1.2)
    for candidate in (one, elsewhere):
        curation._judge(job, 1, candidate)
    [kept] = job.accepted[1]
    assert kept.points is one.points and not job.rejected[1]


def test_a_code_wanted_more_than_once_gets_states_to_choose_from() -> None:
    job = CurationRun.begin(config(nx=(1, 3), count=4, choice=3))
    assert set(job.needed(1).values()) == {6} and set(job.needed(3).values()) == {1}
    assert (job.short(1), job.lacking(1), job.short(3), job.lacking(3)) == (4, 12, 4, 4)
    few = CurationRun.begin(config(nx=(1,), count=4, choice=3, most_spare=4))
    assert few.lacking(1) == 8


def test_the_choice_grows_after_the_set_and_ends_where_the_attempts_are_spent(
    finished: CurationRun, searched: Archive
) -> None:
    job = CurationRun.begin(config(nx=(0, 1), count=2, choice=3), archive=searched)
    job.accepted[1] = list(finished.accepted[1])
    assert job.short(1) == 0 and {nx for nx, _ in curation._tasks(job, {})} == {0}
    loop = replace(finished.accepted[1][0], code=GaussCode(chirality=""))
    job.accepted[0] = [loop, loop]
    assert {nx for nx, _ in curation._tasks(job, {})} == {0} and not job.done()
    assert [one.code for one in job.chosen(0)] == [loop.code] * 2
    job.tried[0][GaussCode()] = 2 * job.config.attempts
    assert job.done()


def test_orders_are_for_codes_that_lack_states(searched: Archive) -> None:
    job = CurationRun.begin(config(nx=(1, 2), wave=20), archive=searched)
    tasks: list[tuple[int, CandidateTask]] = curation._tasks(job, {})
    assert len(tasks) == 20 and Counter(nx for nx, _ in tasks) == {1: 10, 2: 10}
    assert all(task.code.nx == nx and task.elites for nx, task in tasks)
    assert len({task.seed for _, task in tasks}) == 20


def test_codes_are_ordered_with_each_chirality_in_turn(searched: Archive) -> None:
    job = CurationRun.begin(config(nx=(1,), wave=8), archive=searched)
    assert Counter(task.code.chiral for _, task in curation._tasks(job, {})) == {
        text: 2 for text in ("1+a,1-a", "1+c,1-c", "1-a,1+a", "1-c,1+c")
    }


def test_what_cannot_be_accepted_ends_with_a_line_that_says_so() -> None:
    hopeless = config(
        nx=(0,),
        count=1,
        attempts=2,
        wave=2,
        candidate=HOPELESS,
    )
    with pytest.raises(
        NotEnough,
        match="0 of 1 states with nx = 0 accepted in 2 attempts; use --resume and more --attempts",
    ):
        done(CurationRun.begin(hopeless))


@pytest.mark.slow
def test_a_job_stops_after_its_cycle_with_what_there_is(searched: Archive) -> None:
    few = config(nx=(1,), count=40, cycles=1, wave=2)
    job = done(CurationRun.begin(few, archive=deepcopy(searched)))
    assert job.cycle == len(job.growth) == 1 and 0 < len(job.accepted[1]) <= 2
    assert job.growth[-1]["accepted"] == {"1": len(job.accepted[1])}


@pytest.mark.slow  # above, one cycle does
def test_a_job_stops_after_its_cycles_with_what_there_is() -> None:
    job = done(CurationRun.begin(config(nx=(0, 1), count=40, cycles=2, wave=2)))
    assert job.cycle == len(job.growth) == 2 and 0 < len(job.accepted[1]) < 40
    assert job.growth[-1]["accepted"] == {
        str(nx): len(candidates) for nx, candidates in job.accepted.items()
    }
    assert job.growth[-1]["known"] == {str(nx): len(job.archive.codes(nx)) for nx in (0, 1)}
    assert (
        job.growth[-1]["steps"]
        == job.steps()
        > job.growth[0]["steps"]
        > job.archive.growth[0]["actions"]
    )


@pytest.mark.slow  # attempts end alike, above
def test_cycles_that_accept_nothing_end_with_a_line_that_says_so() -> None:
    hopeless = config(
        nx=(0,),
        count=1,
        cycles=1,
        wave=2,
        candidate=HOPELESS,
    )
    with pytest.raises(
        NotEnough, match="no state accepted in 1 cycles; use --resume and more --cycles"
    ):
        done(CurationRun.begin(hopeless))


def test_more_is_searched_while_wanted_codes_are_unknown(finished: CurationRun) -> None:
    assert (
        curation._rounds(CurationRun.begin(config(nx=(3,), every_code=1))) == 1 + SMALL.more_rounds
    )
    assert (
        curation._rounds(finished) == 0
        and curation._rounds(CurationRun.begin(config(nx=(0,)))) == 0
    )


def test_codes_not_surely_known_are_aimed_at_those_aimed_at_least_first(
    targeted: CurationRun, reached: TargetPlan
) -> None:
    job = deepcopy(targeted)
    search = search_config(job.config)
    first, second = curation._targets(job, search), curation._targets(job, search)
    assert (
        [one.goal for one in first]
        == [one.goal for one in second]
        == list(job.shares[2])[: SMALL.targets]
    )
    assert len({one.seed for one in first + second}) == 2 * len(first) and set(
        job.targeted.values()
    ) == {2}
    for elite in reached.elites:
        job.archive.offer(elite, ArchiveConfig())
    assert job.archive.sure(next(iter(job.archive.known_chiralities(first[0].goal))))
    assert first[0].goal not in [one.goal for one in curation._targets(job, search)]


def test_a_code_that_only_a_long_way_leads_to_is_aimed_at_after_those_that_lack_states(
    finished: CurationRun, targeted: CurationRun, reached: TargetPlan
) -> None:
    job = deepcopy(targeted)
    search, code = search_config(job.config), next(iter(job.shares[2]))
    assert curation._targets(job, search)[0].goal == code
    elite = next(one for one in reached.elites if one.exact)
    rests = ActionSequence(
        np.zeros(search.longest, dtype=np.int16), np.zeros((search.longest, 3), dtype=np.float32)
    )
    job.archive.offer(replace(elite, sequence=elite.sequence + rests), ArchiveConfig())
    job.accepted[2].append(replace(finished.accepted[1][0], code=elite.code))
    assert any(map(job.archive.sure, job.archive.known_chiralities(code)))
    assert [one.goal for one in curation._targets(job, search)][-1] == code


def test_a_code_whose_instances_all_fail_is_aimed_at_again_and_they_set_out_from_there(
    targeted: CurationRun, reached: TargetPlan
) -> None:
    job = deepcopy(targeted)
    search, code = search_config(job.config), next(iter(job.shares[2]))
    assert curation._targets(job, search)[0].goal == code
    for elite in reached.elites:
        job.archive.offer(elite, ArchiveConfig())
    assert code not in [one.goal for one in curation._targets(job, search)]
    job.tried[2][code] = 2 * SMALL.stuck
    assert code in [one.goal for one in curation._targets(job, search)]
    assert code not in [one.goal for one in curation._targets(job, search)]
    exact = next(one for one in reached.elites if one.exact)
    fresh = replace(exact, objective=exact.objective + 1)
    job.tried[2][code] = 0
    tasks = [task for _, task in curation._tasks(job, {code: fresh}) if task.code.plain == code]
    assert tasks and all(task.code == fresh.code and task.elites == (fresh,) for task in tasks)


def test_an_aim_is_a_way_that_can_be_gone_again(
    rope: Rope, targeted: CurationRun, reached: TargetPlan
) -> None:
    target = curation._targets(deepcopy(targeted), search_config(targeted.config))[0]
    shot, again = reached, reach(target)
    assert shot.spent == again.spent > len(shot.elites[0].sequence) > 0
    simulation = Simulation(1, rope)
    for elite in shot.elites:
        simulation.lay(rope.qpos(target.start)[None])
        for bead, force in zip(elite.sequence.beads, elite.sequence.forces, strict=True):
            step_ropes(simulation, np.array([bead]), force[None])
        assert np.array_equal(simulation.states()[0], elite.state)
    assert next(one for one in shot.elites if one.exact).code.matches(target.goal)


def test_a_way_goes_on_from_an_elite(targeted: CurationRun, reached: TargetPlan) -> None:
    target = curation._targets(deepcopy(targeted), search_config(targeted.config))[0]
    begun = next(one for one in reached.elites if one.exact)
    goal = GaussCode.parse("1+,1-")
    further = next(
        one
        for one in reach(target._replace(goal=goal, elite=begun)).elites
        if one.exact and one.code.matches(goal)
    )
    assert np.array_equal(further.sequence.beads[: len(begun.sequence)], begun.sequence.beads)
    assert len(begun.sequence) < len(further.sequence) <= target.search.longest
    (shown, *_) = confirm(Replay(target.search, (further.sequence,)))
    assert np.array_equal(shown.state, further.state)


def test_codes_met_on_the_way_to_an_aim_get_their_own(targeted: CurationRun) -> None:
    target = curation._targets(deepcopy(targeted), search_config(targeted.config))[0]
    wanted = frozenset(map(GaussCode.parse, ("1+,1-", "1-,1+")))
    found = [one for one in reach(target._replace(wanted=wanted)).elites if one.exact]
    met = next(one for one in found if one.code.plain in wanted)
    assert any(one.code.matches(target.goal) for one in found)
    shown = confirm(Replay(target.search, (met.sequence,)))
    assert met.code in [one.reading.code for one in shown]
    assert np.array_equal(shown[0].state, met.state)


def test_an_aim_that_fails_says_what_it_spent() -> None:
    target = curation._targets(
        CurationRun.begin(config(nx=(4,), every_code=1)), search_config(config(nx=(4,)))
    )[0]
    assert reach(target._replace(planner=PlannerConfig(budget=16))) == ((), 16)


def test_a_random_policy_meets_the_loop_at_once() -> None:
    assert frequencies(0, 1, 0, RopeConfig(), FrequencyConfig()) == {GaussCode(): 64}


@pytest.mark.slow
def test_a_random_policy_meets_the_same_codes_again() -> None:
    one, other = (frequencies(1, 60, 3, RopeConfig(), FrequencyConfig()) for _ in range(2))
    assert one == other and one.total() >= 60 and {str(code) for code in one} <= {"1+,1-", "1-,1+"}


def test_the_start_of_a_job_is_the_loop_or_the_curve_of_its_knot(rope: Rope) -> None:
    assert np.array_equal(start_of(config()), rope.loop()) and not np.allclose(
        start_of(config(knot="3_1")), rope.loop()
    )
