import hashlib
import platform
from dataclasses import replace

import numpy as np
import pytest

from knotgym.control.planning.planners import PassPlayer, PullPlayer
from knotgym.control.policies import make_policy
from knotgym.control.policy_config import PassPlannerConfig, PolicyConfig, PullPlannerConfig
from knotgym.control.sampler import rollouts
from knotgym.envs import EpisodeBatch, TaskConfig

TASK = TaskConfig(task="tie", nx=2, observation="state", engine="chain")
EXPERT = PolicyConfig(policy="expert")


def test_the_same_state_gets_the_same_pass() -> None:
    batch = EpisodeBatch(TASK, 2)
    batch.begin(np.arange(2), [3, 3])
    player, ids = PassPlayer(EXPERT, batch), np.arange(2)
    player.begin(ids, [np.random.default_rng(k) for k in range(2)])

    def act() -> tuple[np.ndarray, np.ndarray]:
        while True:
            pulls = player.act(ids)
            if len(pulls.ids) == 2:
                assert pulls.macros is not None
                batch.pull(ids, pulls.beads, pulls.forces)
                return pulls.forces, pulls.macros

    forces, macros = act()
    assert np.array_equal(forces[0], forces[1]) and macros[:, 0].tolist() == [1, 1]
    for _ in range(3):
        act()
    # a look in the middle of an episode is a look at its start
    player.replan(ids[:1])
    player.begin(ids[1:], [np.random.default_rng(9)])
    forces, macros = act()
    assert np.array_equal(forces[0], forces[1]) and macros[:, 0].tolist() == [1, 1]


@pytest.mark.parametrize(("engine", "count"), [("chain", 6), ("mujoco", 1)])
@pytest.mark.parametrize("name", ["expert", "planner"])
def test_planners_reach_goals_in_either_engine(name: str, engine: str, count: int) -> None:
    policy = make_policy(PolicyConfig(policy=name))
    found = rollouts(policy, replace(TASK, engine=engine), range(count))
    assert found.episodes["success"].all() and (found.episodes["planner_steps"] > 0).all()
    if engine == "chain" and platform.machine() == "x86_64":  # the bytes of any such processor
        digests = {"expert": "5ef755ad", "planner": "e694de66"}
        assert hashlib.sha256(found.steps["force"].tobytes()).hexdigest()[:8] == digests[name]


def test_where_no_pass_is_found_pulls_are_planned() -> None:
    config = replace(EXPERT, expert=PassPlannerConfig(candidates=1, budget=1))
    hopeless = make_policy(config)
    found, alone = (rollouts(hopeless, TASK, range(4), lanes=lanes) for lanes in (4, 1))
    assert found.episodes["success"].all() and found.episodes["planner_steps"].mean() > 50
    assert found.differences(alone) == []


def test_pulls_planned_one_by_one_are_labelled_as_part_of_no_pass() -> None:
    task = replace(TASK, nx=3, split="train", engine="mujoco")
    steps = rollouts(make_policy(EXPERT), task, [9]).steps  # a pass ends short of its last waypoint
    led = steps["macro_side"] != 0
    assert 0 < led.sum() < len(led) - 2
    assert (steps["macro_bead"][led] == steps["bead"][led]).all()


def test_a_rope_is_left_alone_when_the_budget_is_used_up() -> None:
    config = PolicyConfig(policy="planner", planner=PullPlannerConfig(budget=0))
    found = rollouts(make_policy(config), TASK, range(2))
    assert (found.episodes["planner_steps"] == 0).all() and not found.steps["force"].any()


def test_a_goal_is_held_by_lying_still() -> None:
    found = rollouts(make_policy(EXPERT), replace(TASK, hold=3), range(3))
    assert found.episodes["success"].all()


def test_play_goes_on_to_another_goal() -> None:
    task = replace(TASK, endless=True, horizon=80)
    found = rollouts(make_policy(PolicyConfig(policy="play")), task, range(3))
    codes = {tuple(row) for row in found.steps["visits"].tolist()}
    assert found.episodes["length"].tolist() == [80] * 3 and len(codes) > 4


def test_an_episode_that_begins_anew_forgets_its_search() -> None:
    batch, ids, found = EpisodeBatch(TASK), np.arange(1), []
    player = PullPlayer(PullPlannerConfig(), batch)
    for patience in (1, 3, 10_000):
        batch.begin(ids, [1])
        player.begin(ids, [np.random.default_rng(0)])
        while patience and not len(player.act(ids).ids):
            patience -= 1
        found.append((patience > 0, int(player.planned[0])))
    alone = PullPlayer(PullPlannerConfig(), batch)
    batch.begin(ids, [1])
    alone.begin(ids, [np.random.default_rng(0)])
    while not len(alone.act(ids).ids):
        pass
    assert found == [(False, 0), (False, 0), (True, int(alone.planned[0]))]
