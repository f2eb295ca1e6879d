"""Measures and seeds of a lone state file: what is changed in them is found."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from knotgym.datasets.state_verification import state_faults
from knotgym.states.schema import DIGEST
from knotgym.states.state_file import States, content_digest, read_states, shipped, write_states
from knotgym.states.state_measures import quality_faults, repeated_sources, source_faults

ROWS = np.array([0, 90, 170])


@pytest.fixture(scope="module", params=["readable", "random-walk"])
def states(request: pytest.FixtureRequest) -> States:
    """Some states that ship, without pictures."""
    return read_states(shipped(request.param), images=False).taken(ROWS)


def changed(states: States, name: str, at: tuple[int, ...], value: float) -> list[str]:
    """What is found of a row with one number changed."""
    columns = {**states.columns(), name: states.columns()[name].copy()}
    columns[name][at] = value
    other = states.with_columns(columns)
    return [*quality_faults(other, at[0]), *source_faults(other, at[0]), *repeated_sources(other)]


def test_the_measures_and_seeds_that_ship_have_no_fault(states: States) -> None:
    for row in range(len(states)):
        assert [*quality_faults(states, row), *source_faults(states, row)] == []
    assert list(repeated_sources(states)) == []


@pytest.mark.parametrize(
    "value", [float("nan"), *(pytest.param(v, marks=pytest.mark.slow) for v in (1e30, -7.0))]
)
def test_every_measure_that_is_changed_is_found(states: States, value: float) -> None:
    for name in states.quality:
        assert changed(states, f"quality/{name}", (1,), value)[0].startswith(f"quality.{name} is")


def test_a_measure_may_differ_by_rounding_and_by_no_more(states: States) -> None:
    angle = states.quality["crossing_angle"][1]
    assert changed(states, "quality/crossing_angle", (1,), angle * (1 + 1e-13)) == []
    assert changed(states, "quality/crossing_angle", (1,), angle * (1 + 1e-7))


def test_the_noise_survival_of_a_random_walk_is_drawn_again() -> None:
    walked = read_states(shipped("random-walk"), images=False).taken(ROWS)
    survival = walked.quality["noise_survival"][1]
    other = survival - 1 / 64
    told = changed(walked, "quality/noise_survival", (1,), other)
    assert told == [f"quality.noise_survival is {other}, recomputed {survival}"]


@pytest.mark.parametrize(
    ("place", "value", "told"),
    [
        (0, 7, "is not a stream that states come from"),
        (0, 99, "is not a stream that states come from"),
        (1, 99, "is of a run with seed 99, config says 0"),
        (3, -1, "is not a stream that states come from"),
    ],
)
def test_a_seed_that_no_state_comes_from_is_found(
    states: States, place: int, value: int, told: str
) -> None:
    assert told in changed(states, "source/seed", (1, place), value)[0]


def test_a_seed_of_another_number_of_crossings_is_found() -> None:
    curated = read_states(shipped(), images=False).taken(ROWS)
    assert "is of nx 1, the row has nx" in changed(curated, "source/seed", (1, 2), 1)[0]


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("hard-unknots", ["come from one seed"]),
        ("random-walk", ["come from one seed"]),
        ("readable", ["come from one seed", "end one episode"]),
    ],
)
def test_two_rows_of_one_seed_or_of_one_episode_are_found(name: str, told: list[str]) -> None:
    twice = read_states(shipped(name), images=False).taken(np.array([3, 3]))
    merged = replace(twice, attributes={"config": '[{"seed": 1}, {"seed": 1}]'})
    assert list(repeated_sources(merged)) == []
    one_run = replace(twice, attributes={"config": '{"seed": 1}'})
    assert list(repeated_sources(one_run)) == [f"states.h5 rows 0 and 1 {one}" for one in told]


def test_any_other_change_of_a_written_file_is_found_by_its_own_checksum(tmp_path: Path) -> None:
    path = tmp_path / "states.h5"
    write_states(path, read_states(shipped()).taken(ROWS[:1]))
    written = read_states(path)
    assert written.digest == content_digest(written)
    assert DIGEST not in written.attributes and written.taken(ROWS[:0]).digest == ""
    assert list(state_faults(written)) == []
    with h5py.File(path, "a") as file:
        file["source/seed"][0, 4] = 99
    assert list(state_faults(read_states(path))) == [
        "states.h5: its columns don't match content_sha256"
    ]
