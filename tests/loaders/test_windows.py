"""Tests of windows: every number equals a slow reference, row by row, on random episodes."""

import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from synthetic_episodes import TASK, TINY, episodes, written

from knotgym.common import InvalidInput, Stream, Table
from knotgym.datasets import STEPS, Episodes
from knotgym.loaders import GoalSampling, Transitions, Window, arrays
from knotgym.loaders.transitions import _other_codes

TOWED = 0.2  # the tow limit of the task; a towed state lies a metre off


@dataclass(frozen=True)
class Played:
    """An episode to be made.

    Attributes:
        codes: the code that each state shows, as an index of `synthetic_episodes.CODES`.
        towed: from which state on it lies beyond the bound on towing; more than T for none.
        failed: whether the simulation blew up in the last pull.
        terminated: whether it ended so, or was truncated.
        starts: whether a macro-action starts with each pull.
    """

    codes: list[int]
    towed: int
    failed: bool
    terminated: bool
    starts: list[bool]

    def __len__(self) -> int:
        return len(self.codes) - 1


@st.composite
def played(draw: st.DrawFn) -> list[Played]:
    found = []
    for _ in range(draw(st.integers(1, 4))):
        length = draw(st.integers(1, 7))
        found.append(
            Played(
                codes=[0, *draw(st.lists(st.integers(0, 2), min_size=length, max_size=length))],
                towed=draw(st.integers(1, 2 * length + 1)),
                failed=draw(st.booleans()),
                terminated=draw(st.booleans()),
                starts=[
                    True,
                    *draw(st.lists(st.booleans(), min_size=length - 1, max_size=length - 1)),
                ],
            )
        )
    return found


def columns(given: list[Played]) -> Episodes:
    """Make the episodes' columns; rewards and actions are drawn at random."""
    codes = [code for one in given for code in one.codes]
    made = episodes([len(one) for one in given], codes=codes)
    rows, points = made.steps.rows, made.steps["observation"].copy()
    ended, starts = np.zeros((2, rows), dtype=bool)
    for one, first in zip(given, made.offsets, strict=False):
        points[first + one.towed : first + len(one) + 1] += 1
        ended[first + len(one) - 1] = one.terminated
        starts[first : first + len(one)] = one.starts
    last = made.last()
    truncated = np.zeros(rows, dtype=bool)
    truncated[last - 1] = ~ended[last - 1]
    extra = {
        "observation": points,
        "terminated": ended,
        "truncated": truncated,
        "macro_start": starts,
        "macro_bead": np.arange(rows).astype(np.uint16),
        "macro_target": (np.arange(rows) + 10).astype(np.uint16),
        "macro_side": np.where(np.arange(rows) % 2, 1, -1).astype(np.int8),
    }
    failed = np.array([one.failed for one in given])
    steps = Table(STEPS.sized(**dict(made.steps.schema.sizes)), {**made.steps, **extra})
    return Episodes(made.episodes.replaced(diverged=failed), steps)


def decisions(one: Played, view: str) -> list[int]:
    """List the states that transitions lead between."""
    if view != "macro":
        return list(range(len(one) + 1))
    return [t for t in range(len(one)) if one.starts[t]] + [len(one)]


def shown_code(one: Played, step: int) -> int | None:
    """Return the code of a state; None after towing or where the simulation blew up."""
    blew_up = one.failed and step == len(one)
    return None if step >= one.towed or blew_up else one.codes[step]


def succeeds(one: Played, step: int, goal: int | None, hold: int) -> bool:
    """Say whether the environment would call the pull that led to a state a success."""
    held = 0
    for t in range(1, step + 1):
        held = held + 1 if goal is not None and shown_code(one, t) == goal else 0
    return held >= hold


@pytest.mark.thorough
@settings(max_examples=40, deadline=None)
@given(
    chosen=played(),
    view=st.sampled_from(["pull", "macro"]),
    window=st.builds(
        Window,
        n_step=st.integers(1, 4) | st.just(10**9),
        chunk=st.one_of(st.none(), st.integers(1, 4)),
        stack=st.one_of(st.none(), st.integers(1, 3)),
        history=st.one_of(st.none(), st.integers(1, 3)),
        discount=st.sampled_from([0.5, 0.9]),
        goals=st.one_of(st.none(), st.builds(GoalSampling, geom_sample=st.booleans())),
    ),
    hold=st.integers(1, 2),
)
def test_every_number_of_a_window_equals_a_slow_reference(
    chosen: list[Played], view: str, window: Window, hold: int
) -> None:
    made = columns(chosen)
    (own, steps), offsets = made, made.offsets
    with tempfile.TemporaryDirectory() as room:
        task = replace(TASK, hold=hold, tow_limit=TOWED)
        path = written(Path(room) / "a.h5", made, task)
        read = Transitions(path, action=view, window=window)
        held = arrays(path, action=view, window=window)
        drawn = None
        if window.goals is not None:
            rng = Stream.SAMPLED_GOALS.generator(window.goals.seed)
            drawn = read._sampled_goals(np.arange(len(read)), window.goals, rng)
    states = [(k, t) for k, one in enumerate(chosen) for t in decisions(one, view)]

    def action(k: int, step: int) -> NDArray[Any]:
        row = int(offsets[k]) + step
        return steps["action"][row] if view == "pull" else np.array([row, row + 10, row % 2])

    row = 0
    for k, one in enumerate(chosen):
        stops, first = decisions(one, view), int(offsets[k])
        for at, step in enumerate(stops[:-1]):
            goal, target = None, own["goal_points"][k]
            if drawn is not None:
                owner, goal_step = states[drawn[row]]
                goal = shown_code(chosen[owner], goal_step)
                target = steps["observation"][offsets[owner] + goal_step]
            total, factor, reach, terminal, timeout = 0.0, 1.0, at, False, False
            while reach < min(at + window.n_step, len(stops) - 1) and not terminal:
                begin, end = stops[reach], stops[reach + 1]
                if window.goals is None:
                    reward = float(steps["reward"][first + begin : first + end].sum())
                    terminal = bool(steps["terminated"][first + end - 1])
                else:
                    terminal = succeeds(one, end, goal, hold)
                    reward = float(terminal) - 1
                total += factor * reward
                factor *= window.discount ** (end - begin)
                reach += 1
                timeout = reach == len(stops) - 1 and not terminal
            assert np.isclose(held["rewards"][row], total)
            assert held["pulls"][row] == stops[reach] - step
            assert np.isclose(held["discounts"][row], 0 if terminal else factor)
            assert held["terminals"][row] == terminal and held["timeouts"][row] == timeout
            for name, place in (("observations", at), ("next_observations", reach)):
                back = range((window.stack or 1) - 1, -1, -1)
                past = [first + stops[max(place - i, 0)] for i in back]
                right = [np.append(steps["observation"][t].ravel(), target) for t in past]
                seen = held[name][row] if window.stack is not None else held[name][row][None]
                np.testing.assert_array_equal(seen, right)
            ahead = [at + i for i in range(window.chunk or 1)]
            taken = held["actions"][row] if window.chunk else held["actions"][row][None]
            for mine, i in zip(taken, ahead, strict=True):
                assert np.all(mine == (action(k, stops[i]) if i < len(stops) - 1 else 0))
            if window.chunk:
                assert held["action_mask"][row].tolist() == [i < len(stops) - 1 for i in ahead]
            for side, place in (("", at), ("next_", reach)) if window.history else ():
                earlier = list(range(place - (window.history or 0), place))
                assert held[f"{side}history_mask"][row].tolist() == [i >= 0 for i in earlier]
                for mine, i in zip(held[f"{side}history"][row], earlier, strict=True):
                    assert np.all(mine == (action(k, stops[i]) if i >= 0 else 0))
            row += 1
    assert row == len(held["rewards"])


@settings(max_examples=100, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=4),
    geom=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_a_goal_of_the_trajectory_lies_ahead(lengths: list[int], geom: bool, seed: int) -> None:
    sampling = GoalSampling(p_currgoal=0, p_trajgoal=1, p_randomgoal=0, geom_sample=geom)
    ends = np.cumsum(np.array(lengths) + 1) - 1
    states = np.concatenate([np.arange(e - n, e) for e, n in zip(ends, lengths, strict=True)])
    last = np.repeat(ends, lengths)
    rng = np.random.default_rng(seed)
    goals = sampling.draw(states, last, int(ends[-1]) + 1, 0.9, rng)
    assert (goals > states).all() and (goals <= last).all()


def test_goals_have_the_probabilities_that_are_asked_for() -> None:
    sampling = GoalSampling(p_currgoal=0.2, p_trajgoal=0.5, p_randomgoal=0.3, geom_sample=False)
    count = 40_000
    states, last = np.full(count, 10), np.full(count, 14)
    goals = sampling.draw(states, last, 1000, 0.9, np.random.default_rng(0))
    share = Counter("own" if g == 10 else "later" if 10 < g <= 14 else "any" for g in goals)
    assert abs(share["own"] / count - 0.2) < 0.01 and abs(share["later"] / count - 0.5) < 0.01


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=2, max_size=8), st.integers(0, 2**32))
def test_negatives_show_every_other_code_and_no_own(codes: list[int], seed: int) -> None:
    shown = np.array(codes)
    rng = np.random.default_rng(seed)
    if len({*codes}) < 2:
        with pytest.raises(InvalidInput, match="two Gauss codes or more"):
            _other_codes(shown, shown, 3, rng)
        return
    others = _other_codes(shown, shown, 200, rng)
    assert (shown[others] != shown[:, None]).all()
    for row in range(len(codes)):
        assert {*others[row].tolist()} == {*np.flatnonzero(shown != shown[row]).tolist()}


@pytest.mark.parametrize("observation", ["state", "pixels", "symbolic", "both"])
def test_sampled_goals_and_negatives_are_halves_of_observations(observation: str) -> None:
    sampling = GoalSampling(negatives=2)
    window = Window(goals=sampling)
    opened = Transitions(TINY["random"], observation=observation, window=window)
    rows = np.array([0, 7, 30])
    goals = opened._sampled_goals(rows, sampling, np.random.default_rng(3))
    batch = opened.batch(rows, apart=True, rng=np.random.default_rng(3))
    for name in ("goals", "negatives", "observations"):
        parts = batch[name].values() if observation == "both" else [batch[name]]
        assert all(len(part) == 3 for part in parts)
    for k, goal in enumerate(goals.tolist()):
        # the states of segment s begin at starts[s] + s
        begins = opened.starts + np.arange(len(opened.starts))
        segment = int(np.searchsorted(begins, goal, side="right")) - 1
        step = goal - int(begins[segment])
        seen = opened.observations(segment, step, step + 1)
        pair = seen["state"] if observation == "both" else seen
        half = np.split(pair, 2, axis=2 if observation == "pixels" else 1)[0][0]
        own = batch["goals"]["state"] if observation == "both" else batch["goals"]
        np.testing.assert_array_equal(own[k], half)


def test_marked_observations_have_no_halves_but_sampled_goals() -> None:
    window = Window(goals=GoalSampling())
    opened = Transitions(TINY["random"], observation="marked", window=window)
    assert len(opened.batch([0, 5], rng=np.random.default_rng(0))["observations"]) == 2


def test_the_same_generator_gives_the_same_batch() -> None:
    import pickle

    window = Window(n_step=3, goals=GoalSampling())
    opened = Transitions(TINY["random"], observation="state", window=window)
    one, two = (
        each.batch([3, 9], rng=np.random.default_rng(5))
        for each in (opened, pickle.loads(pickle.dumps(opened)))
    )
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
