"""Windows equal a slow reference, row by row, on random episodes."""

import importlib.util
import pickle
import re
import tempfile
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.trajectory import Episode
from knotgym.envs.observations import observe
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import (
    GoalSampling,
    Transitions,
    Window,
    arrays,
    to_d3rlpy,
    to_tensordict,
    torch_dataset,
)
from knotgym.loaders.windows import other_codes
from knotgym.rendering.picture import PictureConfig

clients = pytest.mark.clients
TASK = TaskConfig(task="tie", observation="state", horizon=100, image_size=16)
CIRCLE = 2 * np.pi * np.arange(100) / 100
TOWED = 0.2  # the tow limit of a task; a towed state lies a metre off
N_STEPS, CHUNK, STACK, HISTORY = 3, 3, 2, 2


def played(k: int, codes: list[str], *, terminated: bool, starts: list[bool]) -> Episode:
    """Make an episode that shows `codes`; "towed" is a state beyond the bound on towing."""
    length, states = len(codes) - 1, np.arange(len(codes))
    points = np.zeros((length + 1, 100, 3))
    points[:, :, 0] = 0.1 * np.cos(CIRCLE) * (1 + 0.1 * k)
    points[:, :, 1] = 0.1 * np.sin(CIRCLE + 0.2 * states[:, None])
    points[[code == "towed" for code in codes]] += 1
    last = np.arange(length) == length - 1
    return Episode(
        start_qpos=np.zeros(421),
        points=points,
        goal_points=points[0] * 0.5,
        actions=np.random.default_rng(k).uniform(-1, 1, (length, 6)).astype(np.float32),
        rewards=np.arange(length, dtype=np.float64) + 1 + 10 * k,
        terminations=last & terminated,
        truncations=last & (not terminated),
        gauss_code=np.array([code.removesuffix("!") for code in codes]),
        gauss_code_chiral=np.array(codes),
        crossings=states,
        bead=states,
        force=np.zeros((length + 1, 3)),
        applied_share=np.ones(length + 1),
        is_success=np.zeros(length + 1, dtype=bool),
        simulation_failed=np.array([code.endswith("!") for code in codes]),
        macro_start=np.array([False, True, *starts[1:length]]),
        macro_bead=states,
        macro_target=states + 10,
        macro_side=np.where(states % 2, 1, -1),
        goal_gauss_code="goal",
        policy="by hand",
    )


@st.composite
def datasets(draw: st.DrawFn) -> list[Episode]:
    """Draw one to four episodes of one to seven steps; "a!" is a state that blew up."""
    shown = st.sampled_from(["a", "a", "b", "c", "towed", "a!"])
    episodes = []
    for k in range(draw(st.integers(1, 4))):
        length = draw(st.integers(1, 7))
        codes = ["a", *draw(st.lists(shown, min_size=length, max_size=length))]
        starts = draw(st.lists(st.booleans(), min_size=length, max_size=length))
        episodes.append(played(k, codes, terminated=draw(st.booleans()), starts=starts))
    return episodes


def written(episodes: list[Episode], path: Path, task: TaskConfig = TASK) -> Path:
    with EpisodeWriter(path, task) as writer:
        for episode in episodes:
            writer.add(episode)
    return path


def decisions(episode: Episode, view: str) -> list[int]:
    """List the states that transitions lead between."""
    length = len(episode)
    if view != "macro":
        return list(range(length + 1))
    assert episode.macro_start is not None
    return [t for t in range(length) if episode.macro_start[t + 1]] + [length]


def action(episode: Episode, step: int, view: str) -> NDArray[Any]:
    if view != "macro":
        return episode.actions[step]
    return np.array([step + 1, step + 11, (step + 1) % 2])


def shows(episode: Episode, step: int, goal: str | None, hold: int) -> bool:
    """Say whether the environment would call the step that led to a state a success."""
    held = 0
    for t in range(1, step + 1):
        reached = goal is not None and shown_code(episode, t) == goal
        held = held + 1 if reached else 0
    return held >= hold


def shown_code(episode: Episode, step: int) -> str | None:
    """Return the code of a state; None after towing or where the simulation blew up."""
    towed = "towed" in episode.gauss_code_chiral[: step + 1].tolist()
    return None if towed or episode.simulation_failed[step] else str(episode.gauss_code[step])


@pytest.mark.thorough
@settings(max_examples=40, deadline=None)
@given(
    episodes=datasets(),
    view=st.sampled_from(["pull", "macro"]),
    n_step=st.integers(1, 4),
    chunk=st.one_of(st.none(), st.integers(1, 4)),
    stack=st.one_of(st.none(), st.integers(1, 3)),
    history=st.one_of(st.none(), st.integers(1, 3)),
    discount=st.sampled_from([0.5, 0.9]),
    hold=st.integers(1, 2),
    goals=st.one_of(st.none(), st.builds(GoalSampling, geom_sample=st.booleans())),
)
def test_every_number_of_a_window_equals_a_slow_reference(
    episodes: list[Episode],
    view: str,
    n_step: int,
    chunk: int | None,
    stack: int | None,
    history: int | None,
    discount: float,
    hold: int,
    goals: GoalSampling | None,
) -> None:
    window = Window(
        n_step=n_step, chunk=chunk, stack=stack, history=history, discount=discount, goals=goals
    )
    with tempfile.TemporaryDirectory() as room:
        path = written(episodes, Path(room) / "a.h5", replace(TASK, hold=hold, tow_limit=TOWED))
        read = Transitions(path, action=view, window=window)
        held = arrays(path, action=view, window=window)
        drawn = None
        if goals is not None:
            rng = generator(Stream.SAMPLED_GOALS, goals.seed)
            drawn = read.sample_goals(np.arange(len(read)), rng)
    states = [(k, t) for k, one in enumerate(episodes) for t in decisions(one, view)]
    row = 0
    for episode in episodes:
        stops = decisions(episode, view)
        for at, step in enumerate(stops[:-1]):
            goal, target = None, episode.goal_points
            if drawn is not None:
                owner, goal_step = states[drawn[row]]
                goal = shown_code(episodes[owner], goal_step)
                target = episodes[owner].points[goal_step]
            total, factor, reach, terminal, timeout = 0.0, 1.0, at, False, False
            while reach < min(at + n_step, len(stops) - 1) and not terminal:
                begin, end = stops[reach], stops[reach + 1]
                if goals is None:
                    reward = float(episode.rewards[begin:end].sum())
                    terminal = bool(episode.terminations[end - 1])
                else:
                    terminal = shows(episode, end, goal, hold)
                    reward = float(terminal) - 1
                total += factor * reward
                factor *= discount ** (end - begin)
                reach += 1
                timeout = reach == len(stops) - 1 and not terminal
            assert np.isclose(held["rewards"][row], total)
            assert held["pulls"][row] == stops[reach] - step
            assert np.isclose(held["discounts"][row], 0 if terminal else factor)
            assert held["terminals"][row] == terminal and held["timeouts"][row] == timeout
            for name, place in (("observations", at), ("next_observations", reach)):
                past = [stops[max(place - back, 0)] for back in range((stack or 1) - 1, -1, -1)]
                right = [np.concatenate([episode.points[t].ravel(), target.ravel()]) for t in past]
                seen = held[name][row] if stack is not None else held[name][row][None]
                assert np.array_equal(seen, np.array(right, dtype=np.float32))
            ahead = [at + i for i in range(chunk or 1)]
            own = held["actions"][row] if chunk is not None else held["actions"][row][None]
            for one, i in zip(own, ahead, strict=True):
                right_action = action(episode, stops[i], view) if i < len(stops) - 1 else 0
                assert np.all(one == right_action)
            if chunk:
                assert held["action_mask"][row].tolist() == [i < len(stops) - 1 for i in ahead]
            for side, place in (("", at), ("next_", reach)) if history else ():
                assert history is not None
                past = list(range(place - history, place))
                assert held[f"{side}history_mask"][row].tolist() == [i >= 0 for i in past]
                for one, i in zip(held[f"{side}history"][row], past, strict=True):
                    right_action = action(episode, stops[i], view) if i >= 0 else 0
                    assert np.all(one == right_action)
            row += 1
    assert row == len(held["rewards"])


@settings(max_examples=100, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=4),
    geom=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_a_goal_of_the_trajectory_lies_ahead_in_it(
    lengths: list[int], geom: bool, seed: int
) -> None:
    first = np.cumsum([0, *(length + 1 for length in lengths)])
    states = np.concatenate([f + np.arange(n) for f, n in zip(first, lengths, strict=False)])
    last = np.repeat(first[1:] - 1, lengths)
    rng, total = np.random.default_rng(seed), int(first[-1])
    future = GoalSampling(p_currgoal=0, p_trajgoal=1, p_randomgoal=0, geom_sample=geom)
    goals = future.draw(states, last, total, 0.7, rng)
    assert (goals > states).all() and (goals <= last).all()
    current = GoalSampling(p_currgoal=1, p_trajgoal=0, p_randomgoal=0, geom_sample=geom)
    assert np.array_equal(current.draw(states, last, total, 0.7, rng), states)


def test_goals_have_the_probabilities_that_are_asked_for() -> None:
    count, total, states = 40_000, 1000, np.full(40_000, 100)
    rng = np.random.default_rng(0)
    sampling = GoalSampling(p_currgoal=0.2, p_trajgoal=0.5, p_randomgoal=0.3)
    goals = sampling.draw(states, np.full(count, 104), total, 0.5, rng)
    # a random goal is one of 1000 states, five of which are these
    expected = {100: 0.2, 101: 0.25, 102: 0.125, 103: 0.0625, 104: 0.0625}
    for state, share in expected.items():
        assert np.mean(goals == state) == pytest.approx(share + 0.3 / total, abs=0.008)
    other = goals[(goals < 100) | (goals > 104)]
    assert len(other) / count == pytest.approx(0.3 * 0.995, abs=0.008)
    assert np.histogram(other, bins=10, range=(0, total))[0].std() < 60  # 1200 each
    uniform = GoalSampling(p_currgoal=0, p_trajgoal=1, p_randomgoal=0, geom_sample=False)
    drawn = Counter(uniform.draw(states, np.full(count, 104), total, 0.5, rng).tolist())
    assert all(drawn[state] / count == pytest.approx(0.25, abs=0.01) for state in range(101, 105))


@settings(max_examples=100, deadline=None)
@given(codes=st.lists(st.integers(-1, 3), min_size=2, max_size=12), seed=st.integers(0, 2**32))
def test_negatives_show_every_other_code_and_no_own(codes: list[int], seed: int) -> None:
    numbers, rng = np.array(codes), np.random.default_rng(seed)
    if len(set(codes)) == 1:
        with pytest.raises(InvalidInput, match="two Gauss codes"):
            other_codes(numbers, numbers, 2, rng)
        return
    drawn = other_codes(numbers, numbers, 400, rng)
    for own, others in zip(codes, drawn, strict=True):
        assert set(others.tolist()) == {i for i, code in enumerate(codes) if code != own}


CODES = (["a", "b", "b", "c"], ["a", "a"], ["b", "c", "a", "a", "a"], ["c", "b", "a"])
EPISODES = [
    played(k, codes, terminated=k % 2 == 0, starts=[True] * len(codes))
    for k, codes in enumerate(CODES)
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes with state observations, with pictures and states, and compact."""
    room = tmp_path_factory.mktemp("windows")
    written(EPISODES, room / "state.h5")
    written(EPISODES, room / "both.h5", replace(TASK, observation="both"))
    merge_episodes([room / "both.h5"], room / "none.h5", store="none")
    return room


FULL = Window(
    n_step=N_STEPS, chunk=CHUNK, stack=STACK, history=HISTORY, goals=GoalSampling(negatives=2)
)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    return bool(np.array_equal(one, other))


@pytest.mark.parametrize("observation", ["pixels", "state", "both", "symbolic"])
def test_goals_and_negatives_are_seen_as_the_observation_is(
    folder: Path, observation: str, tmp_path: Path
) -> None:
    picture = PictureConfig(size=16)

    def named(seen: Any) -> dict[str, Any]:
        return seen if isinstance(seen, dict) else {observation: seen}

    def half(seen: Any, which: int) -> dict[str, Any]:
        axis = {"pixels": -2, "state": -1, "symbolic": -2}
        return {n: np.split(one, 2, axis=axis[n])[which] for n, one in named(seen).items()}

    read = Transitions(folder / "both.h5", observation=observation, window=FULL)
    rows = np.array([3, 0, 7, 4])
    batch = read.batch(rows, rng=np.random.default_rng(1))
    goals = read.sample_goals(rows, np.random.default_rng(1))
    codes = np.concatenate(CODES)
    points = np.concatenate([episode.points for episode in EPISODES])
    picture = PictureConfig(size=16)
    every = half(observe(points, points[0], observation, picture), 0)
    for index, goal in enumerate(goals):
        segment, step = read.place(int(rows[index]))
        stacked = EPISODES[segment].points[[max(step - 1, 0), step]]
        right = named(observe(stacked, points[goal], observation, picture))
        for name, seen in named(batch["observations"]).items():
            assert np.array_equal(seen[index], right[name])
        for k in range(2):
            negative = {name: one[index, k] for name, one in named(batch["negatives"]).items()}
            alike = [
                code
                for at, code in enumerate(codes)
                if all(np.array_equal(every[name][at], one) for name, one in negative.items())
            ]
            assert alike and set(alike) != {codes[goal]}
    apart = read.batch(rows, rng=np.random.default_rng(1), apart=True)
    assert same(named(apart["observations"]), half(batch["observations"], 0))
    goal_seen = {name: one[:, 0] for name, one in half(batch["observations"], 1).items()}
    assert same(named(apart["goals"]), goal_seen)
    others = [Transitions(folder / "none.h5", observation=observation, window=FULL)]
    if observation in ("pixels", "both"):
        others.append(
            Transitions(folder / "both.h5", observation=observation, cache=tmp_path, window=FULL)
        )
    for other in others:
        for split, expected in ((False, batch), (True, apart)):
            assert same(other.batch(rows, rng=np.random.default_rng(1), apart=split), expected)


def test_marked_observations_are_made_anew_for_a_sampled_goal(tmp_path: Path) -> None:
    path = written(EPISODES, tmp_path / "marked.h5", replace(TASK, observation="marked"))
    read = Transitions(path, window=Window(goals=GoalSampling()))
    rows = np.arange(len(read))
    seen = read.batch(rows, rng=np.random.default_rng(2))["observations"]
    points = np.concatenate([episode.points for episode in EPISODES])
    for row, goal in enumerate(read.sample_goals(rows, np.random.default_rng(2))):
        segment, step = read.place(row)
        own = EPISODES[segment].points[[step]]
        right = observe(own, points[goal], "marked", PictureConfig(size=16))
        assert np.array_equal(seen[row], right[0])
    with pytest.raises(InvalidInput, match="has no halves"):
        Transitions(path, window=FULL).batch([0], rng=np.random.default_rng(0))


def test_the_same_generator_gives_the_same_batch_also_after_pickling(folder: Path) -> None:
    read = Transitions(folder / "state.h5", window=FULL)
    one, other, third = (
        each.batch(np.arange(8), rng=np.random.default_rng(seed))
        for each, seed in ((read, 5), (pickle.loads(pickle.dumps(read)), 5), (read, 6))
    )
    assert same(one, other) and not same(one, third)
    assert same(arrays(folder / "state.h5", window=FULL), arrays(folder / "state.h5", window=FULL))
    moved = replace(FULL, goals=GoalSampling(negatives=2, seed=1))
    assert not same(
        arrays(folder / "state.h5", window=FULL), arrays(folder / "state.h5", window=moved)
    )


def test_a_history_beside_experts_actions_holds_the_pulls_taken(tmp_path: Path) -> None:
    episode = played(0, ["a", "b", "c"], terminated=True, starts=[True] * 3)
    expert = np.full((3, 6), 0.25, dtype=np.float32)
    path = written([replace(episode, expert_action=expert)], tmp_path / "a.h5")
    held = arrays(path, labels=True, window=Window(history=1))
    assert (held["actions"] == 0.25).all()
    assert np.array_equal(held["next_history"][:, 0], episode.actions)
    with pytest.raises(InvalidInput, match="leave out chunk"):
        arrays(path, labels=True, window=Window(chunk=2))


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Window(n_step=0), "n_step must be at least 1, got 0"),
        (lambda: Window(chunk=0), "chunk must be at least 1, got 0"),
        (lambda: Window(discount=1.5), r"discount must be in \(0, 1\], got 1.5"),
        (lambda: Window(discount=1, goals=GoalSampling()), "use a smaller discount"),
        (lambda: GoalSampling(p_currgoal=0.5), "probabilities that sum to 1"),
        (lambda: GoalSampling(negatives=-1), "negatives must be at least 0, got -1"),
    ],
)
def test_a_window_refuses_nonsense(make: Any, told: str) -> None:
    with pytest.raises(InvalidInput, match=told):
        make()


def test_windows_that_a_dataset_cannot_give_are_refused(folder: Path) -> None:
    path, goals = folder / "state.h5", Window(goals=GoalSampling())
    with pytest.raises(InvalidInput, match="leave out relabel"):
        arrays(path, relabel="all", window=goals)
    with pytest.raises(InvalidInput, match="hand a generator in"):
        Transitions(path, window=goals).batch([0])
    with pytest.raises(InvalidInput, match="window=Window"):
        Transitions(path).sample_goals([0], np.random.default_rng(0))


@pytest.mark.clients
def test_whole_episodes_have_no_windows(folder: Path) -> None:
    pytest.importorskip("torch")
    with pytest.raises(InvalidInput, match="kind 'transitions'"):
        torch_dataset(folder / "state.h5", "episodes", window=Window(n_step=2))


def test_the_example_of_the_page_runs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(__file__).parents[2] / "docs/loading.md").read_text(encoding="utf-8")
    section = page.split("## Windows and goals")[1].split("\n### ")[0]
    (block,) = re.findall(r"```python\n(.*?)```", section, re.S)
    exec(block.replace("knotgym/tie-nx3/expert-v0", str(folder / "state.h5")), {})
    assert capsys.readouterr().out == block.rstrip().rpartition("# ")[2] + "\n"
    settings = set(re.findall(r"^\| `(\w+)` \|", section, re.M))
    assert settings == {field.name for field in fields(Window)} - {"discount"}


# Other libraries

needs = {
    name: pytest.mark.skipif(
        importlib.util.find_spec(name) is None, reason=f"{name} isn't installed"
    )
    for name in ("torch", "tensordict", "d3rlpy")
}


@clients
@needs["torch"]
def test_torch_gives_the_windows_of_a_batch(folder: Path) -> None:
    import torch

    path, window = folder / "state.h5", replace(FULL, goals=None)
    data, right = torch_dataset(path, window=window), arrays(path, window=window)
    batch = data[[2, 0, 5]]
    for name, column in right.items():
        own = batch[name if name in batch else name.removesuffix("s")].numpy()
        assert np.array_equal(own, np.asarray(column[[2, 0, 5]], dtype=own.dtype)), name
    assert all(torch.equal(one, batch[name][1]) for name, one in data[0].items())
    assert batch["reward"].dtype == batch["discount"].dtype == torch.float32


@clients
@needs["torch"]
@pytest.mark.parametrize("workers", [0, 2])
def test_torchs_generator_decides_the_goals(folder: Path, workers: int) -> None:
    import torch

    data = torch_dataset(folder / "state.h5", window=Window(goals=GoalSampling()))

    def goals(seed: int) -> NDArray[Any]:
        torch.manual_seed(seed)
        loader = torch.utils.data.DataLoader(data, batch_size=3, num_workers=workers)
        return torch.cat([batch["observation"] for batch in loader]).numpy()[:, 300:]

    assert np.array_equal(goals(0), goals(0)) and not np.array_equal(goals(0), goals(1))


@clients
@needs["tensordict"]
def test_a_tensordict_holds_windows(folder: Path) -> None:
    held = to_tensordict(folder / "state.h5", window=FULL)
    right = arrays(folder / "state.h5", window=FULL)
    pairs = {
        "observation": "observations",
        "action": "actions",
        "action_mask": "action_mask",
        "history": "history",
        "history_mask": "history_mask",
        "negatives": "negatives",
        ("next", "observation"): "next_observations",
        ("next", "history"): "next_history",
        ("next", "history_mask"): "next_history_mask",
    }
    for key, name in pairs.items():
        assert np.array_equal(held[key].numpy(), right[name]), name
    assert np.array_equal(held["steps_to_next_obs"].numpy()[:, 0], right["pulls"])
    assert np.allclose(held["next", "discount"].numpy()[:, 0], right["discounts"])
    assert np.allclose(held["next", "reward"].numpy()[:, 0], right["rewards"])
    assert np.array_equal(held["next", "terminated"].numpy()[:, 0], right["terminals"])


@clients
@needs["tensordict"]
def test_torchrl_bootstraps_over_the_steps_of_a_window(folder: Path) -> None:
    import torch
    from tensordict.nn import TensorDictModule
    from torchrl.objectives.value import TD0Estimator

    held = to_tensordict(folder / "state.h5", window=Window(n_step=N_STEPS, discount=0.9))
    value = TensorDictModule(
        lambda seen: torch.ones(*seen.shape[:-1], 1), ["observation"], ["state_value"]
    )
    target = TD0Estimator(gamma=0.9, value_network=value).value_estimate(held)
    right = held["next", "reward"] + held["next", "discount"]
    assert torch.allclose(target, right)


@clients
@needs["d3rlpy"]
@pytest.mark.parametrize("goals", [None, GoalSampling()])
@pytest.mark.parametrize("name", ["state.h5", "both.h5"])
def test_d3rlpy_picks_windows(folder: Path, name: str, goals: GoalSampling | None) -> None:
    window = replace(FULL, goals=goals)
    buffer, right = to_d3rlpy(folder / name, window=window), arrays(folder / name, window=window)
    single = arrays(folder / name, window=replace(window, n_step=1))
    found = [
        buffer.transition_picker(episode, index)
        for episode in buffer.episodes
        for index in range(episode.transition_count)
    ]
    assert len(found) == len(right["rewards"]) == buffer.transition_count
    ends = np.cumsum([len(codes) - 1 for codes in CODES])
    for row, one in enumerate(found):
        end = int(ends[np.searchsorted(ends, row, side="right")])
        seen, after = one.observation, one.next_observation
        assert np.array_equal(seen[-1], right["history"][row].ravel())
        assert np.array_equal(after[-1], right["next_history"][row].ravel())
        state = right["observations"]["state"] if name == "both.h5" else right["observations"]
        assert np.array_equal(seen[-2], state[row].ravel())
        if name == "both.h5":
            pixels = np.moveaxis(right["observations"]["pixels"][row], -1, 1)
            assert np.array_equal(seen[0], pixels.reshape(6, 16, 32))
        assert np.array_equal(one.action, right["actions"][row].ravel())
        assert one.reward[0] == np.float32(right["rewards"][row])
        assert one.terminal == right["terminals"][row] and one.interval == right["pulls"][row]
        later = row + one.interval
        expected = right["actions"][later].ravel() if later < end else np.zeros(18)
        assert np.array_equal(one.next_action, expected)
        rewards = one.rewards_to_go[:, 0]
        assert len(rewards) <= end - row and rewards[0] == np.float32(single["rewards"][row])
        factors = 0.99 ** np.arange(min(N_STEPS, len(rewards)))
        assert (rewards[:N_STEPS] * factors).sum() == pytest.approx(right["rewards"][row])


@clients
@needs["d3rlpy"]
def test_d3rlpy_trains_on_windows(folder: Path) -> None:
    import d3rlpy

    window = Window(n_step=2, chunk=2, stack=2, goals=GoalSampling())
    buffer = to_d3rlpy(folder / "state.h5", window=window)
    logged = d3rlpy.logging.NoopAdapterFactory()
    history = (
        d3rlpy.algos.TD3PlusBCConfig(batch_size=8)
        .create(device="cpu")
        .fit(buffer, n_steps=4, n_steps_per_epoch=4, logger_adapter=logged, show_progress=False)
    )
    assert all(np.isfinite(loss) for loss in history[0][1].values())
    with pytest.raises(InvalidInput, match="no place for negatives"):
        to_d3rlpy(folder / "state.h5", window=FULL)
