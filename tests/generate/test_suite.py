"""The fixed benchmark: which sets there are, how they are rebuilt, and the card over them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pytest_types import Capture, Patch

from knotgym.common import Failed, InvalidFile, InvalidInput, Occupied
from knotgym.datasets import open_episodes, write_episodes
from knotgym.generate import suite as module
from knotgym.generate.collection import collect, run_facts
from knotgym.generate.episode_configs import SuiteConfig
from knotgym.generate.suite import _describe_set, make_suite
from knotgym.runs import RunOptions

from ..fresh_interpreter import python
from ..small_job import knotgym

ID = "knotgym/unknot-nx2/{}-v0"
QUIET = RunOptions(workers=1, quiet=True)
RESUME = replace(QUIET, resume=True)
PART = SuiteConfig(
    tasks=("unknot",),
    nx=(2,),
    policies=("random", "expert"),
    splits=("train",),
    states=("readable",),
    episodes={"random": 2, "expert": 2},
    recorded=True,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small sets of one setup, of which one is rebuilt from its recording."""
    out = tmp_path_factory.mktemp("suite")
    make_suite(PART, out, QUIET)
    return out


def card(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "knotgym" / "suite.json").read_text())
    return found


def test_ropes_of_wander_begin_at_starts_and_at_goals() -> None:
    sets = [*SuiteConfig(states=("bench",), size="100k", policies=("wander",)).sets()]
    assert sets[0].dataset_id == "knotgym/unknot-nx2/wander-chain-bench-100k-v0"
    sides = {one.task.tasks for one in sets}
    assert sides == {("unknot", "tie"), ("tie", "unknot"), ("convert", "unknot")}


# a stranger adds to suite.toml a size, which isn't the default because it is first, and a tier
TIERS = """
import tomllib
read = tomllib.loads
tomllib.loads = lambda text: read(
    text.replace("[bench.sizes]\\n", '[bench.sizes]\\n1k = { steps = 1_000, form = "columns" }\\n')
    .replace('["random", "wander",', '["random", "scripted", "wander",')
)
from knotgym.generate import SuiteConfig
sets = lambda **words: [*SuiteConfig(states=("bench",), **words).sets()]
assert {one.steps for one in sets()} == {10_000} and len(sets()) == 70
(one,) = sets(size="1k", policies=("scripted",), tasks=("unknot",), nx=(2,))
print(one.dataset_id, one.steps, one.form)
"""


def test_a_tier_and_a_size_are_added_by_a_line_each() -> None:
    made = python("-c", TIERS)
    assert made.stdout == "knotgym/unknot-nx2/scripted-chain-bench-1k-v0 1000 columns\n", (
        made.stderr
    )


def test_a_set_is_rebuilt_by_stepping_alone_and_the_card_describes_it(made: Path) -> None:
    sets = card(made)["sets"]
    assert sets.keys() == {ID.format(policy) for policy in ("random", "expert")}
    expert = sets[ID.format("expert")]
    assert expert["recorded"] == "same" and expert["succeeded"] == 2
    episodes = open_episodes(made / ID.format("expert")).episodes
    assert not episodes.episodes["planner_steps"].any() and episodes.steps["macro_start"].any()
    assert set(episodes.episodes["policy"].tolist()) == {"expert"}
    page = (made / "knotgym" / "README.md").read_text()
    assert all(f"`{name}`" in page for name in sets) and "## Protocol" in page
    own = episodes.distinct()
    assert {name: expert[name] for name in own} == own and "| starts | goals | pairs |" in page


@pytest.mark.parametrize(
    ("column", "said"),
    [("force", "differs from episode 0"), ("reward", "differs when played again")]
    + [(name, "differs from") for name in ("action", "terminated", "macro_side")],
)
def test_a_changed_set_isn_t_the_same(column: str, said: str, made: Path, tmp_path: Path) -> None:
    data = shutil.copytree(made / ID.format("expert"), tmp_path / "expert-v0") / "data"
    if said == "differs from":  # its digest isn't made to fit
        with h5py.File(data / "episodes.h5", "a") as file:
            stored = file[f"steps/{column}"]
            stored[1] = ~stored[1] if stored.dtype == bool else -stored[1] - 1
    else:
        source = open_episodes(made / ID.format("expert"))
        steps = source.episodes.steps
        forged = steps.replaced(**{column: 0 * steps[column]})
        whole = source.episodes._replace(steps=forged)
        write_episodes(data / "episodes.h5", [whole], source.task, source.facts)
    assert _describe_set(tmp_path / "expert-v0")["recorded"].startswith(said)


def test_finished_sets_are_kept_and_the_missing_ones_made(made: Path, tmp_path: Path) -> None:
    with pytest.raises(Occupied, match="exists already"):
        make_suite(PART, made, QUIET)
    before = {path: path.stat().st_mtime_ns for path in made.rglob("episodes.h5")}
    make_suite(replace(PART, policies=("random",)), made, RESUME)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(card(made)["sets"]) == 2  # of which one was asked for
    with pytest.raises(InvalidInput, match="different run"):
        make_suite(replace(PART, episodes={"random": 3, "expert": 2}), made, RESUME)
    make_suite(replace(PART, policies=("random",)), tmp_path, QUIET)
    make_suite(PART, tmp_path, RESUME)
    for name in card(made)["sets"]:
        one, other = (open_episodes(out / name) for out in (made, tmp_path))
        assert one.episodes.differences(other.episodes) == []
        assert run_facts(made / name)["config"] == run_facts(tmp_path / name)["config"]


def test_a_machine_that_simulates_otherwise_says_so(tmp_path: Path, monkeypatch: Patch) -> None:
    def other(made: Path) -> dict[str, Any]:
        return {**_describe_set(made), "recorded": "differs from episode 1"}

    monkeypatch.setattr(module, "_describe_set", other)
    few = replace(PART, policies=("random",), episodes={"random": 1})
    with pytest.raises(Failed, match="random-v0 differs from episode 1; the sets are kept"):
        make_suite(few, tmp_path, QUIET)
    assert (tmp_path / ID.format("random")).is_dir()
    with pytest.raises(InvalidFile, match="nothing of this is recorded"):
        make_suite(replace(PART, nx=(4,), policies=("expert",)), tmp_path, QUIET)


def test_a_set_is_the_known_one_or_says_what_it_is(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    """The values are compared, in whatever files they are; one flipped bit is another set."""
    monkeypatch.setattr(module, "DIGESTS", known := dict[str, Any]())
    task = ("--task", "unknot", "--nx", "2", "--states", "bench", "--policy", "random")
    words = ("suite", *task, "--out", tmp_path, "--verify")
    name = "knotgym/unknot-nx2/random-chain-bench-10k-v0"
    assert knotgym(*words) == 1 and f"{name} isn't there" in capsys.readouterr().out
    some = SuiteConfig(tasks=("unknot",), nx=(2,), states=("bench",), policies=("random",))
    (asked,) = some.sets()
    collect(replace(asked, steps=60), tmp_path, QUIET)
    assert knotgym(*words) == 1 and "isn't known" in capsys.readouterr().out
    file = tmp_path / name / "data" / "episodes.h5"
    known[name] = {"steps": 60, "values": module._values(open_episodes(file))}
    assert knotgym(*words) == 0 and capsys.readouterr().out.endswith(": known\n")
    for one in (file, file.with_name("main_data.hdf5")):
        whole = one.read_bytes()
        with h5py.File(one, "r+") as opened:
            column = opened["steps/reward" if one == file else "episode_0/rewards"]
            column[0] = np.nextafter(column[0], 1, dtype=column.dtype)
        assert knotgym(*words) == 1, one
        one.write_bytes(whole)
    known[name]["values"] = "0" * 64
    assert knotgym(*words) == 1 and "has other values" in capsys.readouterr().out


@pytest.mark.thorough
def test_a_tier_that_is_made_here_is_the_known_one(tmp_path: Path, capsys: Capture) -> None:
    task = ("--task", "tie", "--nx", "2", "--states", "bench", "--policy", "random")
    words = ("suite", *task, "--size", "10k", "--out", tmp_path)
    assert knotgym(*words, "--workers", "1", "--quiet") == 0
    assert knotgym(*words, "--verify") == 0
    card = (tmp_path / "knotgym" / "README.md").read_text(encoding="utf-8")
    assert "tie-nx2/random-chain-bench-10k-v0" in capsys.readouterr().out and "| yes |" in card
