"""The fixed benchmark: which sets, made in one go or two, and the card over them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from knotgym.common.atomic_files import sha256
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.generate.episodes import collect as collecting
from knotgym.generate.episodes.suite import (
    POLICIES,
    SETUPS,
    SPLITS,
    STATES,
    SuiteConfig,
    core_seconds,
    make_suite,
)
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import staging_folder

from ..small_job import knotgym

WHERE = ("--states", "readable", "--split", "train")
WORDS = ("suite", "--task", "unknot", "--nx", 2, *WHERE, "--workers", 1)
CHEAP = (*WORDS, "--policies", "random,expert", "--episodes", "random=1,expert=5")
ID = "knotgym/unknot-nx2/{}-v0"
DAY = 24 * 3600


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cheap sets of one set-up."""
    out = tmp_path_factory.mktemp("unbroken")
    assert knotgym(*CHEAP, "--quiet", "--out", out) == 0
    return out


def digests(out: Path) -> dict[str, str]:
    """SHA-256 of all that doesn't tell how long it took."""
    return {
        path.relative_to(out).as_posix(): sha256(path)
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "collection.json"
    }


def card(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "knotgym" / "suite.json").read_text())
    return found


def test_the_whole_is_nine_set_ups_by_policies_splits_and_sets_of_states() -> None:
    sets = list(SuiteConfig().sets())
    count = len(SETUPS) * len(POLICIES) * len(SPLITS) * len(STATES)
    assert len({one.dataset_id for one in sets}) == len(sets) == count
    for one in sets:
        assert ("train-code" in one.dataset_id) == (one.task.split == "train-code")
        assert (one.task.tow_limit == 0.04) == (one.task.task == "unknot")


def test_the_whole_takes_less_than_eight_hours_on_two_cores() -> None:
    assert sum(map(core_seconds, SuiteConfig().sets())) / 2 < DAY / 3


def test_no_episode_begins_as_one_of_an_evaluation_on_the_train_split() -> None:
    assert SuiteConfig().seed != 0


@pytest.mark.thorough
def test_every_policy_has_its_set_and_the_card_tells_of_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    policies = ("random", "noisy", "expert")  # an episode of play takes long
    words = (*WORDS, "--policies", ",".join(policies))
    assert knotgym(*words, "--episodes", 1, "--out", tmp_path) == 0
    told = capfd.readouterr().out
    assert "\n3 sets; 3 episodes to play, about " in told and "with 1 workers" in told
    sets = card(tmp_path)["sets"]
    assert sets.keys() == {ID.format(policy) for policy in policies}
    for name, one in sets.items():
        reader = EpisodeReader(tmp_path / name)
        assert len(reader) == one["episodes"] == 1
        assert (one["first_choices"] is None) == (one["policy"] == "random")
        assert one["codes"]["train"] == one["codes"]["test"] == 1  # the plain loop
        assert one["sha256"]["main_data.hdf5"] == sha256(reader.path)
    page = (tmp_path / "knotgym" / "README.md").read_text()
    assert all(f"`{name}`" in page for name in sets)
    assert "## Protocol" in page and "| unknot-nx2 |" in page


@pytest.mark.slow  # a set's own resuming is a collection's, tried in runs/test_kills
def test_a_killed_run_goes_on_to_the_same_bytes(
    unbroken: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    played: list[Any] = []
    play = collecting.play

    def killed(file: Any) -> Any:
        if len(played) == 2:  # in the middle of the second set
            raise KeyboardInterrupt
        played.append(file)
        return play(file)

    with monkeypatch.context() as patch:
        patch.setattr(collecting, "play", killed)
        assert knotgym(*CHEAP, "--quiet", "--out", tmp_path) == 130
    assert (tmp_path / ID.format("random")).is_dir()
    assert staging_folder(tmp_path / ID.format("expert")).is_dir()
    capfd.readouterr()
    assert knotgym(*CHEAP, "--quiet", "--out", tmp_path) == 2
    assert "--resume keeps finished datasets" in capfd.readouterr().err
    assert knotgym(*CHEAP, "--resume", "--out", tmp_path) == 0
    assert "2 sets, 1 finished already; 5 episodes to play" in capfd.readouterr().out
    assert digests(tmp_path) == digests(unbroken)


@pytest.mark.slow
def test_a_finished_suite_is_left_alone_and_shows_evaluations_that_came_since(
    unbroken: Path,
) -> None:
    before = {path: path.stat().st_mtime_ns for path in unbroken.rglob("main_data.hdf5")}
    scores = unbroken / "scores.json"
    words = (
        "evaluate",
        "--task",
        "tie",
        "--episodes",
        1,
        "--set",
        "task.horizon=1",
        "--workers",
        1,
    )
    assert knotgym(*words, "--quiet", "--out", scores) == 0
    assert knotgym(*CHEAP, "--resume", "--scores", scores, "--quiet", "--out", unbroken) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    page = (unbroken / "knotgym" / "README.md").read_text()
    assert "**0.0** (0 to 79, of 1) |" in page and "DreamerV3, published" in page
    scores.unlink()
    part = SuiteConfig(
        tasks=("unknot",),
        nx=(2,),
        policies=("random",),
        states=("readable",),
        splits=("train",),
        episodes={"random": 1},
    )
    make_suite(part, unbroken, RunOptions(workers=1, quiet=True, resume=True))
    assert len(card(unbroken)["sets"]) == 2  # of which one was asked for


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ("--task", "trefoil"),
            "the suite's tasks must be among unknot, tie, convert; got trefoil",
        ),
        (("--nx", "5"), "the suite's nx must be among 2, 3, 4; got 5"),
        (
            ("--states", "mine.h5"),
            "the suite's states must be among readable, random-walk; got mine.h5",
        ),
        (("--policies", "mixed"), "the suite's policies must be among random, noisy"),
        (("--split", "test"), "the suite's splits must be among train, train-code; got test"),
        (("--episodes", "expert:3"), "--episodes takes a number, or one per policy"),
        (("--episodes", "dreamer=3"), "episodes are set for random, noisy"),
        (("--episodes", "0"), "episodes must be a whole number of at least 1, got 0"),
        (("--observation", "smell"), "no observation 'smell'"),
        (("--scores", "pyproject.toml"), "pyproject.toml isn't a file of `knotgym evaluate"),
    ],
)
def test_what_the_suite_has_not_is_one_line(
    words: tuple[str, ...],
    complaint: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert knotgym("suite", *words, "--quiet", "--out", tmp_path / "out") == 2
    said = capfd.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_set_of_another_size_is_refused_before_anything_is_made(
    unbroken: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = (*WORDS, "--policies", "noisy,random", "--episodes", 6, "--resume")
    assert knotgym(*words, "--quiet", "--out", unbroken) == 2
    assert "config.episodes is 1 there and 6 here" in capfd.readouterr().err
    assert not (unbroken / ID.format("noisy")).exists()
