"""Every task and observation meets Gymnasium's contract, and resets give the requested states."""

import pickle
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence

import knotgym
from knotgym.common import Failed, InvalidInput, MissingFile
from knotgym.envs import tasks
from knotgym.envs.environment import KnotEnv
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.observations import Observer
from knotgym.envs.task_states import task_sides
from knotgym.rendering import Drawer, PictureConfig, draw
from knotgym.states import States, merge_states, write_states
from knotgym.topology import GaussCode, label

from ..conftest import blow_up

TASKS = ("unknot", "tie", "convert")
MODES = ("pixels", "state", "both", "symbolic", "marked")
IDLE = np.zeros(6, dtype=np.float32)
INFO = {
    *("gauss_code", "gauss_code_chiral", "goal_gauss_code", "crossings", "is_success"),
    *("simulation_failed", "start", "goal", "bead", "force", "applied_share"),
}
THREE_VIEWS = {"views": ["front", "top", "left"], "depth": True}

Make = Callable[..., KnotEnv]
same = partial(data_equivalence, exact=True)  # values, shapes and types, recursively


def rollout(env: gym.Env[Any, Any], seed: int, steps: int = 4) -> list[Any]:
    """Collect everything that an agent receives in an episode of seeded random actions."""
    rng = np.random.default_rng(seed)
    return [
        env.reset(seed=seed),
        *(env.step(rng.uniform(-1, 1, 6).astype(np.float32)) for _ in range(steps)),
    ]


def goal_is_shown(episodes: EpisodeBatch, index: int) -> None:
    """Make the code that a rope shows its goal."""
    ids = np.array([index])
    episodes._seek(ids, episodes.codes_of(ids))


@pytest.fixture
def make(states_path: str) -> Make:
    """Create an unwrapped environment on the small state file."""
    return partial(KnotEnv, states=states_path, observation="state")


@pytest.fixture
def registered(states_path: str) -> Callable[..., gym.Env[Any, Any]]:
    """Create an environment by its id, on the small state file."""
    return partial(gym.make, states=states_path, observation="state")


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        *((task, {"observation": observation}) for task in TASKS for observation in MODES),
        *(("tie", {"observation": mode, "image_size": 32, **THREE_VIEWS}) for mode in MODES[::2]),
    ],
)
def test_gymnasium_finds_no_fault(
    registered: Callable[..., gym.Env[Any, Any]],
    task: str,
    settings: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # the check opens a window, too
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # coordinates have no bounds
        warnings.filterwarnings("ignore", message=".*(infinity|-infinity).*")
        check_env(registered(f"knotgym/{task.capitalize()}-v0", **settings).unwrapped)


@pytest.mark.parametrize(("views", "shape"), [({}, (64, 128, 3)), (THREE_VIEWS, (192, 128, 4))])
def test_pictures_and_states_show_the_rope_and_then_the_goal(
    make: Make, states: States, views: dict[str, Any], shape: tuple[int, ...]
) -> None:
    settings: dict[str, Any] = {"nx": 3, "image_size": 64, **views}
    env = make("convert", observation="both", **settings)
    seen, info = env.reset(seed=0)
    ropes = np.stack([env.episodes.simulation.points[0], states.points[info["goal"]]])
    picture, config = seen["pixels"], PictureConfig(size=64, **views)
    assert picture.shape == shape and picture.dtype == np.uint8
    assert same(env.render(), picture[..., :3])
    assert np.array_equal(picture, np.concatenate([*draw(ropes, config)], axis=1))
    assert same(seen["state"], ropes.ravel().astype(np.float32))
    for mode in MODES:
        alone = make("convert", observation=mode, **settings)
        observation = alone.reset(seed=0)[0]
        assert mode not in seen or same(observation, seen[mode])
        assert same(alone.render(), picture[..., :3])
    assert make("tie", render_mode=None).render() is None


def test_a_photo_keeps_its_table_for_an_episode_and_marks_the_base(make: Make) -> None:
    env = make("convert", nx=3, observation="pixels", image_size=96, appearance="photo")
    first, info = env.reset(seed=0)
    second = env.step(IDLE)[0]
    assert first.shape == (96, 192, 3)
    corner = np.s_[:8, :8]
    assert np.abs(first[corner].astype(int) - second[corner]).mean() < 12
    drawer: Any = Drawer.of("photo")
    look = drawer.for_episode(env.episodes.goals.points[info["goal"]], 96, info["goal"])
    points = env.episodes.goals.points[info["goal"]].astype(np.float32).astype(np.float64)
    assert look.marked and not look.occluders and look.tilt == 0
    assert np.array_equal(first[:, 96:], drawer.image(points, look))
    others = {drawer.for_episode(points, 96, row).background for row in range(6)}
    assert len(others) == 6


def test_symbols_are_the_codes_of_rope_and_goal(make: Make) -> None:
    env = make("convert", nx=3, observation="symbolic")
    steps = rollout(env, 0, steps=6)
    for seen, *_, info in steps:
        assert seen.shape == (2, Observer.SYMBOLS) and seen.dtype == np.int16
        for row, name in zip(seen.tolist(), ("gauss_code", "goal_gauss_code"), strict=True):
            visits = [visit for visit in row if visit]
            assert str(GaussCode(tuple(visits))) == info[name]
            assert not any(row[len(visits) :])
    assert np.count_nonzero(steps[0][0][0]) == 4 and np.count_nonzero(steps[0][0][1]) == 6
    # of a code too long the first are kept
    long = np.array([label for k in range(1, 41) for label in (k, -k)])
    assert np.array_equal(Observer.symbols(long), long[: Observer.SYMBOLS])


@pytest.mark.parametrize("task", TASKS)
def test_same_seed_same_arrays(make: Make, task: str) -> None:
    env = make(task, observation="both")
    first = rollout(env, 3)
    other = make(task, observation="both")
    assert same(first, rollout(env, 3)) and same(first, rollout(other, 3))
    # resets go on along the seeded generator
    ours, theirs = [env.reset()[0], env.reset()[0]], [other.reset()[0], other.reset()[0]]
    assert same(ours, theirs) and not same(*ours)


def test_holding_means_consecutive_steps(make: Make) -> None:
    env = make("tie", hold=3)
    env.reset(seed=0)
    ids = np.array([0])
    reached, away = env.episodes.codes_of(ids), env.episodes.goals_of(ids)
    ends = []
    for goal in (reached, reached, away, reached, reached, reached):
        env.episodes._seek(ids, goal)
        ends.append(env.step(IDLE)[1:4])
    assert ends == [(0.0, False, False)] * 5 + [(5.0, True, False)]
    env.reset(seed=0)  # forgets steps held
    goal_is_shown(env.episodes, 0)
    assert env.step(IDLE)[1:4] == (0.0, False, False)


def test_info_tells_the_pull_by_the_same_keys_and_types_at_every_step(make: Make) -> None:
    env = make("tie", horizon=3)
    infos = [env.reset(seed=0)[1]]
    assert infos[0]["bead"] == -1 and not infos[0]["force"].any()
    action = env.episodes.simulation.actions([17], [[0.5, -1.0, 0.25]])[0]
    infos.append(env.step(action)[-1])
    assert infos[1]["bead"] == 17 and np.allclose(infos[1]["force"], [0.1, -0.2, 0.05])
    blow_up(env.episodes.simulation)
    infos.append(env.step(IDLE)[-1])
    for info in infos:
        assert info.keys() == INFO
        assert {key: type(value) for key, value in info.items()} == {
            key: type(value) for key, value in infos[0].items()
        }


def test_what_an_agent_gets_is_its_own(make: Make) -> None:
    env, other = make("tie", observation="both"), make("tie", observation="both")
    rng, expected = np.random.default_rng(0), rollout(other, 0)
    got: Any = env.reset(seed=0)
    for result in expected:
        assert same(got, result)
        got[0]["pixels"][:] = 7
        got[0]["state"][:] = 7
        got[-1]["force"][:] = 7
        got = env.step(rng.uniform(-1, 1, 6).astype(np.float32))


def test_options_pick_rows(make: Make, states: States) -> None:
    env = make("convert", nx=3)
    start, goal = int(states.rows(2, "train")[1]), int(states.rows(3, "train")[2])
    for seed in range(3):
        info = env.reset(seed=seed, options={"start": start, "goal": goal})[1]
        assert (info["start"], info["goal"]) == (start, goal)
        assert (info["gauss_code"], info["goal_gauss_code"]) == (
            states.gauss_code[start],
            states.gauss_code[goal],
        )
        code = label(env.episodes.simulation.points[0])  # the noise of resets keeps it
        assert code.chiral == states.gauss_code_chiral[start] == info["gauss_code_chiral"]


@pytest.fixture
def only_nx3(states: States, tmp_path: Path) -> str:
    """Return a state file that has only rows of nx 3, in both splits."""
    kept = states.take(states.rows(3, "train")), states.take(states.rows(3, "test"))
    write_states(tmp_path / "nx3.h5", merge_states(kept))
    return str(tmp_path / "nx3.h5")


def test_plain_loops_that_the_file_lacks_are_those_that_ship(
    make: Make, states: States, states_path: str, only_nx3: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("knotgym.envs.task_states.shipped", lambda: Path(states_path))
    env = make("tie", nx=3, states=only_nx3)
    for info in (env.reset(seed=0)[1], env.step(IDLE)[4]):
        assert info["crossings"] == 0 and info["start"] in states.rows(0, "train")
        assert info["goal"] in range(6) and GaussCode.parse(info["goal_gauss_code"]).nx == 3
    assert [side.origin for side in task_sides(env.config)[0]] == ["shipped", "own"]
    (shipped,) = task_sides(replace(env.config, states=None))
    assert [side.origin for side in shipped] == ["shipped", "shipped"]


def test_states_that_do_not_fit_are_refused_in_one_line_with_what_the_file_has(
    make: Make, states: States, states_path: str, only_nx3: str, tmp_path: Path
) -> None:
    def file(name: str, kept: States) -> str:
        write_states(tmp_path / name, kept)
        return str(tmp_path / name)

    loopless = file("s.h5", states.take(np.flatnonzero(states.nx > 0)))
    train = file("train.h5", states.take(np.flatnonzero(states.split == "train")))
    other = file("other.h5", replace(states, attributes={"rope": "0123456789abcdef"}))
    missing = "nx = {0} in split 'train' of .*nx3.h5, .* nx = {1}; it has nx 3 .train, test. "
    missing += "of 0_1. Generate some: knotgym-generate --nx {0}$"
    wrong: list[tuple[Any, dict[str, Any], str]] = [
        ("unknot", {"nx": 2, "states": only_nx3}, missing.format(2, 2)),
        ("tie", {"nx": 2, "split": "test", "states": train}, "in split 'test' .* nx 0 .train., 1"),
        ("tie", {"states": other}, "made for rope model 0123456789abcdef, this version has "),
        (["tie", "convert"], {"nx": 2, "states": loopless}, "has no plain loops"),
        (
            ["tie", "unknot"],
            {"nx": 7, "states": "hard-unknots", "split": "test"},
            "has no plain loops",
        ),
    ]
    make("tie", nx=(2, 3), states=loopless)
    for task, settings, says in wrong:
        with pytest.raises(InvalidInput, match=says) as caught:
            make(task, **settings)
        assert "\n" not in str(caught.value)
    # the folder of a run names its states
    (tmp_path / "run").mkdir()
    with pytest.raises(MissingFile, match="no .* file at .*run"):
        make("unknot", states=str(tmp_path / "run"))
    (tmp_path / "run" / "states.h5").write_bytes(Path(states_path).read_bytes())
    assert task_sides(make("unknot", states=str(tmp_path / "run")).config)[0][0].origin == "own"


def test_numeric_infos_say_the_same_in_integers(make: Make) -> None:
    words, numbers = make("unknot", nx=3), make("unknot", nx=3, numeric_infos=True)
    text, told = words.reset(seed=1)[1], numbers.reset(seed=1)[1]
    code = GaussCode.parse(text["gauss_code_chiral"])
    assert text.keys() == told.keys()
    assert all(isinstance(value, np.ndarray) for value in told.values())
    assert told["gauss_code"].dtype == np.int16 and told["gauss_code"].shape == (64,)
    assert tuple(told["gauss_code"][:6]) == code.visits and not told["gauss_code"][6:].any()
    assert tuple(told["gauss_code_chiral"][:3]) == code.signs
    assert not told["goal_gauss_code"].any()
    numbers.reset(options={"start": told["start"]})  # what info holds is an option, too


@pytest.mark.parametrize("observation", ["pixels", "both"])
def test_stacked_pictures_have_the_goals_channels_last(make: Make, observation: str) -> None:
    settings: dict[str, Any] = {"observation": observation, "image_size": 16}
    env = make("tie", layout="stacked", **settings)
    seen, beside = env.reset(seed=0)[0], make("tie", **settings).reset(seed=0)[0]
    assert seen in env.observation_space
    if observation == "both":
        seen, beside = seen["pixels"], beside["pixels"]
    assert np.array_equal(seen[..., :3], beside[:, :16])
    assert np.array_equal(seen[..., 3:], beside[:, 16:])
    rendered = env.render()
    assert rendered is not None and np.array_equal(rendered, beside)


@pytest.mark.parametrize("observation", MODES)
def test_a_blown_up_simulation_ends_the_episode_unseen(make: Make, observation: str) -> None:
    env = make("tie", observation=observation)
    seen = env.reset(seed=0)[0]
    blow_up(env.episodes.simulation)
    result, reward, terminated, truncated, info = env.step(np.full(6, 0.5, dtype=np.float32))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["simulation_failed"] and not info["is_success"]
    assert same(result, seen)  # the rope has not moved


@pytest.mark.parametrize("observation", MODES)
def test_pickles_go_on(registered: Callable[..., gym.Env[Any, Any]], observation: str) -> None:
    env = registered("knotgym/Tie-v0", observation=observation, horizon=6)
    rollout(env, 0, steps=3)
    again = pickle.loads(pickle.dumps(env))
    rng = np.random.default_rng(1)
    for _ in range(3):
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        assert same(again.step(action), env.step(action))
    assert same(again.reset(), env.reset())


@pytest.mark.clients
def test_the_window_opens_shows_the_rope_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("knotgym/Tie-v0", nx=2, render_mode="human", observation="state")
    env.reset(seed=0)
    env.step(np.zeros(6, np.float32))
    seen = pygame.surfarray.array3d(pygame.display.get_surface())
    assert seen.shape[0] == 768 and (seen.max(axis=2) > 200).sum() > 500
    env.close()
    assert pygame.display.get_surface() is None


@pytest.mark.clients
def test_a_window_without_a_display_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonesuch")
    env = KnotEnv("tie", render_mode="human")
    with pytest.raises(Failed, match="needs a display; use 'rgb_array' without one: "):
        env.reset(seed=0)


@pytest.mark.parametrize("few", [1, 3, 1000])
def test_goals_are_the_first_rows_of_the_split(few: int) -> None:
    whole = KnotEnv("tie", nx=3, split="test", observation="symbolic").episodes.rows["goal"]
    env = KnotEnv("tie", nx=3, split="test", observation="symbolic", max_goals=few)
    assert env.episodes.rows["goal"].tolist() == whole.tolist()[:few]
    drawn = {env.reset(seed=seed)[1]["goal"] for seed in range(24)}
    assert drawn <= {*whole[:few].tolist()} and (few > 1) == (len(drawn) > 1)
    starts = {env.reset(seed=seed)[1]["start"] for seed in range(24)}
    assert len(starts) > 1  # max_goals doesn't limit the starts
    with pytest.raises(InvalidInput, match=rf"of the test split(, of the first {few})?: "):
        env.reset(options={"goal": max(whole.tolist()) + 1})


def test_an_environment_of_several_tasks_draws_one_at_each_reset(make: Make) -> None:
    env = make(["tie", "convert"], nx=(2, 3), observation="state")
    drawn = set()
    for seed in range(40):
        observation, info = env.reset(seed=seed)
        drawn.add((info["crossings"], GaussCode.parse(info["goal_gauss_code"]).nx))
        rows = {"start": info["start"], "goal": info["goal"]}
        assert np.array_equal(env.reset(seed=seed, options=rows)[0], observation)
    assert drawn == {(0, 2), (0, 3), (1, 2), (2, 3)}
    with pytest.raises(InvalidInput, match="goal must be a row with nx = 2, 3 of the train split"):
        env.reset(options={"goal": rows["start"] + 10**6})


def test_a_registered_task_is_played_as_its_crossings_say() -> None:
    knotgym.register_task("simplify", lambda nx: (nx, nx - 1))
    try:
        with pytest.raises(InvalidInput, match="a task's name is a new lower-case word, got"):
            knotgym.register_task("simplify", lambda nx: (nx, 0))
        made: Any = gym.make("knotgym/Simplify-v0", nx=3, observation="state")
        info = made.reset(seed=0)[1]
        assert info["crossings"] == 3 and GaussCode.parse(info["goal_gauss_code"]).nx == 2
    finally:
        del tasks.TASKS["simplify"], gym.registry["knotgym/Simplify-v0"]


SHORT: dict[str, Any] = {"engine": "chain", "observation": "state", "horizon": 4}


def test_a_spec_survives_json_with_horizon(registered: Callable[..., gym.Env[Any, Any]]) -> None:
    # NumPy's scalars, from which JSON can't be made
    settings: dict[str, Any] = {"nx": np.int64(3), "split": np.str_("test"), "action": "bead"}
    settings |= {"reset_noise": np.float32(0.25), "depth": np.bool_(False)}
    env: Any = registered(
        "knotgym/Convert-v0", hold=2, rope={"joint_damping": 0.02}, **settings, **SHORT
    )
    again: Any = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec and pickle.loads(pickle.dumps(env.spec)) == env.spec
    assert again.unwrapped.config == env.unwrapped.config
    assert env.spec.max_episode_steps == 4 and env.unwrapped.config.rope == {"joint_damping": 0.02}
    assert same(again.reset(seed=0), env.reset(seed=0))
    many = gym.make_vec("knotgym/Tie-v0", num_envs=2, nx=np.uint8(2), **SHORT)
    assert many.spec is not None and many.spec.max_episode_steps == 4 and many.spec.to_json()
    assert gym.make_vec(many.spec).unwrapped.config.horizon == 4  # type: ignore[attr-defined]


@pytest.mark.parametrize(("limit", "truth"), [(3, 3), (120, 4)])
def test_another_limit_of_gymnasium_is_honoured_or_said_to_be_without_effect(
    limit: int, truth: int, recwarn: pytest.WarningsRecorder
) -> None:
    env = gym.make("knotgym/Tie-v0", max_episode_steps=limit, **SHORT)
    env.reset(seed=0)
    ends = [env.step(np.zeros(6, np.float32))[3] for _ in range(truth)]
    assert ends == [False] * (truth - 1) + [True]
    assert env.spec is not None and env.spec.max_episode_steps == truth and env.spec.to_json()
    assert (limit > 4) == any(
        "make the environment with horizon=120" in str(w.message) for w in recwarn
    )


def test_vectorized_environments_take_gymnasiums_word_for_the_horizon() -> None:
    keywords = {**SHORT, "num_envs": 2, "max_episode_steps": 9}
    with pytest.raises(InvalidInput, match="max_episode_steps is 9 and horizon 4"):
        gym.make_vec("knotgym/Tie-v0", **keywords)
    del keywords["horizon"]
    envs: Any = gym.make_vec("knotgym/Tie-v0", **keywords)
    assert envs.unwrapped.config.horizon == 9


def test_a_user_sets_parameters_of_the_rope() -> None:
    ends = []
    for rope in (None, {"joint_damping": 0.02}, {"max_force": 0.1, "medium_density": 5000.0}):
        env = KnotEnv("tie", rope=rope, **SHORT)
        env.reset(seed=0)
        for action in np.random.default_rng(0).uniform(-1, 1, (4, 6)):
            seen = env.step(action.astype(np.float32))[0]
        ends.append(seen)
        for name, value in (rope or {}).items():
            assert getattr(env.episodes.simulation.rope.config, name) == value
    assert len({one.tobytes() for one in ends}) == 3
