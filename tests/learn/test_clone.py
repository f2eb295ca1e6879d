"""The clone: what it learns, how it acts, and that a broken-off training ends the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.errors import InvalidPolicy, KnotgymError
from knotgym.control.demonstrator import passes_in_order
from knotgym.control.old_policies import make_policy
from knotgym.control.pass_counts import shipped_values
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import rollout
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import collect
from knotgym.generate.episodes.collect_config import CollectConfig
from knotgym.learn.clone_config import CloneConfig, DemonstrationsConfig, ImproveConfig
from knotgym.runs.run_options import Existing, RunOptions
from knotgym.states.state_file import States
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

from ..small_job import knotgym

pytestmark = pytest.mark.clients
pytest.importorskip("torch")
pytest.importorskip("safetensors")

TINY = {
    "guided": True,
    "failed": True,
    "steps": 4,
    "batch": 4,
    "width": 16,
    "layers": 1,
    "judge_every": 2,
    "held_out": 0.4,
}


@pytest.fixture(scope="session")
def macros(tmp_path_factory: pytest.TempPathFactory, states_path: str) -> Path:
    """Three episodes of random macro-actions, which say what was chosen."""
    out = tmp_path_factory.mktemp("macros")
    task = TaskConfig(
        task="tie", nx=2, states=states_path, observation="state", action="macro", horizon=12
    )
    config = CollectConfig(
        task=task,
        policy=PolicyConfig(policy="random"),
        episodes=3,
        dataset_id="knotgym/tie-nx2/macros-v0",
    )
    collect(config, out, RunOptions(workers=1, quiet=True))
    return out / config.dataset_id


def train_tiny(data: Path | None, out: Path, *, resume: bool = False, **changes: Any) -> Any:
    from knotgym.learn.clone_training import train_clone

    config = CloneConfig(**{**TINY, **changes})
    return train_clone(
        [data] if data else [], out, config, existing=Existing(resume=resume), quiet=True
    )


@pytest.fixture(scope="session")
def clone(tmp_path_factory: pytest.TempPathFactory, macros: Path) -> Path:
    out = tmp_path_factory.mktemp("clone") / "made"
    train_tiny(macros, out)
    return out


def weights(folder: Path) -> bytes:
    return (folder / "weights.safetensors").read_bytes()


@pytest.fixture
def task(states_path: str) -> TaskConfig:
    return TaskConfig(task="tie", nx=2, states=states_path, observation="state", horizon=8)


@pytest.mark.parametrize("view", ["macro", "pull"])
def test_it_acts_in_its_own_view_and_in_pulls(clone: Path, task: TaskConfig, view: str) -> None:
    policy = make_policy(PolicyConfig(policy=str(clone)))
    task = replace(task, action=view, engine="chain")
    first, second = rollout(policy.suited(task), policy, [0, 1], seed=0)
    assert len(first.episode) > 0 and len(second.episode) > 0


def test_both_views_give_the_same_episode(clone: Path, task: TaskConfig) -> None:
    task = replace(task, engine="chain")
    both = [
        rollout(replace(task, action=view), make_policy(PolicyConfig(policy=str(clone))), [3], 0)
        for view in ("macro", "pull")
    ]
    assert np.array_equal(both[0][0].episode.actions, both[1][0].episode.actions)


def test_the_one_that_ships_reaches_easy_goals() -> None:
    config = PolicyConfig(policy="pretrained-clone")
    task = TaskConfig(task="tie", nx=2, split="test", action="macro", engine="chain")
    policy = make_policy(config)
    played = rollout(policy.suited(task), policy, range(8), seed=0)
    assert sum(bool(one.episode.terminations[-1]) for one in played) >= 5


def test_a_guided_clone_takes_passes_of_great_worth(clone: Path, states: States) -> None:
    from knotgym.learn.clone_policy import choose_macros, load_clone

    points = states.points[:12]
    goals, cold = [GaussCode.parse("1+,1-")] * len(points), np.zeros(len(points))
    values, network = shipped_values(every_code=True), load_clone(clone).network
    network.side[2].weight.data.zero_()  # as if every macro-action worked as well
    own = choose_macros(network, points, goals, cold, [])
    guided = choose_macros(network, points, goals, cold, [], values)
    orders = [dict(passes_in_order(values, goals[0], rope)) for rope in points]
    assert sum(map(bool, orders)) >= 4
    for row, order in enumerate(orders):
        bead, target, over = guided[row].tolist()
        if not order:
            assert guided[row].tolist() == own[row].tolist()
        # an untrained network hardly tells macro-actions apart, so what they are worth decides
        elif max(order.values()) > 0.5:
            assert (bead, target, 2 * over - 1) in order


def test_pictures_are_enough(clone: Path, task: TaskConfig) -> None:
    policy = make_policy(PolicyConfig(policy=str(clone)))
    task = policy.suited(replace(task, action="macro", observation="pixels", engine="chain"))
    assert task.observation == "pixels"
    assert len(rollout(task, policy, [0], seed=0)[0].episode) > 0


def test_pictures_name_no_position(clone: Path, task: TaskConfig) -> None:
    policy = make_policy(PolicyConfig(policy=str(clone)))
    with pytest.raises(InvalidPolicy, match="action pull instead of macro"):
        policy.suited(replace(task, observation="pixels"))


def test_pulls_can_be_cloned(macros: Path, tmp_path: Path, task: TaskConfig) -> None:
    policy = train_tiny(macros, tmp_path / "pulls", action="bead")
    for view in ("bead", "pull"):
        episode = rollout(replace(task, action=view), policy, [0], seed=0)[0].episode
        assert len(episode) > 0
    with pytest.raises(InvalidPolicy, match="'bead' or 'pull'"):
        policy.suited(replace(task, action="macro"))


def test_a_set_without_macro_actions_is_refused(episodes: Path, tmp_path: Path) -> None:
    with pytest.raises(KnotgymError, match="doesn't say which macro-actions"):
        train_tiny(episodes, tmp_path / "none")


def test_episodes_that_missed_their_goal_are_not_imitated(macros: Path, tmp_path: Path) -> None:
    with pytest.raises(KnotgymError, match="reached its goal"):
        train_tiny(macros, tmp_path / "none", failed=False)


def test_a_training_broken_off_and_resumed_ends_with_the_same_weights(
    macros: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from knotgym.learn.clone_training import CloneTraining

    settings: dict[str, Any] = {"improve": 1, "round_steps": 4, "play": ImproveConfig(episodes=2)}
    train_tiny(macros, tmp_path / "whole", **settings)
    advance = CloneTraining.advance

    def break_off(training: CloneTraining, *arguments: Any) -> None:
        if training.step == 6:  # in the round of improvement
            raise KeyboardInterrupt
        advance(training, *arguments)

    monkeypatch.setattr(CloneTraining, "advance", break_off)
    with pytest.raises(KeyboardInterrupt):
        train_tiny(macros, tmp_path / "broken", **settings)
    monkeypatch.undo()
    train_tiny(macros, tmp_path / "broken", resume=True, **settings)
    assert weights(tmp_path / "broken") == weights(tmp_path / "whole")


def test_a_training_goes_on_from_an_earlier_clone(
    macros: Path, tmp_path: Path, clone: Path
) -> None:
    from knotgym.learn.clone_policy import load_clone

    policy = train_tiny(macros, tmp_path / "more", start=str(clone), steps=1, rate=1e-9)
    earlier = load_clone(clone).network.state_dict()
    for name, own in policy.network.state_dict().items():
        assert np.allclose(own, earlier[name], atol=1e-3), name
    with pytest.raises(KnotgymError, match="another width or layers than 32 and 1"):
        train_tiny(macros, tmp_path / "wider", start=str(clone), width=32)
    # before any demonstration is made
    with pytest.raises(KnotgymError, match="another width or layers than 32 and 1"):
        many = DemonstrationsConfig(episodes=10**6, led=3)
        train_tiny(None, tmp_path / "wider", start=str(clone), width=32, demonstrations=many)
    assert not [*tmp_path.glob("*wider*")]


def test_the_commands_train_and_evaluate_a_clone(
    macros: Path, tmp_path: Path, clone: Path, states_path: str
) -> None:
    settings = tmp_path / "settings.json"
    settings.write_text(json.dumps(TINY), encoding="utf-8")
    arguments = ("--data", macros, "--learner", "clone", "--settings", settings, "--quiet")
    assert knotgym("train", *arguments, "--out", tmp_path / "made") == 0
    assert weights(tmp_path / "made") == weights(clone)
    assert (tmp_path / "made" / "curve.png").is_file()
    evaluated = ("--task", "tie", "--nx", 2, "--episodes", 1, "--states", states_path)
    out = ("--engine", "chain", "--workers", 1, "--out", tmp_path / "scores")
    assert knotgym("evaluate", "--policy", clone, *evaluated, *out, "--quiet") == 0


def test_loops_are_left_out_and_codes_on_the_way_become_goals() -> None:
    from knotgym.learn.clone_data import DecidedStep, gathered, without_loops

    a, b, c = (GaussCode.parse(text) for text in ("", "1+c,1-c", "1+c,1-c,2+c,2-c"))
    points = np.zeros((100, 3), dtype=np.float32)
    way = without_loops(
        [
            DecidedStep(points, points, *codes, (bead, 50, 1))
            for bead, codes in enumerate([(a, b), (b, a), (a, b), (b, b), (b, c)])
        ]
    )
    assert [step.macro[0] for step in way] == [2, 4]
    kept = gathered(way, way, c, 7, CloneConfig(hindsight=2, copies=0))
    told = zip(
        kept.macros[:, 0, 0].tolist(), kept.goals.tolist(), kept.intended.tolist(), strict=True
    )
    assert list(told) == [(2, str(c.plain), True), (4, str(c.plain), True), (2, "1+,1-", False)]
    assert set(kept.episodes.tolist()) == {7}
    assert len(gathered(way, [], c, 7, CloneConfig(hindsight=0)).points) == 0


def test_what_was_tried_in_vain_is_judged_but_not_imitated() -> None:
    import torch

    from knotgym.learn.clone_data import NONE, DecidedStep, examples, gathered
    from knotgym.learn.clone_network import CloneNetwork, inputs

    turn = 2 * np.pi * np.arange(100) / 100
    points = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1).astype(np.float32)
    goal = GaussCode.parse("1+,1-")
    step = DecidedStep(points, points, GaussCode(), GaussCode(), (5, 50, 1), ((7, 40, -1),))
    kept = gathered([], [step], goal, 0, CloneConfig(copies=0), vain=[step])
    assert kept.macros[0, :2].tolist() == [[5, 50, 1], [7, 40, -1]]
    assert kept.macros[1, :2, 0].tolist() == [NONE, 7]
    data, network = examples(kept), CloneNetwork(16, 1)
    losses = network.macro_loss(inputs(data.seen), torch.from_numpy(data.macros))
    assert (losses[0] > 0).all() and losses[1, :3].tolist() == [0, 0, 0] and losses[1, 3] > 0


def test_copies_lead_to_the_goal_as_their_own_first_bead_reads_it(states: States) -> None:
    from knotgym.learn.clone_data import DecidedStep, gathered

    before, landed = (states.points[states.nx == nx][0].astype(np.float32) for nx in (1, 3))
    codes = [label(one.astype(float)) for one in (before, landed)]
    step = DecidedStep(before, landed, codes[0], codes[1], (10, 60, 1))
    kept = gathered([], [step], codes[1], 3, CloneConfig(copies=3))
    assert kept.intended.tolist() == [True, False, False, False]
    for points, goal, macro in zip(
        kept.points[1:], kept.goals[1:], kept.macros[1:, 0], strict=True
    ):
        base = (10 - macro[0]) % 100
        assert np.array_equal(points, np.roll(before, -base, axis=0))
        assert goal == str(label(np.roll(landed, -base, axis=0).astype(float)).plain)
        assert (macro[1] - macro[0]) % 100 == 50


def test_demonstrations_are_made_on_the_way(tmp_path: Path, task: TaskConfig) -> None:
    for name, lanes in (("one", 4), ("other", 2)):
        demonstrations = DemonstrationsConfig(
            episodes=3, lanes=lanes, starts=4, nx=(2,), wander=0, every_code=True
        )
        train_tiny(None, tmp_path / name, demonstrations=demonstrations, failed=False)
    cards = [json.loads((tmp_path / name / "policy.json").read_text()) for name in ("one", "other")]
    assert cards[0]["demonstrations_sha256"] == cards[1]["demonstrations_sha256"]
    assert cards[0]["demonstrations"]["tie 2"]["reached"] == 1
    assert cards[0]["decisions"] >= 3
    assert weights(tmp_path / "one") == weights(tmp_path / "other")


def test_a_blend_of_1_is_the_clone_that_training_began_from(
    tmp_path: Path, macros: Path, clone: Path
) -> None:
    for blend in (0.0, 1.0):
        train_tiny(macros, tmp_path / str(blend), start=str(clone), blend=blend)
    assert weights(tmp_path / "0.0") != weights(clone)
    assert weights(tmp_path / "1.0") == weights(clone)
    with pytest.raises(KnotgymError, match="set start to its folder"):
        CloneConfig(blend=0.5)


def test_demonstrations_begin_where_the_clone_led_a_rope(tmp_path: Path, clone: Path) -> None:
    own = DemonstrationsConfig(episodes=6, starts=4, nx=(2,), wander=0)
    for name, led, lanes in (("none", 0, 4), ("led", 3, 4), ("again", 3, 2)):
        demonstrations = replace(own, led=led, lanes=lanes)
        train_tiny(None, tmp_path / name, demonstrations=demonstrations, start=str(clone))
    none, led, again = (
        json.loads((tmp_path / name / "policy.json").read_text())
        for name in ("none", "led", "again")
    )
    assert led["demonstrations_sha256"] == again["demonstrations_sha256"]
    assert led["demonstrations_sha256"] != none["demonstrations_sha256"]
    assert led["start_sha256"] == json.loads((clone / "policy.json").read_text())["weights_sha256"]
    with pytest.raises(KnotgymError, match="set start to its folder"):
        CloneConfig(demonstrations=replace(own, led=1))


def test_a_killed_training_keeps_the_demonstrations_that_are_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from knotgym.learn import clone_demonstrations as module
    from knotgym.learn.clone_data import save_decisions

    demonstrations = DemonstrationsConfig(episodes=3, lanes=2, starts=4, wander=0)
    train_tiny(None, tmp_path / "whole", demonstrations=demonstrations)
    saved = list[Path]()

    def save_one(path: Path, *part: Any) -> None:
        if len(saved) == 1:
            raise KeyboardInterrupt
        saved.append(path)
        save_decisions(path, *part)

    monkeypatch.setattr(module, "_TOGETHER", 2)
    monkeypatch.setattr(module, "save_decisions", save_one)
    with pytest.raises(KeyboardInterrupt):
        train_tiny(None, tmp_path / "parts", demonstrations=demonstrations)
    (kept,) = saved
    saved.clear()
    train_tiny(None, tmp_path / "parts", demonstrations=demonstrations, resume=True)
    assert saved != [kept]
    assert weights(tmp_path / "parts") == weights(tmp_path / "whole")


def test_nothing_to_learn_from_is_told(tmp_path: Path) -> None:
    with pytest.raises(KnotgymError, match="--demonstrations 1000"):
        train_tiny(None, tmp_path / "none")
    assert knotgym("train", "--demonstrations", 5, "--out", tmp_path / "pictures") == 2
