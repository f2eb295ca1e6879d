import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from pytest_types import Capture, Patch

from knotgym.common import InvalidInput, Stream, sha256
from knotgym.control import PolicyConfig, PullPlannerConfig
from knotgym.datasets import columns_of, merge, open_episodes, select, write_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import collection as collecting
from knotgym.generate import verify
from knotgym.generate.collection import _distinct_id, collect, run_facts
from knotgym.generate.episode_configs import CollectConfig
from knotgym.rope import RopeConfig
from knotgym.runs import RunOptions

from ..small_job import knotgym

QUIET = RunOptions(workers=1, quiet=True)
CHAIN = TaskConfig(task="tie", nx=2, engine="chain", observation="state", horizon=8)


def config(**settings: Any) -> CollectConfig:
    policy = PolicyConfig(policy=settings.pop("policy", "random"))
    return CollectConfig(**{"task": CHAIN, "policy": policy, "episodes": 6, **settings})


@pytest.mark.parametrize(
    "name, value", [("ref_min_score", 3.0), ("algorithm_name", "expert"), ("author", ["Eve"])]
)
def test_metadata_that_are_not_the_run_s_or_the_task_s_are_faults(
    name: str, value: Any, tmp_path: Path
) -> None:
    """Minari normalizes returns by the reference scores that stand in the file."""
    usual = replace(CHAIN, horizon=TaskConfig(task="tie").horizon)
    asked = config(task=usual, episodes=2, author=("Ann",))
    file = collect(asked, tmp_path, QUIET) / "data" / "episodes.h5"
    assert verify(file) == []
    made = open_episodes(file)
    about = {**(made.metadata or {}), name: value}
    write_episodes(file, [made.episodes], made.task, {**made.facts, "metadata": about})
    for theirs in ("main_data.hdf5", "metadata.json"):
        (file.parent / theirs).unlink()
    (fault,) = verify(file)
    assert f"{name} is" in fault


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize("name", ["expert", "constant"])
def test_who_names_another_policy_everywhere_is_found_out_or_only_claims(
    name: str, tmp_path: Path, capsys: Capture
) -> None:
    """The name in metadata, run and rows can all be changed; the pulls are still random's."""
    file = collect(config(episodes=2), tmp_path, QUIET) / "data" / "episodes.h5"
    made = open_episodes(file)
    assert knotgym("dataset", "verify", file) == 0 and "claimed" not in capsys.readouterr().err
    run, rows = made.facts["run"], made.episodes.episodes
    run["config"]["policy"]["policy"] = name
    episodes = made.episodes._replace(episodes=rows.replaced(policy=np.array([name] * 2)))
    about = {**(made.metadata or {}), "algorithm_name": name}
    for theirs in ("main_data.hdf5", "metadata.json"):
        (file.parent / theirs).unlink()
    for code in (run["versions"]["code"], "0" * 64):
        run["versions"]["code"] = code
        write_episodes(file, [episodes], made.task, {**made.facts, "run": run, "metadata": about})
        status, said = knotgym("dataset", "verify", file), "".join(capsys.readouterr())
        if code == "0" * 64 and name == "expert":  # whose plans may have been others then
            assert status == 0 and "again: algorithm_name, policy" in said
        else:
            assert status == 1 and f"{name}, played again, pulls otherwise" in said


def test_the_dataset_has_its_id_and_holds_every_episode(tmp_path: Path) -> None:
    folder = collect(config(), tmp_path, QUIET)
    assert folder == tmp_path / _distinct_id(config())
    made = columns_of(folder)
    assert made.episodes.episodes["seed"].tolist() == [
        Stream.EPISODE.derived_seed(0, k) for k in range(6)
    ]
    assert set(made.episodes.episodes["policy"]) == {"random"}
    assert made.task == CHAIN and verify(folder) == []
    summary = run_facts(folder)["summary"]
    assert summary["played"] == summary["kept"] == 6
    assert summary["steps"] == made.episodes.episodes["length"].sum()


def test_a_set_of_more_steps_begins_with_that_of_fewer(tmp_path: Path) -> None:
    made = {
        (steps, form): open_episodes(
            collect(
                config(steps=steps, form=form, dataset_id=f"a/{form}{steps}-v0"), tmp_path, QUIET
            )
        )
        for steps, form in ((40, "columns"), (130, "columns"), (130, "recording"))
    }
    few, many, pulls = (one.episodes for one in made.values())
    whole, alike = (one.digests["digest"] for one in [*made.values()][1:])
    lengths = few.episodes["length"]
    assert lengths.sum() - lengths[-1] < 40 <= lengths.sum()
    assert few.differences(many.select(np.arange(len(lengths)))) == []
    assert pulls.is_recording and whole == alike


def test_a_set_of_steps_is_verified_by_the_episodes_that_they_took(tmp_path: Path) -> None:
    asked = config(steps=90, episodes=2, form="columns")  # `steps` takes the place of `episodes`
    assert verify(made := collect(asked, tmp_path, QUIET)) == []
    found = open_episodes(made)
    seeds = found.episodes.episodes["seed"].copy()
    assert len(seeds) > asked.episodes
    seeds[-1] = Stream.EPISODE.derived_seed(0, len(seeds))
    spoilt = found.episodes._replace(episodes=found.episodes.episodes.replaced(seed=seeds))
    write_episodes(open_episodes(made).path, [spoilt], found.task, found.facts)
    faults = verify(made)
    assert any("its seed is none of the run's" in fault for fault in faults), faults


def test_bytes_do_not_depend_on_blocks(tmp_path: Path, monkeypatch: Patch) -> None:
    one = collect(config(), tmp_path / "one", QUIET)
    monkeypatch.setattr(collecting, "blocks", lambda *_: [range(2), range(2, 3), range(3, 6)])
    two = collect(config(), tmp_path / "two", QUIET)
    assert len({sha256(folder / "data/episodes.h5") for folder in (one, two)}) == 1


def test_labels_are_the_expert_s_and_change_nothing_that_is_played(tmp_path: Path) -> None:
    plain = columns_of(collect(config(episodes=2), tmp_path, QUIET)).episodes
    folder = collect(config(episodes=2, labels="expert"), tmp_path, QUIET)
    labelled = columns_of(folder).episodes
    assert "-labelled-" in folder.name
    assert plain.differences(labelled) == [] and labelled.steps["expert_action"].any()


def test_failed_episodes_are_dropped_when_asked_and_counted(tmp_path: Path) -> None:
    task = TaskConfig(task="unknot", nx=1, engine="chain", observation="state", horizon=12)
    asked = config(task=task, policy="scripted", episodes=12, keep_failed=False)
    folder = collect(asked, tmp_path, QUIET)
    summary = run_facts(folder)["summary"]
    assert columns_of(folder).episodes.episodes["success"].all()
    assert 0 < summary["kept"] == summary["succeeded"] < summary["played"] == 12
    with pytest.raises(InvalidInput, match="none of 2 episodes reached the goal"):
        collect(config(policy="constant", episodes=2, keep_failed=False), tmp_path, QUIET)
    assert [path.parents[1] for path in tmp_path.rglob("episodes.h5")] == [folder]


def test_datasets_hold_their_origin(tmp_path: Path, monkeypatch: Patch, states_path: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "collected_policy", raising=False)
    (tmp_path / "collected_policy.py").write_text("act = lambda seen: [0.5] * 6\n")
    task = TaskConfig(task="unknot", nx=1, states=states_path, horizon=2, observation="state")
    folder = collect(config(task=task, policy="collected_policy:act", episodes=1), tmp_path, QUIET)
    digests = (open_episodes(folder).metadata or {})["digests"]
    assert digests["states"] == {"own": sha256(states_path)}
    file = "collected_policy.py"
    assert digests["policies"] == {"collected_policy:act": {file: sha256(tmp_path / file)}}
    assert digests["rope"] == RopeConfig().fingerprint
    assert digests["versions"]["code"]


def test_ids_tell_every_setting_that_changes_the_data() -> None:
    usual = config(task=CollectConfig().task, policy="expert")  # vertices
    budget = PolicyConfig(policy="expert", planner=PullPlannerConfig(budget=7))
    changes: dict[str, Any] = {"nx": 3, "split": "test", "states": "random-walk", "horizon": 7}
    changes |= {"engine": "chain", "observation": "both", "max_goals": 2}
    others = [
        replace(usual, seed=1),
        replace(usual, keep_failed=False),
        replace(usual, labels="expert"),
        replace(usual, policy=budget),
        *(replace(usual, policy=PolicyConfig(policy=f"mine:{one}")) for one in ("act", "other")),
        *(
            replace(usual, task=replace(usual.task, **{name: value}))
            for name, value in changes.items()
        ),
    ]
    ids = [_distinct_id(one) for one in (usual, *others)]
    assert ids[0] == "knotgym/tie-nx2/expert-v0" and len(set(ids)) == len(ids)


def test_sets_of_several_tasks_are_collected_and_merged(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rules = ("--set", "task.horizon=2", "--set", "task.max_goals=2")
    words = ("--episodes", 9, "--policy", "random", "--engine", "chain", "--workers", 1, *rules)
    several = ("collect", "--task", "tie,convert", "--nx", "2,3", *words, "--observation", "state")
    assert knotgym(*several, "--quiet", "--id", "knotgym/one-v0") == 0
    assert knotgym(*several, "--quiet") == 0
    apart = sorted(f"{one.parent.name}/{one.name}" for one in tmp_path.glob("knotgym/*-nx*/*"))
    assert [one.partition("/")[0] for one in apart] == [
        *("convert-nx2", "convert-nx3", "tie-nx2", "tie-nx3")
    ]
    made = columns_of(f"knotgym/{apart[-1]}")
    env: Any = gym.make("knotgym/Tie-v0", nx=3, max_goals=2).unwrapped
    assert made.task.max_goals == 2
    assert {*made.episodes.episodes["goal"]} <= {*env.episodes.rows["goal"]}
    specs = json.loads((tmp_path / f"knotgym/{apart[-1]}/data/metadata.json").read_text())
    limits = [
        json.loads(specs[name])["kwargs"]["max_goals"] for name in ("env_spec", "eval_env_spec")
    ]
    assert limits == [2, None]
    merge([f"knotgym/{one}" for one in apart], None, "knotgym/merged-v0")
    for name in ("one", "merged"):
        assert verify(f"knotgym/{name}-v0") == []
    chosen = select("knotgym/merged-v0", tmp_path.parent / "c.h5", where="task = 'tie' and nx = 3")
    assert open_episodes(chosen).episodes.episodes.rows == 9


@pytest.mark.parametrize(
    ("settings", "scores"),
    [
        ({"states": "bench", "engine": "chain"}, (-4.4141, 5.0, 512)),
        ({"nx": 3}, (-5.0, 5.0, 64)),
        ({"states": "bench"}, (None, None, None)),
        *(
            ({name: value}, (None, None, None))  # other rules than the scores were measured with
            for name, value in {"horizon": 10, "failure_reward": 0.0, "max_goals": 3}.items()
        ),
        ({"split": "train-code"}, (None, None, None)),
    ],
)
def test_reference_scores_are_those_of_the_states_engine_and_rules(
    settings: dict[str, Any], scores: tuple[float | None, ...]
) -> None:
    config = CollectConfig(
        task=TaskConfig(task="tie", **settings),
        policy=PolicyConfig(policy="random"),
        dataset_id="a/b-v0",
    )
    total = dict.fromkeys(("played", "kept", "succeeded", "planned"), 1)
    found = collecting._metadata(config, total)
    own = (found.ref_min_score, found.ref_max_score, found.num_episodes_average_score)
    assert own == scores
    assert ("knotgym evaluate" in found.description) == (scores[0] is not None)
