"""Tests of `knotgym.datasets.episodes`: tables of episodes and steps, and hindsight relabelling."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from synthetic_episodes import TASK, code_rows, episodes

from knotgym.datasets.episodes import Episodes, fitted, gauss_codes
from knotgym.topology import GaussCode

CODES = ["", "1+a,1-a", "1+a,2-c,2+c,1-a"]


def showing(*shown: list[int]) -> Episodes:
    """Return episodes that show these of CODES."""
    made = episodes([len(one) - 1 for one in shown])
    codes = [GaussCode.parse(CODES[k]) for one in shown for k in one]
    return made._replace(steps=made.steps.replaced(visits=code_rows(codes, 4)))


def naive(shown: list[int], hold: int) -> list[int]:
    """Find the goals of one episode step by step."""
    first: dict[int, int] = {}
    running = 0
    for step, code in enumerate(shown):
        running = running + 1 if step and code == shown[step - 1] else 1
        if code != shown[0] and running >= hold:
            first.setdefault(code, step)
    return sorted(first.values())


def test_select_returns_whole_episodes_in_the_order_asked_for() -> None:
    made = episodes([3, 1, 2])
    some = made.select([2, 0])
    assert some.episodes["length"].tolist() == [2, 3]
    rows = [*range(6, 9), *range(4)]
    np.testing.assert_array_equal(some.steps["observation"], made.steps["observation"][rows])
    assert made.select([False, True, False]).steps.rows == 2 and made.select([]).steps.rows == 0


def test_merged_codes_are_as_wide_as_the_longest() -> None:
    one, two = showing([0, 1]), showing([0, 2])
    both = Episodes.merged([fitted([one.select([0])])[0], two])
    assert both.steps["visits"].shape[1] == 4
    assert gauss_codes(both.steps["visits"]).tolist() == ["", "1+,1-", "", "1+,2-,2+,1-"]


def test_differences_name_episode_step_and_column() -> None:
    made = episodes([3, 1])
    share = made.steps["applied_fraction"].copy()
    share[5] += 1
    total = made.episodes["return_"].copy()
    total[0] += 1
    other = Episodes(
        made.episodes.replaced(return_=total), made.steps.replaced(applied_fraction=share)
    )
    planned = made._replace(episodes=made.episodes.replaced(planner_steps=np.array([7, 7])))
    assert made.differences(made) == made.differences(planned) == []  # not compared
    assert "episode 0: length differs" in made.differences(made.select([1, 1]))
    assert made.differences(made.select([0])) == ["1 episodes, should be 2"]
    assert made.differences(other) == [
        "episode 0: return_ differs",
        "episode 1, step 1: applied_fraction differs",
    ]


@given(
    st.lists(st.lists(st.integers(0, 2), min_size=2, max_size=12), min_size=1, max_size=5),
    st.integers(1, 3),
)
def test_goals_are_those_found_step_by_step(shown: list[list[int]], hold: int) -> None:
    episode, step = showing(*shown).goals_reached(replace(TASK, hold=hold))
    pairs = [(k, step) for k, one in enumerate(shown) for step in naive(one, hold)]
    assert sorted(zip(episode.tolist(), step.tolist(), strict=True)) == pairs


def test_states_beyond_the_tow_limit_are_no_goals() -> None:
    made = showing([0, 1, 2])
    points = np.zeros_like(made.steps["observation"])
    points[2:] += 1
    made = made._replace(steps=made.steps.replaced(observation=points))
    assert made.goals_reached(replace(TASK, tow_limit=0.5))[1].tolist() == [1]


def test_episodes_are_the_same_if_start_goal_and_pulls_are() -> None:
    made = episodes([2])
    own, steps = made
    codes = code_rows([GaussCode.parse("1+a,1-a")], 4), code_rows([GaussCode.parse("1-c,1+c")], 4)
    others = [
        *(made._replace(episodes=own.replaced(goal_visits=code)) for code in codes),
        made._replace(episodes=own.replaced(goal=own["goal"] + 1)),
        made._replace(episodes=own.replaced(start_qpos=-own["start_qpos"])),
        made._replace(steps=steps.replaced(force=-steps["force"])),
    ]
    assert len({one.digests()[0] for one in others}) == 5
    policy = np.full(1, "another")
    assert made._replace(episodes=own.replaced(policy=policy)).digests() == made.digests()
