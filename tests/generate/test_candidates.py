"""Candidates show the code asked for, can be made again bit for bit, and say why if rejected."""

import pickle
from collections.abc import Sequence
from dataclasses import astuple, fields, replace

import numpy as np
import pytest

from knotgym.control.action_sequence import NO_ACTIONS, step_ropes
from knotgym.generate.states import candidates
from knotgym.generate.states.archive import Archive, Elite
from knotgym.generate.states.candidates import (
    Candidate,
    CandidateConfig,
    CandidateTask,
    make_candidate,
)
from knotgym.generate.states.curves import LoopConfig
from knotgym.quality.measures import Limits, measure
from knotgym.rope.model import Rope
from knotgym.rope.simulation import Simulation
from knotgym.states.spread import bare_stretch
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.reference_labeller import pyknotid_code
from knotgym.topology.symmetry import mirror_images

from ..conftest import curled
from ..small_job import SMALL

Made = Sequence[tuple[CandidateTask, Candidate]]


def tasks(archive: Archive, config: CandidateConfig = SMALL.candidate) -> list[CandidateTask]:
    """One task for every third code with chirality that the archive knows, up to two crossings."""
    start = Rope().loop()
    codes = [
        code
        for nx in range(3)
        for plain in archive.codes(nx)
        for code in archive.known_chiralities(plain)
    ]
    return [
        CandidateTask(config, code, tuple(archive.leading_to(code)), start, (0, 2, code.nx, k, 0))
        for k, code in enumerate(codes[::3])
    ]


def same(candidate: Candidate, other: Candidate) -> bool:
    """Whether two candidates are the same in every bit."""
    arrays = ("start_qpos", "actions", "points", "qpos")
    values = ("code", "faults", "seed")
    return (
        all(np.array_equal(getattr(candidate, name), getattr(other, name)) for name in arrays)
        and all(getattr(candidate, name) == getattr(other, name) for name in values)
        and np.array_equal(astuple(candidate.quality), astuple(other.quality), equal_nan=True)
    )


@pytest.fixture(scope="module")
def made(searched: Archive) -> Made:
    """Candidates of every third code known with up to two crossings, none of them dropped."""
    candidates_made = [(task, make_candidate(task)) for task in tasks(searched)]
    assert len(candidates_made) >= 4
    return candidates_made


@pytest.fixture(scope="module")
def followed(made: Made) -> Made:
    """Those whose action sequence led to the code."""
    led = [(task, candidate) for task, candidate in made if len(candidate.actions)]
    assert len(led) >= 4
    return led


@pytest.fixture(scope="module")
def accepted(made: Made) -> Made:
    faultless = [(task, candidate) for task, candidate in made if not candidate.faults]
    assert len(faultless) >= 3
    return faultless


def test_most_sequences_carry_over(made: Made, followed: Made, accepted: Made) -> None:
    assert len(followed) > len(made) / 2 and len(accepted) >= 3


def test_an_accepted_candidate_shows_the_code_asked_for(accepted: Made) -> None:
    for task, candidate in accepted:
        assert candidate.code == task.code == label(candidate.points[-1])


def test_both_labellers_agree_on_an_accepted_candidate(accepted: Made) -> None:
    for _, candidate in accepted:
        assert pyknotid_code(candidate.points[-1]) == candidate.code


def test_its_start_and_actions_end_in_it_bit_for_bit(followed: Made, rope: Rope) -> None:
    simulation = Simulation(1, rope)
    for _, candidate in followed:
        simulation.lay(candidate.start_qpos[None])
        assert np.array_equal(simulation.points[0], candidate.points[0])
        for action, points in zip(candidate.actions, candidate.points[1:], strict=True):
            assert simulation.act(action[None]).all() and np.array_equal(
                simulation.points[0], points
            )
        assert np.array_equal(simulation.qpos()[0], candidate.qpos)


def test_actions_are_what_an_agent_can_do(followed: Made) -> None:
    for _, candidate in followed:
        assert candidate.actions.dtype == np.float32 and np.abs(candidate.actions).max() <= 1


def test_the_last_steps_have_no_force(followed: Made) -> None:
    for task, candidate in followed:
        assert not candidate.actions[-task.config.rest :, 3:].any()


def test_it_starts_as_a_loop_a_circle_where_a_sequence_leads_to_its_code(followed: Made) -> None:
    for task, candidate in followed:
        off = np.linalg.norm(candidate.points[0][:, :2], axis=1).std()
        assert label(candidate.points[0]).nx == 0 and (off < 1e-3 or not task.code.nx)


def test_crossings_of_one_elite_come_to_lie_all_along_the_rope(
    searched: Archive, rope: Rope
) -> None:
    code = searched.known_chiralities(GaussCode.parse("1+,1-"))[0]
    elite, simulation = searched.leading_to(code)[0], Simulation(1, rope)
    places = []
    for k in range(40):
        symmetry = candidates._symmetry(simulation, elite, code, np.random.default_rng(k))
        simulation.restore(elite.state[None], [0])
        crossings = find_crossings(symmetry.configuration(simulation.points[0]))
        assert crossings.code == code
        places += [crossings.over_place[0], crossings.under_place[0]]
    bare = bare_stretch(np.array(places), 100)
    assert bare is not None and bare < 15


def test_the_seed_of_a_task_goes_with_the_candidate(made: Made) -> None:
    assert all(task.seed == candidate.seed for task, candidate in made)


def test_quality_is_that_of_the_last_state(followed: Made) -> None:
    for _, candidate in followed:
        right = replace(
            measure(candidate.points[-1]), noise_survival=candidate.quality.noise_survival
        )
        assert candidate.quality == right and 0 <= candidate.quality.noise_survival <= 1


def test_a_candidate_is_accepted_if_and_only_if_nothing_is_at_fault(followed: Made) -> None:
    for task, candidate in followed:
        right = task.config.limits.faults(candidate.quality, candidate.code.nx)
        assert [
            fault for fault in candidate.faults if fault in {field.name for field in fields(Limits)}
        ] == right


def test_a_code_lost_on_the_way_to_rest_is_a_fault(followed: Made) -> None:
    for task, candidate in followed:
        assert ("code lost at rest" in candidate.faults) == (
            label(candidate.points[-1]) != task.code
        )


def test_the_same_task_gives_the_same_bytes_whatever_was_made_before(made: Made) -> None:
    for task, candidate in made[-1:]:
        assert same(make_candidate(pickle.loads(pickle.dumps(task))), candidate)


@pytest.mark.slow
def test_another_seed_gives_another_candidate(followed: Made) -> None:
    task, candidate = followed[-1]
    assert not same(make_candidate(task._replace(seed=(1, 2, 3, 4, 5))), candidate)


def test_a_sequence_that_misses_the_code_is_rejected_for_it(searched: Archive, rope: Rope) -> None:
    simulation, curl = Simulation(1, rope), rope.from_curve(curled(1))
    simulation.lay(rope.qpos(curl)[None])
    state = simulation.states()[0]
    nowhere = Elite(label(curl), 0, False, NO_ACTIONS, state, 0.0)
    candidate = make_candidate(
        CandidateTask(
            SMALL.candidate, mirror_images(nowhere.code)[0], (nowhere,), rope.loop(), (0,)
        )
    )
    assert candidate.faults == ("sequence missed the code",) and len(candidate.actions) == 0


def test_limits_that_nothing_meets_reject_everything(searched: Archive) -> None:
    few = LoopConfig(draws=2)  # in vain
    strict = replace(SMALL.candidate, limits=Limits(crossing_angle=91.0), loop=few)
    task = tasks(searched, strict)[0]
    assert make_candidate(task).faults == ("crossing_angle",)


def test_variants_of_one_sequence_end_in_different_places(followed: Made) -> None:
    ends = np.array(
        [candidate.points[-1] - candidate.points[-1].mean(axis=0) for _, candidate in followed]
    )
    assert len({end.tobytes() for end in ends}) == len(ends)


def test_a_code_held_longer_before_the_end_is_told(rope: Rope) -> None:
    loop, kink = rope.loop(), rope.from_curve(curled(1, 0.4))
    code = label(kink)
    held = [
        np.stack([loop] + [kink if shown == "x" else loop for shown in row])
        for row in ("..x.xx", "xx.x", "x.x", "xxx", "...")
    ]
    assert [candidates._shown_longest_last(points, code) for points in held] == [
        True,
        False,
        False,
        True,
        True,
    ]


def test_what_goes_back_to_the_archive_is_reached_from_the_plain_loop_and_better_than_before(
    followed: Made, rope: Rope
) -> None:
    simulation = Simulation(1, rope)
    better = [(task, candidate) for task, candidate in followed if candidate.elites]
    assert better
    for task, candidate in better:
        elite = candidate.elites[0]
        assert elite.exact and mirror_images(elite.code) == mirror_images(candidate.code)
        assert all(elite.objective < other.objective for other in task.elites if other.exact)
        simulation.lay(rope.qpos(rope.loop())[None])
        for bead, force in zip(elite.sequence.beads, elite.sequence.forces, strict=True):
            step_ropes(simulation, np.array([bead]), force[None])
        assert (
            np.array_equal(simulation.states()[0], elite.state)
            and label(simulation.points[0]) == elite.code
        )


def test_every_configuration_of_a_candidate_is_finite(followed: Made) -> None:
    assert all(
        np.isfinite(candidate.points).all() and len(candidate.points) == len(candidate.actions) + 1
        for _, candidate in followed
    )
