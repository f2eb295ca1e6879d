"""Recorded datasets: rebuilt to the same bytes, and told where a machine gets others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.atomic_files import sha256
from knotgym.common.errors import Failed, InvalidFile
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.generate.episodes.collect import collect
from knotgym.generate.episodes.recordings import (
    RECORDINGS,
    read_recording,
    record,
    recorded_ids,
    write_recordings,
)
from knotgym.generate.episodes.suite import SuiteConfig, make_suite
from knotgym.generate.episodes.suite_facts import agreement, measured
from knotgym.runs.run_options import RunOptions

from ..small_job import knotgym

EPISODES = 3
PART = SuiteConfig(
    tasks=("unknot",),
    nx=(2,),
    policies=("random", "noisy"),
    splits=("train",),
    states=("readable",),
    episodes={"noisy": EPISODES, "random": 1},
)
ONCE = RunOptions(workers=1, quiet=True)
NOISY, RANDOM = "knotgym/unknot-nx2/noisy-v0", "knotgym/unknot-nx2/random-v0"


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("collected")
    make_suite(PART, out, ONCE)
    return out


@pytest.fixture(scope="module")
def recordings(collected: Path) -> Path:
    path = collected / "recordings.h5"
    write_recordings(path, [record(collected / NOISY)])
    return path


@pytest.mark.thorough
def test_a_rebuilt_dataset_has_the_bytes_of_the_collection(
    collected: Path, recordings: Path, tmp_path: Path
) -> None:
    made = make_suite(replace(PART, recorded=True), tmp_path, ONCE, recordings=recordings)
    for name in (NOISY, RANDOM):
        for file in ("main_data.hdf5", "metadata.json"):
            assert sha256(tmp_path / name / "data" / file) == sha256(
                collected / name / "data" / file
            )
    told = json.loads((made / "suite.json").read_text())["sets"]
    assert told[NOISY]["recorded"] == "same" and told[RANDOM]["recorded"] == "no"
    # a collection of the same settings counts as finished too
    make_suite(PART, tmp_path, replace(ONCE, resume=True), recordings=recordings)


def test_the_first_episodes_of_a_recording_can_be_rebuilt_alone(
    collected: Path, recordings: Path, tmp_path: Path
) -> None:
    part = replace(PART, recorded=True, policies=("noisy",), episodes={"noisy": 1})
    make_suite(part, tmp_path, ONCE, recordings=recordings)
    first, whole = EpisodeReader(tmp_path / NOISY), EpisodeReader(collected / NOISY)
    assert [one.digest() for one in first] == [whole.episode(0).digest()]


def test_a_machine_that_gets_another_episode_is_told_its_number(
    recordings: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    changed = read_recording(NOISY, recordings)
    pulls = changed.pulls.copy()
    pulls[changed.lengths[0], 1] ^= 64  # the first pull of episode 1
    path = tmp_path / "changed.h5"
    write_recordings(path, [replace(changed, pulls=pulls)])
    defaults = {"scores": (), "recordings": path, "progress": None}
    monkeypatch.setattr(make_suite, "__kwdefaults__", defaults)
    words = ("--task", "unknot", "--nx", 2, "--policies", "noisy", "--episodes", EPISODES)
    out = tmp_path / "out"
    assert knotgym("suite", "--recorded", *words, "--workers", 1, "--quiet", "--out", out) == 1
    said = capfd.readouterr().err
    assert f"{NOISY} differs from episode 1; the sets are kept" in said and said.count("\n") == 1
    assert len(EpisodeReader(out / NOISY)) == EPISODES
    assert f"`{NOISY}`" in (page := (out / "knotgym" / "README.md").read_text())
    assert "differs from episode 1" in page
    with pytest.raises(Failed, match="differs from episode 1"):
        part = replace(PART, recorded=True, policies=("noisy",))
        make_suite(part, out, replace(ONCE, resume=True), recordings=path)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"episodes": {"noisy": EPISODES + 1}}, f"is recorded with {EPISODES} episodes, got 4"),
        ({"seed": 2}, "nothing of this is recorded; there is knotgym/unknot-nx2/noisy-v0"),
        ({"tasks": ("tie",)}, "nothing of this is recorded"),
    ],
)
def test_what_is_not_recorded_is_refused(
    change: dict[str, Any], complaint: str, recordings: Path, tmp_path: Path
) -> None:
    asked = replace(PART, recorded=True, **change)
    with pytest.raises(InvalidFile, match=complaint):
        make_suite(asked, tmp_path / "out", ONCE, recordings=recordings)
    assert not (tmp_path / "out").exists()


def test_episodes_that_differ_because_of_other_states_are_told_so(
    collected: Path, recordings: Path, tmp_path: Path
) -> None:
    one, path = read_recording(NOISY, recordings), tmp_path / "other.h5"
    source = {**one.source, "states": {"shipped": "0" * 64}}
    write_recordings(path, [replace(one, source=source)])
    assert agreement(NOISY, collected / NOISY, path) == "same"
    write_recordings(path, [replace(one, source=source, digests=one.digests + np.uint8(1))])
    differs = "differs from episode 0 (its states are others)"
    assert agreement(NOISY, collected / NOISY, path) == differs


def test_figures_of_another_recording_are_not_shown(collected: Path, recordings: Path) -> None:
    learner = {"policy": "bc", "success_rate": 0.5}
    for digest, known in ((read_recording(NOISY, recordings).digest, learner), ("0" * 64, None)):
        told = {NOISY: {"recording_sha256": digest, "learner": learner}}
        recordings.with_suffix(".json").write_text(json.dumps(told))
        found = measured(NOISY, collected / NOISY, recordings)
        assert found == {"predictability": None, "learner": known}


def test_recordings_say_what_is_wrong_with_them(recordings: Path, tmp_path: Path) -> None:
    one = read_recording(NOISY, recordings)
    path = tmp_path / "wrong.h5"
    changes: tuple[dict[str, Any], ...] = (
        {"lengths": one.lengths + np.int32(1)},
        {"reasons": one.reasons[:-1]},
        {"pulls": np.full_like(one.pulls, 127)},
    )
    for change in changes:
        write_recordings(path, [replace(one, **change)])
        with pytest.raises(InvalidFile, match="don't fit its steps"):
            read_recording(NOISY, path)


def test_a_policy_of_unquantized_pulls_is_not_recorded(collected: Path) -> None:
    with pytest.raises(InvalidFile, match="a policy that chooses macro-actions"):
        record(collected / RANDOM)


def test_the_recordings_that_ship_are_those_of_the_suite() -> None:
    sets = {one.dataset_id: one for one in SuiteConfig().sets()}
    known = recorded_ids()
    clean = {f"knotgym/{task}-nx2/expert-v0" for task in ("tie", "convert", "unknot")}
    assert clean <= set(known) <= set(sets)
    assert all(len(read_recording(name)) == sets[name].episodes for name in known)
    assert RECORDINGS.stat().st_size < 5e6


def test_a_set_that_ships_is_rebuilt_on_this_machine(tmp_path: Path) -> None:
    words = ("--task", "tie", "--nx", 2, "--policies", "expert", "--episodes", 2)
    assert knotgym("suite", "--recorded", *words, "--workers", 1, "--quiet", "--out", tmp_path) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", recorded_ids())
def test_policies_still_do_what_is_recorded_of_them(name: str, tmp_path: Path) -> None:
    config = next(one for one in SuiteConfig().sets() if one.dataset_id == name)
    made = collect(replace(config, episodes=2), tmp_path, ONCE)
    assert read_recording(name).first_difference(made) is None, "record the suite again"
