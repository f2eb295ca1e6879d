"""Training: the same bytes every time, interrupted or not, and on nothing but train episodes."""

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from knotgym.common import InvalidFile, InvalidInput, MissingFile, Occupied
from knotgym.datasets import Episodes
from knotgym.learn.training import Training
from knotgym.learn.training_data import TrainingData
from knotgym.states import shipped

from ..small_job import knotgym, staging_of
from .conftest import CLONE, READER, TASK, break_off, published, put_card, train, weights

pytestmark = pytest.mark.clients


@pytest.mark.parametrize("config", [READER, CLONE], ids=["reader", "clone"])
def test_training_may_be_interrupted(config: Any, data: Path, tmp_path: Path, request: Any) -> None:
    whole = request.getfixturevalue("learner" if config is READER else "clone")
    out = tmp_path / "broken"
    break_off([data], out, config)
    assert not out.exists()
    with pytest.raises(Occupied, match="--resume continues it"):
        train([data], out, config)
    with pytest.raises(InvalidInput, match="seed is 0 there and 1 here"):
        train([data], out, replace(config, seed=1), resume=True)
    train([data], out, config, resume=True)
    assert weights(out) == weights(whole)
    assert (out / "policy.json").read_bytes() == (whole / "policy.json").read_bytes()
    assert not staging_of(out).exists()
    train([data], out, config, resume=True)  # it is finished already


def test_another_seed_gives_others(data: Path, learner: Path, tmp_path: Path) -> None:
    assert weights(train([data], tmp_path / "other", replace(READER, seed=1))) != weights(learner)


def test_the_curve_and_the_card_say_how_it_was_trained(learner: Path) -> None:
    with (learner / "training.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows and {"step", "join", "correct", "success"} == set(rows[0])
    assert (learner / "curve.png").stat().st_size > 0
    card = json.loads((learner / "policy.json").read_text())
    assert card["episodes"] == 3 and card["config"]["steps"] == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "test"}, "test split"),
        ({"integrator_steps": 30, "engine": "mujoco"}, "30 integrator steps"),
    ],
)
def test_others_are_refused(changes: Any, message: str, played: Episodes, tmp_path: Path) -> None:
    other = published(tmp_path, played, replace(TASK, **changes))
    with pytest.raises(InvalidInput, match=message):
        train([other], tmp_path / "new", READER)
    assert not (tmp_path / "new").exists()


def test_nothing_to_learn_from_is_one_line(played: Episodes, tmp_path: Path) -> None:
    for config in (READER, CLONE):
        with pytest.raises(InvalidInput, match="nothing to learn from"):
            train([], tmp_path / "new", config)
    with pytest.raises(InvalidInput, match="has no episodes"):
        train([published(tmp_path, played.select([]))], tmp_path / "new", READER)
    with pytest.raises(InvalidInput, match="no episode reached its goal"):
        train([published(tmp_path, played.select([2]), name="b")], tmp_path / "new", CLONE)
    with pytest.raises(MissingFile, match="no episodes at"):
        train([tmp_path / "no"], tmp_path / "new", READER)


def test_a_prediction_is_of_the_forces_that_were_applied(played: Episodes) -> None:
    own = TrainingData.of([played, played])
    steps, count = played.steps, played.steps.rows
    assert own.beads[0] == -1 and own.beads[count] == -1
    assert own.starts.tolist()[3:] == [count + start for start in own.starts.tolist()[:3]]
    np.testing.assert_array_equal(own.beads[1:3], steps["bead"][:2])
    np.testing.assert_array_equal(own.forces[1], steps["force"][0] * steps["applied_fraction"][0])


def test_a_damaged_checkpoint_is_not_continued_from(tmp_path: Path) -> None:
    class Tiny(Training):
        @classmethod
        def begun(cls, *given: Any) -> Any: ...
        def _advance(self) -> None: ...
        def _ended(self) -> Any: ...

    def tiny() -> Tiny:
        return Tiny(torch.nn.Linear(2, 1), 0.1, 0.0, 4)

    training, path = tiny(), tmp_path / "checkpoint"
    training._save(path)
    raw = bytearray(path.read_bytes())
    raw[-5] ^= 1
    path.write_bytes(raw)
    with pytest.raises(InvalidFile, match="can't be continued from"):
        tiny()._restore(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InvalidFile, match="isn't a regular file"):
        tiny()._restore(path)


def test_a_learner_is_evaluated_where_it_was_trained_unless_told_otherwise(
    clone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    card = json.loads((clone / "policy.json").read_text())
    setup = {"tasks": ["tie"], "nx": [2], "states": ["readable"], "engine": ["chain"]}
    assert card["trained_on"] == setup
    trained = {**setup, "tasks": ["convert"], "nx": [2, 3], "states": ["bench"]}
    other = tmp_path / "other"
    shutil.copytree(clone, other)
    put_card(other, trained_on=trained)
    words = "evaluate", "--policy", other, "--episodes", 1, "--workers", 1, "--set"

    def status(name: str, *more: object) -> int:
        return knotgym(*words, "task.horizon=2", *more, "--out", tmp_path / name)

    def played(name: str, *more: object) -> Any:
        assert status(name, *more) == 0
        return json.loads((tmp_path / name).read_text())["config"]

    own = played("own.json", "--policy", "random")
    assert (own["tasks"], own["nx"]) == (["convert"], [2, 3])
    assert (own["task"]["states"], own["task"]["engine"]) == ("bench", "chain")
    said = "as the learner was trained: tasks convert, nx 2,3, states bench, engine chain"
    assert said in "".join(capsys.readouterr())
    told = played("told.json", "--task", "tie", "--nx", "2", "--states", "readable")
    assert (told["tasks"], told["nx"], told["task"]["states"]) == (["tie"], [2], "readable")
    both = played("both.json", "--policy", clone)
    assert (both["tasks"], both["nx"], both["task"]["states"]) == (["tie"], [2], None)
    forgeries: list[tuple[Any, int]] = [("x", 0), ({"nx": "2"}, 0), ({"nx": [[]]}, 2)]
    for forged, expected in [*forgeries, ({"states": [7]}, 2), ({"tasks": ["\x1b[2J"]}, 2)]:
        put_card(other, trained_on=forged)
        assert status("forged.json", "--overwrite") == expected, forged
        shown = "".join(capsys.readouterr())
        assert "Traceback" not in shown and "\x1b" not in shown


@pytest.mark.parametrize("what", ["success", "states"])
def test_training_resumes_with_its_files(what: str, played: Episodes, tmp_path: Path) -> None:
    out = tmp_path / "out"
    config, data, states = CLONE, [published(tmp_path, played)], tmp_path / "states.h5"
    if what == "states":
        shutil.copy(shipped("readable"), states)
        config, data = replace(CLONE, demonstrations=2, states=str(states)), []

    def swap() -> None:
        if what == "states":
            shutil.copy(shipped("bench"), states)
            return
        other = played.select([0, 1, 2])
        other.episodes["success"][:] = True
        shutil.rmtree(tmp_path / "knotgym")
        published(tmp_path, other)

    break_off(data, out, config)
    kept = shutil.copytree(tmp_path, tmp_path.with_name(f"{what}-kept"))
    train(data, out, config, resume=True)
    swap()
    with pytest.raises(InvalidInput, match="source"):  # it is finished, with others
        train(data, out, config, resume=True)
    shutil.rmtree(tmp_path)
    shutil.copytree(kept, tmp_path)
    swap()
    with pytest.raises(InvalidInput, match="source"):  # it was killed
        train(data, out, config, resume=True)
    assert not out.exists()
