"""Loaders keep rows aligned and episode ends in place.

The dataset encodes the episode and the step in every number, so misplaced rows show.
"""

from __future__ import annotations

import importlib.util
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import knotgym
from knotgym.common.errors import MissingExtra
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.trajectory import Episode
from knotgym.envs.observations import observe
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import Transitions, arrays, to_d3rlpy, to_tensordict, torch_dataset
from knotgym.rendering.picture import PictureConfig

clients = pytest.mark.clients
no_torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch isn't installed"
)
no_d3rlpy = pytest.mark.skipif(
    importlib.util.find_spec("d3rlpy") is None, reason="d3rlpy isn't installed"
)
no_torchrl = pytest.mark.skipif(
    importlib.util.find_spec("torchrl") is None, reason="torchrl isn't installed"
)

# (steps, terminated) of 15 episodes, from 1 step, the shortest possible, to 70, more than a chunk
EPISODES = [((7 * k * k + 3 * k) % 23 + 1, k % 3 != 0) for k in range(14)] + [(70, False)]
TASK = TaskConfig(task="tie", observation="state", horizon=100)
SMALL = PictureConfig(size=16)
VIEWS = PictureConfig(size=16, views=("top", "left", "front"), depth=True)


def coded(k: int) -> Episode:
    """Make episode k, with k and the step in every array and a new code at every step."""
    length, terminated = EPISODES[k]
    states, last = np.arange(length + 1), np.arange(length) == length - 1
    number = 1000.0 * k + states
    angle = 2 * np.pi * np.arange(100) / 100
    shape = np.stack([np.cos(angle), np.sin(angle), 0.01 * np.sin(3 * angle)], axis=1)
    turn = 0.01 * number
    across = shape[:, 0] * (0.1 + 0.001 * k)
    points = np.stack(
        [
            across * np.cos(turn[:, None]),
            across * np.sin(turn[:, None]),
            np.broadcast_to(shape[:, 2], (length + 1, 100)),
        ],
        axis=2,
    )
    points[:, :, 1] += shape[:, 1] * 0.05
    points[:, 0, 0] = number
    points[:, 1, 0] = -number
    return Episode(
        start_qpos=np.full(421, 1000.0 * k),
        points=points,
        goal_points=np.full((100, 3), -1.0 * k),
        actions=np.stack(
            [np.full(length, k / 64), states[:-1] / 128, *np.zeros((4, length))], axis=1
        ).astype(np.float32),
        rewards=np.asarray(number[:-1] + 0.5, dtype=np.float64),
        terminations=last & terminated,
        truncations=last & (not terminated),
        gauss_code=np.array([f"code {k} {step}" for step in states]),
        gauss_code_chiral=np.array([f"{k}" for _ in states]),
        crossings=states + 1000 * k,
        bead=states,
        force=np.zeros((length + 1, 3)),
        applied_share=np.ones(length + 1),
        is_success=np.zeros(length + 1, dtype=bool),
        simulation_failed=np.zeros(length + 1, dtype=bool),
        goal_gauss_code=f"goal {k}",
        seed=k,
        policy="coded",
    )


ALL = [coded(k) for k in range(len(EPISODES))]
N = sum(length for length, _ in EPISODES)
OWNERS = np.concatenate([np.full(length, k) for k, (length, _) in enumerate(EPISODES)])
STEPS = np.concatenate([np.arange(length) for length, _ in EPISODES])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episode files: state observations and compact, merged from shards; and nine episodes with
    small pictures, with symbols, and with pictures of three views with depth.
    """
    room = tmp_path_factory.mktemp("coded")
    for k in range(3):
        with EpisodeWriter(room / f"shard{k}.h5", TASK) as writer:
            for number in range(k, len(ALL), 3):
                writer.add(ALL[number], number)
    shards = [room / f"shard{k}.h5" for k in range(3)]
    merge_episodes(shards, room / "state.h5")
    merge_episodes(shards, room / "compact.h5", store="none")
    with EpisodeWriter(
        room / "both.h5", replace(TASK, observation="both", image_size=16)
    ) as writer:
        for episode in ALL[:9]:
            writer.add(episode)
    merge_episodes([room / "both.h5"], room / "symbolic.h5", store="symbolic")
    seen = replace(TASK, observation="pixels", image_size=16, views=VIEWS.views, depth=True)
    with EpisodeWriter(room / "views.h5", seen) as writer:
        for episode in ALL[:9]:
            # from the side, beads a kilometre apart take minutes to draw
            writer.add(replace(episode, points=np.clip(episode.points, -0.3, 0.3)))
    merge_episodes([room / "views.h5"], room / "unseen.h5", store="none")
    return room


@pytest.fixture(params=["state.h5", "compact.h5"])
def path(request: pytest.FixtureRequest, folder: Path) -> Path:
    return folder / str(request.param)


def state_of(
    owner: NDArray[Any], step: NDArray[Any], goal_step: NDArray[Any] | None = None
) -> NDArray[np.float32]:
    """Compute the expected state observation from its definition."""
    goals = [
        ALL[k].goal_points if goal_step is None else ALL[k].points[goal_step[i]]
        for i, k in enumerate(owner)
    ]
    return np.array(
        [
            np.concatenate([ALL[k].points[t].ravel(), g.ravel()])
            for k, t, g in zip(owner, step, goals, strict=True)
        ]
    ).astype(np.float32)


def test_arrays_are_aligned(path: Path) -> None:
    held = arrays(path)
    assert {name: len(column) for name, column in held.items()} == dict.fromkeys(held, N)
    assert np.array_equal(held["observations"], state_of(OWNERS, STEPS))
    assert np.array_equal(held["next_observations"], state_of(OWNERS, STEPS + 1))
    assert np.array_equal(held["rewards"], 1000 * OWNERS + STEPS + 0.5)
    assert np.array_equal(held["actions"][:, 0] * 64, OWNERS) and np.array_equal(
        held["actions"][:, 1] * 128, STEPS
    )


def test_arrays_end_where_the_episodes_end(path: Path) -> None:
    held = arrays(path)
    ends = np.cumsum([length for length, _ in EPISODES]) - 1
    assert np.flatnonzero(held["terminals"] | held["timeouts"]).tolist() == ends.tolist()
    assert held["terminals"][ends].tolist() == [terminated for _, terminated in EPISODES]
    assert not (held["terminals"] & held["timeouts"]).any()


def test_arrays_of_pictures_are_what_the_environment_shows(folder: Path) -> None:
    held = arrays(folder / "both.h5")
    row = 0
    for k in range(9):
        right = observe(ALL[k].points, ALL[k].goal_points, "both", SMALL)
        rows = slice(row, row + len(ALL[k]))
        for name in ("pixels", "state"):
            assert np.array_equal(held["observations"][name][rows], right[name][:-1])
            assert np.array_equal(held["next_observations"][name][rows], right[name][1:])
        row = rows.stop
    assert row == len(held["rewards"]) == len(held["observations"]["pixels"])


def test_pictures_of_another_size_are_drawn(folder: Path) -> None:
    held = arrays(folder / "compact.h5", observation="pixels", picture=SMALL)
    for row in (0, 5, 40, N - 1):
        right = observe(
            ALL[OWNERS[row]].points[[STEPS[row]]], ALL[OWNERS[row]].goal_points, "pixels", SMALL
        )[0]
        assert np.array_equal(held["observations"][row], right)


def test_hindsight_to_the_last_code_makes_the_last_state_the_goal(path: Path) -> None:
    held = arrays(path, relabel="last")
    lengths = np.array([length for length, _ in EPISODES])
    assert np.array_equal(held["observations"], state_of(OWNERS, STEPS, lengths[OWNERS]))
    assert np.array_equal(held["next_observations"], state_of(OWNERS, STEPS + 1, lengths[OWNERS]))
    assert (
        np.array_equal(held["terminals"], lengths[OWNERS] == STEPS + 1)
        and not held["timeouts"].any()
    )
    assert np.array_equal(held["rewards"], 5.0 * held["terminals"])


def test_hindsight_to_every_code_gives_one_segment_a_code(folder: Path) -> None:
    found = Transitions(folder / "both.h5", relabel="all")
    pairs = [(k, goal) for k in range(9) for goal in range(1, EPISODES[k][0] + 1)]
    assert list(zip(found.episode.tolist(), found.goal_step.tolist(), strict=True)) == pairs
    assert np.diff(found.starts).tolist() == [goal for _, goal in pairs]
    for segment in (0, 3, len(pairs) - 1):
        k, goal = pairs[segment]
        right = observe(ALL[k].points[: goal + 1], ALL[k].points[goal], "both", SMALL)
        seen = found.observations(segment)
        assert all(np.array_equal(seen[name], right[name]) for name in right)


@pytest.mark.parametrize("relabel", [None, "last"])
def test_symbols_load_stored_or_made_from_vertices(folder: Path, relabel: str | None) -> None:
    stored = arrays(folder / "symbolic.h5", relabel=relabel)
    made = arrays(folder / "both.h5", observation="symbolic", relabel=relabel)
    for name in ("observations", "next_observations"):
        assert stored[name].dtype == np.int16 and stored[name].shape[1:] == (2, 64)
        assert np.array_equal(stored[name], made[name])


@pytest.mark.parametrize("relabel", [None, "last"])
def test_views_and_depth_load_stored_or_drawn(folder: Path, relabel: str | None) -> None:
    stored = arrays(folder / "views.h5", relabel=relabel)
    drawn = arrays(folder / "unseen.h5", picture=VIEWS, relabel=relabel)
    for name in ("observations", "next_observations"):
        assert stored[name].dtype == np.uint8 and stored[name].shape[1:] == (48, 32, 4)
        assert np.array_equal(stored[name], drawn[name])


@no_torch
@pytest.mark.parametrize("kind", ["transitions", "episodes", "frames"])
@pytest.mark.parametrize(
    ("name", "shape", "dtype"),
    [("symbolic.h5", (2, 64), "torch.int16"), ("views.h5", (48, 32, 4), "torch.uint8")],
)
def test_torch_gives_symbols_views_and_depth_as_stored(
    folder: Path, kind: str, name: str, shape: tuple[int, ...], dtype: str
) -> None:
    found, item = Transitions(folder / name), torch_dataset(folder / name, kind=kind)[5]
    if kind == "episodes":
        seen, right = item["observations"], found.observations(5)
    else:
        segment, step = found.place(5) if kind == "transitions" else found.frame_place(5)
        seen, right = item["observation"], found.observations(segment, step)[0]
    assert tuple(seen.shape)[-len(shape) :] == shape and str(seen.dtype) == dtype
    assert np.array_equal(seen.numpy(), right)


def test_a_transition_knows_its_segment_and_step(folder: Path) -> None:
    found = Transitions(folder / "state.h5")
    assert [found.place(i) for i in range(N)] == list(
        zip(OWNERS.tolist(), STEPS.tolist(), strict=True)
    )


def test_an_empty_dataset_loads_empty(tmp_path: Path) -> None:
    with EpisodeWriter(tmp_path / "a.h5", TASK):
        pass
    assert len(Transitions(tmp_path / "a.h5")) == 0
    assert len(arrays(tmp_path / "a.h5")["rewards"]) == 0


def test_transitions_pickle_and_read_on(folder: Path) -> None:
    found = Transitions(folder / "state.h5")
    found.observations(3)
    again = pickle.loads(pickle.dumps(found))
    assert np.array_equal(again.observations(3), found.observations(3))


@pytest.mark.parametrize(
    ("load", "missing"),
    [(torch_dataset, "torch"), (to_d3rlpy, "d3rlpy"), (to_tensordict, "tensordict")],
)
def test_a_missing_library_says_how_to_install_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, load: Any, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(
        MissingExtra, match=rf"needs {missing}, which isn't installed; install it: .*pip install"
    ):
        load(folder / "state.h5")


def test_importing_the_loaders_imports_no_simulator_and_no_learner() -> None:
    unwanted = {"mujoco", "torch", "dask", "cv2", "minari", "d3rlpy"}
    script = (
        "import sys, knotgym.loaders; print(sorted({name.split('.')[0] for name in sys.modules}"
        f" & {unwanted}))"
    )
    found = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(knotgym.__file__).parent.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.strip() == "[]"


# Other libraries


@clients
@no_torch
@pytest.mark.parametrize("workers", [0, 3])
def test_torch_transitions_are_aligned_with_any_number_of_workers(path: Path, workers: int) -> None:
    import torch

    data = torch_dataset(path)
    data[0]  # the file is open before the workers fork
    seen = list(torch.utils.data.DataLoader(data, batch_size=17, num_workers=workers))
    held = {name: torch.cat([batch[name] for batch in seen]).numpy() for name in seen[0]}
    assert isinstance(data, torch.utils.data.Dataset) and len(data) == N
    assert np.array_equal(held["observation"], state_of(OWNERS, STEPS)) and np.array_equal(
        held["next_observation"], state_of(OWNERS, STEPS + 1)
    )
    assert np.array_equal(held["reward"], 1000 * OWNERS + STEPS + 0.5) and np.array_equal(
        held["action"][:, 1] * 128, STEPS
    )
    right = arrays(path)
    assert np.array_equal(held["terminal"], right["terminals"]) and np.array_equal(
        held["timeout"], right["timeouts"]
    )


@clients
@no_torch
def test_torch_workers_started_afresh_read_too(folder: Path) -> None:
    import torch

    loader = torch.utils.data.DataLoader(
        torch_dataset(folder / "state.h5"),
        batch_size=100,
        num_workers=2,
        multiprocessing_context="spawn",
    )
    assert np.array_equal(
        torch.cat([batch["reward"] for batch in loader]).numpy(), 1000 * OWNERS + STEPS + 0.5
    )


@clients
@no_torch
def test_torch_frames_hold_every_state_once(folder: Path) -> None:
    data = torch_dataset(folder / "both.h5", kind="frames")
    places = [(k, step) for k in range(9) for step in range(EPISODES[k][0] + 1)]
    assert [(item["episode"], item["step"]) for item in data] == places
    for index, (k, step) in enumerate(places):
        right = observe(ALL[k].points[[step]], ALL[k].goal_points, "both", SMALL)
        assert all(
            np.array_equal(data[index]["observation"][name].numpy(), right[name][0])
            for name in right
        )
        assert data[index]["gauss_code"] == f"code {k} {step}"


@clients
@no_torch
def test_torch_episodes_are_whole(folder: Path) -> None:
    data = torch_dataset(folder / "state.h5", kind="episodes")
    assert len(data) == len(EPISODES)
    for k in range(len(EPISODES)):
        assert np.array_equal(
            data[k]["observations"].numpy(),
            state_of(np.full(len(ALL[k]) + 1, k), np.arange(len(ALL[k]) + 1)),
        )
        assert np.array_equal(data[k]["rewards"].numpy(), ALL[k].rewards.astype(np.float32))
        assert bool(data[k]["terminals"][-1]) is EPISODES[k][1]


@clients
@no_d3rlpy
def test_d3rlpy_holds_every_transition(folder: Path) -> None:
    buffer = to_d3rlpy(folder / "state.h5")
    found = [
        (k, buffer.transition_picker(episode, step))
        for k, episode in enumerate(buffer.episodes)
        for step in range(episode.transition_count)
    ]
    assert len(found) == buffer.transition_count == N
    right = arrays(folder / "state.h5")
    for row, (k, one) in enumerate(found):
        assert (
            k == OWNERS[row]
            and np.array_equal(one.observation, right["observations"][row])
            and np.array_equal(one.action, right["actions"][row])
        )
        assert one.reward[0] == right["rewards"][row] and bool(one.terminal) is bool(
            right["terminals"][row]
        )
        assert one.terminal or np.array_equal(one.next_observation, right["next_observations"][row])


@clients
@no_d3rlpy
def test_d3rlpy_pictures_are_channels_first(folder: Path) -> None:
    buffer = to_d3rlpy(folder / "both.h5", observation="pixels")
    assert buffer.episodes[0].observations.shape[1:] == (3, 16, 32)
    assert np.array_equal(
        np.moveaxis(buffer.episodes[2].observations[1], 0, -1),
        observe(ALL[2].points[[1]], ALL[2].goal_points, "pixels", SMALL)[0],
    )


@clients
@no_d3rlpy
def test_d3rlpy_takes_symbols_views_and_depth(folder: Path) -> None:
    for name, shape in (("symbolic.h5", (2, 64)), ("views.h5", (4, 48, 32))):
        buffer, right = to_d3rlpy(folder / name), Transitions(folder / name).observations(2)
        seen = buffer.transition_picker(buffer.episodes[2], 1).observation
        assert seen.shape == shape and seen.dtype == right.dtype
        assert np.array_equal(seen, right[1] if len(shape) == 2 else np.moveaxis(right[1], -1, 0))


@clients
@no_d3rlpy
@pytest.mark.parametrize("algorithm", ["BC", "IQL"])
def test_d3rlpy_trains_an_epoch(folder: Path, tmp_path: Path, algorithm: str) -> None:
    import d3rlpy

    config = getattr(d3rlpy.algos, f"{algorithm}Config")(batch_size=32)
    learner = config.create(device="cpu")
    steps = N // 32
    logged = d3rlpy.logging.NoopAdapterFactory()
    history = learner.fit(
        to_d3rlpy(folder / "state.h5"),
        n_steps=steps,
        n_steps_per_epoch=steps,
        logger_adapter=logged,
        show_progress=False,
    )
    assert len(history) == 1 and all(np.isfinite(loss) for loss in history[0][1].values())
    assert learner.predict(state_of(np.array([3]), np.array([0]))).shape == (1, 6)


@clients
@no_torchrl
def test_a_tensordict_holds_every_transition(path: Path) -> None:
    held, right = to_tensordict(path), arrays(path)
    assert held.batch_size == (N,)
    assert np.array_equal(held["observation"].numpy(), right["observations"]) and np.array_equal(
        held["next", "observation"].numpy(), right["next_observations"]
    )
    assert np.array_equal(held["action"].numpy(), right["actions"]) and np.array_equal(
        held["next", "reward"].numpy()[:, 0], right["rewards"]
    )
    assert np.array_equal(held["next", "terminated"].numpy()[:, 0], right["terminals"])
    assert np.array_equal(
        held["next", "done"].numpy()[:, 0], right["terminals"] | right["timeouts"]
    )
    assert np.array_equal(held["episode"].numpy(), OWNERS) and not held["done"].any()


@clients
@no_torchrl
@pytest.mark.parametrize("name", ["symbolic.h5", "views.h5"])
def test_a_tensordict_takes_symbols_views_and_depth(folder: Path, name: str) -> None:
    held, right = to_tensordict(folder / name), arrays(folder / name)
    for part in ("observation", ("next", "observation")):
        column = right["next_observations" if isinstance(part, tuple) else "observations"]
        assert held[part].numpy().dtype == column.dtype
        assert np.array_equal(held[part].numpy(), column)


@clients
@no_torchrl
def test_torchrl_samples_aligned_batches(folder: Path) -> None:
    import torch
    from torchrl.data import LazyMemmapStorage, SliceSampler, TensorDictReplayBuffer

    torch.manual_seed(0)
    held = to_tensordict(folder / "both.h5")
    buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(len(held)), batch_size=32)
    buffer.extend(held)
    batch = buffer.sample()
    rows = batch["next", "reward"][:, 0].numpy() - 0.5
    right = state_of((rows // 1000).astype(int), (rows % 1000).astype(int))
    assert np.array_equal(batch["state"].numpy(), right) and batch["pixels"].shape == (
        32,
        16,
        32,
        3,
    )
    sampler = SliceSampler(slice_len=2, traj_key="episode", strict_length=True)
    slices = TensorDictReplayBuffer(
        storage=LazyMemmapStorage(len(held)), sampler=sampler, batch_size=16
    )
    slices.extend(held)
    reward = slices.sample()["next", "reward"].reshape(8, 2)
    assert torch.equal(reward[:, 1], reward[:, 0] + 1)
