"""Rounds of the search come out the same however they are run; what they find is reached again."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from knotgym.control.action_sequence import step_ropes
from knotgym.generate.states.archive import Archive, Elite
from knotgym.generate.states.search import SearchConfig, new_archive, search_round
from knotgym.quality.measures import Limits, base_spacing, measure
from knotgym.rope.model import Rope, base_shifts
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.runs.executors import InProcess, executor
from knotgym.runs.pools import Pool
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.knots import is_unknot, knot_type
from knotgym.topology.symmetry import shifted_base

from ..conftest import SEARCH, trefoil
from ..played import advance, known_codes


def grown(
    rounds: int, config: SearchConfig = SEARCH, pool: Pool | None = None, chunk: int = 16
) -> Archive:
    archive = new_archive(config)
    for _ in range(rounds):
        for batch in search_round(archive, config, chunk):
            for _ in batch.follow(pool or InProcess()):
                pass
    return archive


def kept(archive: Archive, folder: Path) -> bytes:
    """Every byte of an archive."""
    archive.save(folder / "kept.h5")
    return (folder / "kept.h5").read_bytes()


def elites(archive: Archive) -> list[Elite]:
    found = [elite for niche in archive.niches.values() for elite in niche]
    assert len(found) > 5
    return found


def test_a_new_archive_knows_the_plain_loop() -> None:
    archive = new_archive(SEARCH)
    assert [str(code) for code in known_codes(archive, 0)] == [""]
    assert len(archive.niches) == 1 and archive.growth == []


def test_a_new_archive_can_begin_at_a_knot(rope: Rope) -> None:
    archive = new_archive(SEARCH, rope.from_curve(trefoil()))
    assert {knot_type(code) for code in known_codes(archive, 3)} == {"3_1"}
    assert archive.settings["start"] != "loop"


def test_a_search_from_a_knot_keeps_the_knot(rope: Rope) -> None:
    archive = new_archive(SEARCH, rope.from_curve(trefoil()))
    advance(archive, SEARCH, InProcess())
    assert {knot_type(niche) for niche in archive.niches} == {"3_1"}


def test_the_search_finds_more_than_it_began_with(searched: Archive) -> None:
    assert len(searched.niches) > 3 and max(niche.nx for niche in searched.niches) <= SEARCH.max_nx


def test_everything_found_is_an_unknot(searched: Archive) -> None:
    assert all(is_unknot(niche) for niche in searched.niches)


@pytest.mark.slow  # so are units of three, on two workers below
def test_rounds_are_the_same_bytes_in_work_units_of_any_size(
    searched: Archive, tmp_path: Path
) -> None:
    assert kept(grown(3, chunk=1), tmp_path) == kept(searched, tmp_path)


@pytest.mark.thorough
def test_rounds_are_the_same_bytes_on_two_workers(searched: Archive, tmp_path: Path) -> None:
    with executor(2) as pool:
        assert kept(grown(3, pool=pool, chunk=3), tmp_path) == kept(searched, tmp_path)


@pytest.mark.slow
def test_a_saved_and_loaded_archive_goes_on_as_if_unbroken(
    searched: Archive, tmp_path: Path
) -> None:
    archive = grown(2)
    for _ in range(1):
        archive.save(tmp_path / "archive.h5")
        archive = Archive.load(tmp_path / "archive.h5")
        advance(archive, SEARCH, InProcess())
    assert archive.growth == searched.growth and list(archive.niches) == list(searched.niches)
    assert kept(archive, tmp_path) == kept(searched, tmp_path)


@pytest.mark.slow
def test_another_seed_searches_elsewhere(searched: Archive, tmp_path: Path) -> None:
    assert kept(grown(1, replace(SEARCH, seed=2)), tmp_path) != kept(grown(1), tmp_path)


@pytest.mark.thorough
def test_every_sequence_from_the_plain_loop_ends_in_its_state_bit_for_bit(
    searched: Archive, rope: Rope
) -> None:
    simulation = MujocoSimulation(1, rope)
    for elite in elites(searched):
        simulation.lay(rope.qpos(rope.loop())[None])
        for bead, force in zip(elite.sequence.beads, elite.sequence.forces, strict=True):
            _, held = step_ropes(simulation, np.array([bead]), force[None])
            assert held.all()
        assert np.array_equal(simulation.states()[0], elite.state), elite.code.chiral


def test_every_elite_shows_its_code_walked_from_its_base(searched: Archive, rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    for elite in elites(searched):
        simulation.restore(elite.state[None])
        assert elite.base_shift in base_shifts(rope.config)
        walked = shifted_base(find_crossings(simulation.points[0]), elite.base_shift)
        assert (walked.reversed() if elite.reverse else walked) == elite.code
        assert elite.exact == (elite.base_shift == 0 and not elite.reverse) and (
            not elite.exact or label(simulation.points[0]) == elite.code
        )


def test_the_objective_of_an_elite_is_that_of_its_state(searched: Archive, rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    for elite in elites(searched)[:40]:
        simulation.restore(elite.state[None])
        points = np.roll(simulation.points[0], -elite.base_shift, axis=0)
        assert elite.objective == pytest.approx(
            Limits().objective(measure(points, quick=True), elite.code.nx), abs=1e-6
        )


def test_base_spacing_is_taken_from_the_shifted_base(searched: Archive, rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    crossed = [elite for elite in elites(searched) if elite.code.nx][:10]
    assert len(crossed) > 5
    for elite in crossed:
        simulation.restore(elite.state[None])
        points = simulation.points[0]
        renumbered = np.roll(points, -elite.base_shift, axis=0)
        assert base_spacing(points, find_crossings(points), elite.base_shift) == pytest.approx(
            measure(renumbered, quick=True).base_spacing, abs=1e-6
        )


def test_growth_has_one_row_a_round(searched: Archive) -> None:
    assert [row["round"] for row in searched.growth] == [0, 1, 2]
    assert searched.growth[-1]["classes"] == len(searched.niches)
    assert all(
        row["actions"] < after["actions"] and row["classes"] <= after["classes"]
        for row, after in pairwise(searched.growth)
    )


def test_the_first_round_takes_every_step_of_every_rope(searched: Archive) -> None:
    assert searched.growth[0]["actions"] == SEARCH.batch_size * SEARCH.steps


def test_every_rope_counts_as_a_visit(searched: Archive) -> None:
    assert sum(searched.visits.values()) == 3 * SEARCH.batch_size


@pytest.mark.slow
def test_no_sequence_is_longer_than_the_longest_allowed() -> None:
    archive = grown(3, replace(SEARCH, seed=4, longest=12))
    assert 8 < max(len(elite.sequence) for elite in elites(archive)) <= 12


def test_settings_tell_the_whole_search(searched: Archive) -> None:
    assert (
        searched.settings["seed"] == SEARCH.seed
        and searched.settings["batch_size"] == 8
        and searched.settings["start"] == "loop"
    )


def test_transitions_are_counted_along(searched: Archive) -> None:
    assert searched.transitions.tried.total() > 0 and searched.transitions.seen.total() > 0
