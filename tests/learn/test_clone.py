"""The clone: what it learns, how it acts, and who may read its files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from knotgym.common import InvalidInput, InvalidPolicy, Stream
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig
from knotgym.learn.clone_network import CloneNetwork, inputs
from knotgym.learn.training_data import Examples, demonstrate
from knotgym.rope import ChainSimulation, WaypointFollower
from knotgym.topology import GaussCode, label_many

from .conftest import CLONE, TASK, train, weights

pytestmark = pytest.mark.clients


def test_its_episodes_do_not_depend_on_the_lanes_beside_them(clone: Path) -> None:
    policy = make_policy(PolicyConfig(policy=str(clone)))
    one, other = (rollouts(policy, TASK, range(5), lanes=lanes) for lanes in (5, 2))
    assert one.differences(other) == []
    starts = np.flatnonzero(one.steps["macro_start"])
    assert len(starts) >= 5 and (np.abs(one.steps["macro_side"][starts]) == 1).all()


def test_the_one_that_ships_reaches_easy_goals() -> None:
    task = TaskConfig(task="tie", nx=2, split="test", observation="state", engine="chain")
    seeds = [Stream.EPISODE.derived_seed(0, number) for number in range(8)]
    policy = make_policy(PolicyConfig(policy="pretrained-clone"))
    assert rollouts(policy, task, seeds).episodes["success"].sum() >= 5


def test_pictures_are_enough_to_choose_but_name_no_position(clone: Path) -> None:
    policy = make_policy(PolicyConfig(policy=str(clone)))
    task = replace(TASK, observation="pixels", action="macro", horizon=3)
    assert rollouts(policy, task, [0]).episodes["length"][0] > 0
    with pytest.raises(InvalidPolicy, match="action pull instead of macro"):
        policy.compatible_task(replace(task, action="pull"))


def test_decisions_of_failed_episodes_are_judged_but_not_imitated(played: Episodes) -> None:
    own = Examples.of(played, first=7)
    assert {*own.episodes[own.worked].tolist()} == {7, 8}
    assert {*own.episodes[~own.worked].tolist()} == {9}
    losses = CloneNetwork(16, 1).loss(
        inputs(own[:4]), torch.from_numpy(own.macros).long(), torch.from_numpy(own.worked)
    )
    assert (losses[own.worked] > 0).all()
    assert not losses[~own.worked][:, :3].any() and (losses[:, 3] > 0).all()


def test_a_learner_that_plays_while_it_trains_learns_the_same(
    data: Path, clone: Path, tmp_path: Path
) -> None:
    out, logged = tmp_path / "watched", list[tuple[int, dict[str, float]]]()
    train([data], out, replace(CLONE, trials=2), log=lambda *row: logged.append(row))
    assert weights(out) == weights(clone)
    curve = np.genfromtxt(out / "training.csv", delimiter=",", names=True)
    assert set(curve["success"]) <= {0.0, 0.5, 1.0} and [step for step, _ in logged] == [1, 2, 3, 4]
    assert {*logged[0][1]} == {"training", "held_out", "success"}


def test_a_set_without_macro_actions_is_refused(played: Episodes, tmp_path: Path) -> None:
    from .conftest import published

    names = [name for name in played.steps if not name.startswith("macro")]
    plain = Episodes(played.episodes, played.steps.only(*names))
    with pytest.raises(InvalidInput, match="doesn't say which macro-actions"):
        train([published(tmp_path, plain)], tmp_path / "none", CLONE)


def test_demonstrations_are_made_on_the_way_by_any_number_of_workers(tmp_path: Path) -> None:
    config = replace(CLONE, demonstrations=3, copies=1, nx=(1, 2), trials=2)
    one, other = (train([], tmp_path / name, config) for name in ("one", "other"))
    card = json.loads((one / "policy.json").read_text())
    assert card["episodes"] == 6 and card["decisions"] >= 12
    curve = np.genfromtxt(one / "training.csv", delimiter=",", names=True)
    assert card["held_out_loss"] == pytest.approx(np.min(curve["held_out"]), abs=1e-4)
    assert card["kept_step"] in curve["step"]
    assert weights(one) == weights(other)


def test_examples_lead_where_they_say_in_any_frame_and_numbering() -> None:
    config = replace(CLONE, demonstrations=24, copies=3, nx=(1,), states="bench")
    data = Examples(**demonstrate(config, "tie", 1, 0))
    kinks = np.count_nonzero(data.goal[:, :, 0], axis=1) == 2  # visits of the goal
    chosen = np.flatnonzero(kinks & (data.code[:, 0, 0] == 0))
    one = Examples._make([column[chosen] for column in data])
    count = len(one.worked)
    assert count > 60 and len(np.unique(one.goal, axis=0)) == 1  # the frame makes both kinks one
    ropes, follower = ChainSimulation(count), WaypointFollower(count)
    ropes.set_points(one.points.astype(np.float64), np.zeros((count, 100, 3)))
    passes = np.column_stack([one.macros[:, :2], 2 * one.macros[:, 2].astype(int) - 1])
    ids, goal = np.arange(count), GaussCode.parse("1+,1-")
    follower.begin_passes(ids, passes, ropes.points)
    reached = np.zeros(count, bool)
    for _ in range(10):
        follower.arrive(ropes.points, ids)
        forces = follower.forces(ropes.points, ids).astype(np.float64)
        ropes.step(follower.beads, forces * ropes.max_force)
        reached |= [code.matches(goal) for code in label_many(ropes.points)]
    # ropes are laid at rest, and where they moved a close call goes the other way
    works, in_vain = reached[one.worked].mean(), reached[~one.worked].mean()
    assert works > 0.6 and works > in_vain + 0.2


def test_an_absent_device_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(InvalidInput, match="needs a GPU"):
        train([], tmp_path / "none", replace(CLONE, demonstrations=1, device="cuda"))
    assert not any(tmp_path.iterdir())
