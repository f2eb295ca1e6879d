import io
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from knotgym.generate.merge_evaluations import merge_evaluations
from rich.console import Console

from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidInput, Occupied
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import make_policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import DATASET, EVALUATION, episode_seed, rollout
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes import evaluate as evaluation
from knotgym.generate.episodes.evaluate import evaluate, film, report, run, sources_of
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.generate.episodes.results import show
from knotgym.rope.model import RopeConfig
from knotgym.runs.executors import InProcess
from knotgym.runs.run_options import RunOptions
from knotgym.runs.shards import Shard
from knotgym.runs.staging import staging_folder
from knotgym.states.state_file import States, write_states

QUIET = RunOptions(workers=1, quiet=True)


def config(states_path: str, **settings: object) -> EvaluateConfig:
    task = TaskConfig(task="unknot", states=states_path, observation="state", horizon=5)
    fields: dict[str, Any] = {
        "policies": (PolicyConfig(policy="random"),),
        "tasks": ("unknot",),
        "nx": (1,),
        "episodes": 9,
        "task": task,
    }
    return EvaluateConfig(**{**fields, **settings})


def test_every_setup_gets_its_row_in_order(states_path: str) -> None:
    results, _ = evaluate(
        config(
            states_path, tasks=("unknot", "tie"), nx=(1, 2), splits=("train", "test"), episodes=1
        ),
        InProcess(),
    )
    found = [(one.task, one.split, one.nx) for one in results]
    assert found == [
        (task, split, nx)
        for task in ("unknot", "tie")
        for split in ("train", "test")
        for nx in (1, 2)
    ]


@pytest.mark.slow  # tests/control/test_expert.py plans to the goal
def test_an_expert_beats_random_and_says_what_planning_took(states_path: str) -> None:
    policies = (
        PolicyConfig(policy="random"),
        PolicyConfig(policy="expert", planner=PlannerConfig(budget=300, batch_size=4)),
    )
    (worse, better), _ = evaluate(
        config(
            states_path,
            policies=policies,
            episodes=3,
            task=TaskConfig(task="unknot", states=states_path, observation="state", horizon=25),
        ),
        InProcess(),
    )
    assert better.success_rate > worse.success_rate and better.success_rate > 0.8
    assert better.planned_actions > 0 == worse.planned_actions
    assert better.mean_return == pytest.approx(
        5 * better.success_rate - 5 * (1 - better.success_rate)
    )
    assert better.steps is not None and better.steps < 25


def test_the_file_holds_the_rate_the_interval_and_the_settings(
    states_path: str, tmp_path: Path
) -> None:
    made = config(states_path)
    results = run(made, QUIET, out=tmp_path / "r.json")
    held = json.loads((tmp_path / "r.json").read_text())
    assert held == json.loads(json.dumps(report(made, results, sources_of(made))))
    assert (
        0 <= held["success_rate"] <= 1
        and held["interval"][0] <= held["success_rate"] <= held["interval"][1]
    )
    assert held["settings"]["seed"] == 0 and held["settings"]["policies"][0]["policy"] == "random"


def test_states_that_the_file_lacks_are_refused_before_any_work(
    states_path: str, tmp_path: Path
) -> None:
    made = config(states_path, nx=(1, 6))
    with pytest.raises(InvalidInput, match="no states with nx = 6 in split 'test'"):
        run(made, QUIET, out=tmp_path / "r.json")
    assert not (tmp_path / "r.json").exists()


def test_the_result_says_whose_states_were_used(
    states: States, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_states(tmp_path / "nx1.h5", states.taken(np.flatnonzero(states.nx == 1)))
    results, _ = evaluate(config(str(tmp_path / "nx1.h5"), episodes=1), InProcess())
    assert (results[0].start_states, results[0].goal_states) == ("own", "shipped")
    show(results, Console())
    assert "unknot nx 1: the state file has no plain loops" in capsys.readouterr().out


@pytest.mark.thorough
def test_workers_do_not_change_the_result(states_path: str) -> None:
    from knotgym.runs.executors import executor

    with executor(2) as pool:
        assert (
            evaluate(config(states_path), pool)[0] == evaluate(config(states_path), InProcess())[0]
        )


@pytest.mark.parametrize("name", ["film.gif", "film.mp4"])
def test_a_film_shows_every_state_of_its_episodes(
    name: str, states_path: str, tmp_path: Path
) -> None:
    run(config(states_path, episodes=1, filmed=1), QUIET, video=tmp_path / name)
    reel = cv2.VideoCapture(str(tmp_path / name))
    frames = []
    while (read := reel.read())[0]:
        frames.append(read[1])
    assert len(frames) >= 3 and np.ptp(frames[0]) > 0


def test_a_film_shows_every_view_in_colours(states_path: str) -> None:
    task = TaskConfig(
        task="unknot", nx=1, states=states_path, horizon=1, views=("top", "left"), depth=True
    )
    _, episodes = evaluate(config(states_path, episodes=1, filmed=1, task=task), InProcess())
    frames = film(episodes[0], task)
    height, width, channels = frames[0].shape
    assert height > 2 * 384 and (width, channels) == (2 * 384, 3)


@pytest.mark.parametrize("settings", [{"episodes": 0}, {"seed": -1}, {"nx": ()}, {"policies": ()}])
def test_settings_that_make_no_sense_are_refused(
    settings: dict[str, object], states_path: str
) -> None:
    with pytest.raises(InvalidInput):
        config(states_path, **settings)


def test_the_command_prints_the_matrix(
    states_path: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from knotgym.cli.main import main

    words = [
        "evaluate",
        "--task",
        "unknot",
        "--nx",
        "1,2",
        "--split",
        "train,test",
        "--episodes",
        "1",
        "--states",
        states_path,
    ]
    with pytest.raises(SystemExit) as left:
        main([*words, "--set", "task.horizon=2", "--workers", "1"])
    assert left.value.code == 0
    assert "success, %" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ["--nx", "9"],
        ["--policy", "x.onnx"],
        ["--video", "film.avi"],
        ["--episodes", "0"],
        ["--task", "tie,knit"],
    ],
)
def test_a_mistake_is_one_line_and_status_2(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    from knotgym.cli.main import main

    with pytest.raises(SystemExit) as left:
        main(["evaluate", *words])
    assert left.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


# Interrupted, and gone on with.


def to_file(made: EvaluateConfig, out: Path, **words: Any) -> None:
    run(made, replace(QUIET, **words), out=out)


def counted_pieces(monkeypatch: pytest.MonkeyPatch, most: int) -> list[object]:
    """Pieces played from now on; a person stops the evaluation after `most`."""
    play, pieces = evaluation._play, list[object]()

    def one(piece: Any) -> Any:
        if len(pieces) == most:
            raise KeyboardInterrupt
        pieces.append(piece)
        return play(piece)

    monkeypatch.setattr(evaluation, "_play", one)
    return pieces


@pytest.fixture
def interrupted(states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that an evaluation would have written, stopped after two pieces of three."""
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        counted_pieces(stopped, 2)
        to_file(config(states_path, episodes=17), tmp_path / "r.json")
    assert not (tmp_path / "r.json").exists()
    return tmp_path / "r.json"


def test_an_interrupted_evaluation_goes_on_to_the_same_bytes(
    states_path: str, interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = config(states_path, episodes=17)
    to_file(made, interrupted.with_name("unbroken.json"))
    pieces = counted_pieces(monkeypatch, 1)
    to_file(made, interrupted, resume=True)
    assert interrupted.read_bytes() == interrupted.with_name("unbroken.json").read_bytes()
    to_file(made, interrupted, resume=True)  # finished: nothing is played again
    assert len(pieces) == 1
    assert {path.name for path in interrupted.parent.iterdir()} == {"r.json", "unbroken.json"}


def test_an_evaluation_of_other_settings_is_not_gone_on_with(
    states_path: str, interrupted: Path
) -> None:
    with pytest.raises(InvalidInput, match="config.seed is 0 there and 1 here"):
        to_file(config(states_path, episodes=17, seed=1), interrupted, resume=True)
    with pytest.raises(Occupied, match="--resume continues it, --restart deletes it"):
        to_file(config(states_path, episodes=1), interrupted)
    to_file(config(states_path, episodes=1), interrupted, restart=True)
    with pytest.raises(InvalidInput, match="config.episodes is 1 there and 2 here"):
        to_file(config(states_path, episodes=2), interrupted, resume=True)
    interrupted.write_text('{"version": 1}')
    with pytest.raises(Occupied, match="exists already"):
        to_file(config(states_path, episodes=2), interrupted, resume=True)
    with pytest.raises(InvalidInput, match="--resume and --restart need the --out"):
        run(config(states_path), replace(QUIET, resume=True))


def test_an_evaluation_that_fails_at_once_leaves_nothing(
    states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted_pieces(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        to_file(config(states_path), tmp_path / "r.json")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("spoilt", ["{}", '{"0": [[1]]}', "no JSON"])
def test_what_was_played_is_played_again_if_it_is_corrupted(
    spoilt: str, states_path: str, interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (staging_folder(interrupted) / "000000.json").write_text(spoilt)
    pieces = counted_pieces(monkeypatch, 2)
    to_file(config(states_path, episodes=17), interrupted, resume=True)
    assert len(pieces) == 2


# What was played, and by whom: the file holds digests, and resuming compares them.


MODULE = "import beside\n\ndef act(observation):\n    return [beside.PULL] * 6\n"


@pytest.fixture
def own_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a module whose policy pulls as a file beside it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("resumed_policy", "beside"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "resumed_policy.py").write_text(MODULE)
    (tmp_path / "beside.py").write_text("PULL = 0.5\n")
    (tmp_path / "other.py").write_text("PULL = 0.25\n")
    return tmp_path


def test_the_file_holds_digests_of_policy_states_code_and_rope(
    own_policy: Path, states_path: str
) -> None:
    made = config(states_path, policies=(PolicyConfig(policy="resumed_policy:act"),), episodes=1)
    to_file(made, own_policy / "r.json")
    told = json.loads((own_policy / "r.json").read_text())["digests"]
    assert told["policies"] == {
        "resumed_policy:act": {
            name: sha256(own_policy / name) for name in ("beside.py", "resumed_policy.py")
        }
    }
    assert told["states"] == {"own": sha256(states_path)}
    assert told["rope"] == RopeConfig().fingerprint
    assert {"knotgym", "code", "mujoco"} <= told["versions"].keys()


@pytest.mark.parametrize("swapped", ["states.h5", "resumed_policy.py", "beside.py"])
@pytest.mark.parametrize("finished", [True, False])
def test_a_file_swapped_in_between_is_refused_by_name(
    swapped: str,
    finished: bool,
    own_policy: Path,
    states: States,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_states(own_policy / "states.h5", states)
    made = config(
        str(own_policy / "states.h5"),
        policies=(PolicyConfig(policy="resumed_policy:act"),),
        episodes=9,
    )
    if finished:
        to_file(made, own_policy / "r.json")
    else:
        with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
            counted_pieces(stopped, 1)
            to_file(made, own_policy / "r.json")
    if swapped == "states.h5":
        write_states(own_policy / swapped, states.taken(np.arange(len(states))[::-1]))
    else:
        with (own_policy / swapped).open("a") as file:
            file.write("# changed\n")
    name = "states.own" if swapped == "states.h5" else re.escape(swapped)
    with pytest.raises(InvalidInput, match=rf"{name} is .* there and .* here"):
        to_file(made, own_policy / "r.json", resume=True)


def test_a_file_swapped_while_episodes_are_played_is_refused(
    own_policy: Path, states_path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    play = evaluation._play

    def swap(piece: Any) -> Any:
        (own_policy / "beside.py").write_text("PULL = 1\n")
        return play(piece)

    monkeypatch.setattr(evaluation, "_play", swap)
    made = config(states_path, policies=(PolicyConfig(policy="resumed_policy:act"),), episodes=1)
    with pytest.raises(InvalidInput, match="changed while episodes were played.*beside.py"):
        to_file(made, own_policy / "r.json")
    assert not (own_policy / "r.json").exists()


def test_no_seed_makes_an_evaluation_play_the_episodes_of_a_dataset(states_path: str) -> None:
    seeds = [
        {episode_seed(seed, number, streams) for seed in range(20) for number in range(200)}
        for streams in (DATASET, EVALUATION)
    ]
    assert not seeds[0] & seeds[1]
    # learners that train online seed rope i with s + i: below any seed of an evaluation
    assert min(seeds[1]) > 2**32
    made = config(states_path, splits=("train",), episodes=2, filmed=2)
    _, films = evaluate(made, InProcess())
    task = replace(made.task, nx=1, split="train")
    trained = rollout(task, make_policy(made.policies[0]), range(2), made.seed)
    assert [one.seed for one in films] == [episode_seed(0, i, EVALUATION) for i in range(2)]
    for scored, stored in zip(films, trained, strict=True):
        assert scored.seed != stored.episode.seed
        assert not np.array_equal(scored.actions[0], stored.episode.actions[0])


def test_a_result_says_in_which_view_the_policy_acted(states_path: str) -> None:
    task = TaskConfig(task="tie", states=states_path, observation="state", action="macro")
    (result,), _ = evaluate(
        config(states_path, task=replace(task, horizon=5), episodes=1), InProcess()
    )
    assert result.action == "macro"
    console = Console(record=True, width=80, file=io.StringIO())
    show([result], console)
    assert "random (macro)" in console.export_text()


@pytest.mark.thorough
def test_merged_shards_say_what_one_evaluation_says(states_path: str, tmp_path: Path) -> None:
    asked, out = config(states_path, episodes=7, nx=(1, 2)), tmp_path / "one.json"
    run(asked, QUIET, out=out)
    parts = [Shard(number, 3).file(out) for number in (2, 1, 3)]
    for number in (2, 1, 3):
        run(asked, replace(QUIET, shard=Shard(number, 3)), out=out)
    merge_evaluations(parts, tmp_path / "merged.json")
    one, merged = (
        json.loads((tmp_path / name).read_text()) for name in ("one.json", "merged.json")
    )
    for rows in (one["results"], merged["results"]):
        for row in rows:
            for name in ("mean_return", "planned_actions"):
                row[name] = pytest.approx(row[name])
            del row["planning_seconds"]  # wall time
    assert merged == one

    for chosen, why in (
        (parts[:2], "all 3 shards are needed"),
        ([*parts, parts[0]], "each once; got 1, 2, 2, 3"),
        ([out], "isn't a shard"),
    ):
        with pytest.raises(InvalidInput, match=why):
            merge_evaluations(chosen, tmp_path / "none.json")
    with pytest.raises(InvalidInput, match="their settings differ"):
        run(replace(asked, seed=5), replace(QUIET, shard=Shard(1, 3), overwrite=True), out=out)
        merge_evaluations(parts, tmp_path / "none.json")
    with pytest.raises(InvalidInput, match="a shard needs the --out"):
        run(asked, replace(QUIET, shard=Shard(1, 3)))
    assert not (tmp_path / "none.json").exists()
