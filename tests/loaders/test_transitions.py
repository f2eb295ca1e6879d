"""Tests of loaders: every row of a batch is aligned with the columns of the dataset."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import BEADS, TASK, TINY, episodes, written
from synthetic_pictures import picture_rows

from knotgym.common import InvalidFile, InvalidInput, Occupied, Table
from knotgym.datasets import STEPS, Episodes, PictureRow, open_episodes, parquet
from knotgym.envs import KnotEnv
from knotgym.loaders import (
    GoalSampling,
    Sequences,
    Transitions,
    Window,
    arrays,
    images,
    statistics,
    to_d3rlpy,
    to_tensordict,
    torch_dataset,
)
from knotgym.rendering import AppearanceConfig, PictureConfig

LENGTHS = [3, 1, 6, 2]
N, S = sum(LENGTHS), len(LENGTHS)
clients = pytest.mark.clients


@pytest.fixture(scope="module")
def made() -> Episodes:
    return episodes(LENGTHS, codes=[0, 1, 1, 2, 0, 1, 0, 0, 1, 2, 2, 3, 1, 0, 0, 0])


@pytest.fixture(scope="module")
def path(made: Episodes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("loaders") / "state.h5", made)


def state_of(made: Episodes, rows: Any, goals: Any) -> np.ndarray:
    """Return the expected state observations of rows of steps, from their definition."""
    seen = made.steps["observation"][rows].reshape(len(rows), -1)
    return np.concatenate([seen, np.reshape(goals, (len(rows), -1))], axis=1)


BEFORE = np.concatenate([np.arange(n) + k + sum(LENGTHS[:k]) for k, n in enumerate(LENGTHS)])
OWNERS = np.repeat(np.arange(S), LENGTHS)


@pytest.mark.parametrize("block", [5, 1024])
def test_rows_align(made: Episodes, path: Path, block: int, monkeypatch: Patch) -> None:
    monkeypatch.setattr("knotgym.loaders.drawn_frames._BLOCK", block)  # of states that are copied
    held = arrays(path)
    goals = made.episodes["goal_points"][OWNERS]
    np.testing.assert_array_equal(held["observations"], state_of(made, BEFORE, goals))
    np.testing.assert_array_equal(held["next_observations"], state_of(made, BEFORE + 1, goals))
    for name, column in (
        ("actions", "action"),
        ("rewards", "reward"),
        ("terminals", "terminated"),
        ("timeouts", "truncated"),
    ):
        np.testing.assert_array_equal(held[name], made.steps[column][BEFORE])


def test_a_batch_is_rows_of_the_arrays_or_halves_of_them(made: Episodes, path: Path) -> None:
    held, opened = arrays(path), Transitions(path)
    for name, column in opened.batch([4, -1, 0]).items():
        np.testing.assert_array_equal(column, held[name][[4, N - 1, 0]])
    for wrong in ([[1]], [N], [-N - 1], [1.5], np.arange(N) > 0):
        with pytest.raises(IndexError, match=f"whole numbers below {N}, got .*$"):
            opened.batch(wrong)
    halves, goals = opened.batch([4, 0], apart=True), made.episodes["goal_points"][OWNERS[[4, 0]]]
    seen = made.steps["observation"][BEFORE[[4, 0]]]
    np.testing.assert_array_equal(halves["observations"], seen.reshape(2, -1))
    np.testing.assert_array_equal(halves["goals"], goals.reshape(2, -1))


def test_hindsight_cuts_at_every_code_that_was_reached(made: Episodes, path: Path) -> None:
    held, (episode, step) = arrays(path, relabel="all"), made.goals_reached(TASK)
    assert len(held["rewards"]) == step.sum()
    ends = np.cumsum(step) - 1
    assert np.flatnonzero(held["terminals"]).tolist() == ends.tolist()
    assert held["rewards"].tolist() == (5.0 * held["terminals"]).tolist()
    shown = made.steps["observation"][made.offsets[episode] + step].reshape(len(ends), -1)
    for name in ("observations", "next_observations"):
        np.testing.assert_array_equal(held[name][ends][:, 3 * BEADS :], shown)
    np.testing.assert_array_equal(held["next_observations"][ends][:, : 3 * BEADS], shown)
    last = Transitions(path, relabel="last")
    assert last.episode.tolist() == [0, 1, 2] and last.goal_step.tolist() == [3, 1, 5]


@pytest.mark.parametrize(
    "look",
    [
        *({"observation": seen} for seen in ("pixels", "state", "symbolic", "marked")),
        *({"observation": "pixels", "appearance": look} for look in ("photo", "line")),
    ],
    ids=str,
)
def test_observations_are_those_of_the_environment(look: dict[str, Any]) -> None:
    opened = open_episodes(TINY["expert"])
    dataset = replace(opened, task=replace(opened.task, **look))
    (own, steps), offsets = dataset.episodes, dataset.episodes.offsets
    env = KnotEnv(**vars(dataset.task))
    right = [env.reset(seed=int(own["seed"][1]))[0]]
    right += [env.step(action)[0] for action in steps["action"][offsets[1] : offsets[2] - 1]]
    # frames of marked observations are computed from float32 vertices
    near = 1e-6 if look["observation"] == "marked" else 0
    seen = Transitions(dataset).observations(1)
    np.testing.assert_allclose(seen, np.stack(right), rtol=0, atol=near)


def test_a_cache_holds_every_picture_once(tmp_path: Path) -> None:
    plain = Transitions(TINY["expert"], observation="both")
    kept = Transitions(TINY["expert"], observation="both", cache=tmp_path / "c")
    (file,) = (tmp_path / "c").iterdir()
    before, rows = file.stat().st_mtime_ns, open_episodes(TINY["expert"]).episodes.steps.rows
    assert np.load(file, mmap_mode="r")["picture"].shape == (rows + 3, 32, 32, 3)
    for one in (kept, pickle.loads(pickle.dumps(kept))):
        for name in ("pixels", "state"):
            np.testing.assert_array_equal(
                one.batch([9, 3])["observations"][name], plain.batch([9, 3])["observations"][name]
            )
    assert file.stat().st_mtime_ns == before  # later processes read it
    small: dict[str, Any] = {"observation": "pixels", "picture": PictureConfig(size=16)}
    seen = arrays(TINY["expert"], cache=tmp_path / "c", **small)["observations"]
    assert seen.shape[1:] == (16, 32, 3) and len([*(tmp_path / "c").iterdir()]) == 2


def test_a_cache_is_not_read_by_other_code(tmp_path: Path, monkeypatch: Patch) -> None:
    opened = Transitions(TINY["expert"], observation="pixels", cache=tmp_path)
    opened.batch([0])
    monkeypatch.setattr("knotgym.loaders.drawn_frames.code_sha256", lambda folder: "other")
    Transitions(TINY["expert"], observation="pixels", cache=tmp_path).batch([0])
    assert len([*tmp_path.rglob("*.npy")]) >= 2


def test_a_changed_cut_or_linked_cache_is_one_line(tmp_path: Path) -> None:
    def opened() -> Transitions:
        return Transitions(TINY["expert"], observation="pixels", cache=tmp_path / "c")

    opened()
    (file,) = (tmp_path / "c").iterdir()
    changed = bytearray(file.read_bytes())
    changed[-1000] ^= 1  # the goal of the last episode
    file.write_bytes(changed)
    data = opened()
    data.batch([0])
    with pytest.raises(InvalidFile, match="is damaged: delete the file"):
        data.batch([len(data) - 1])
    file.write_bytes(changed[:100])
    with pytest.raises(InvalidFile, match="delete it"):
        opened()
    file.unlink()
    file.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InvalidFile):
        opened()
    assert not (tmp_path / "elsewhere").exists()


def test_sets_of_other_states_share_no_pictures(made: Episodes, path: Path, tmp_path: Path) -> None:
    moved = made.steps.replaced(observation=np.roll(made.steps["observation"], 9, axis=1))
    goals = made.episodes.replaced(goal_points=made.episodes["goal_points"][::-1])
    others = made._replace(steps=moved), made._replace(episodes=goals)
    for k, other in enumerate(others):
        sets = path, written(tmp_path / f"{k}.h5", other)
        kept = [arrays(one, observation="pixels", cache=tmp_path / "c") for one in sets]
        assert not np.array_equal(kept[0]["observations"], kept[1]["observations"])
        right = arrays(sets[1], observation="pixels")["observations"]
        np.testing.assert_array_equal(kept[1]["observations"], right)


def test_labels_take_the_place_of_actions(tmp_path: Path) -> None:
    made = episodes([3, 1])
    steps = {**made.steps, "expert_action": np.full_like(made.steps["action"], 0.5)}
    table = Table(STEPS.sized(**dict(made.steps.schema.sizes)), steps)
    path = written(tmp_path / "a.h5", made._replace(steps=table))
    assert (Transitions(path, labels=True).actions == 0.5).all()
    history = Transitions(path, labels=True, window=Window(history=1)).batch([1])["history"]
    np.testing.assert_array_equal(history[0, 0], made.steps["action"][0])


def test_rewards_of_my_own_reach_every_window(made: Episodes, path: Path) -> None:
    def fewer(episode: dict[str, Any], steps: Table) -> Any:
        assert len(steps["crossings"]) == episode["length"] + 1
        return -steps["crossings"][1:]

    own = -made.steps["crossings"][BEFORE + 1].astype(float)
    np.testing.assert_array_equal(arrays(path, reward=fewer)["rewards"], own)
    two = Transitions(path, reward=fewer, window=Window(n_step=2, discount=0.5)).batch([0])
    assert two["rewards"] == own[0] + 0.5 * own[1]
    with pytest.raises(InvalidInput, match=r"finite numbers, got nan in episode 2, step 4$"):
        arrays(path, reward=lambda own, steps: [1.0, 1, 1, 1, np.nan, 1][: own["length"]])


def test_a_reward_that_changes_and_keeps_what_it_is_given_changes_no_column() -> None:
    dataset, kept = open_episodes(TINY["expert"]), np.zeros(20)
    own, steps = dataset.episodes
    before = steps["observation"].copy(), own["goal_points"].copy()

    def careless(episode: dict[str, Any], steps: Table) -> Any:
        steps["observation"][:] = 0
        episode["goal_points"][:] = 0
        kept[:] = episode["seed"]
        return kept[: episode["length"]]

    found = Transitions(dataset, reward=careless)
    for segment, seed in enumerate(own["seed"]):
        assert (found.rewards[slice(*found.starts[segment : segment + 2])] == seed).all()
    np.testing.assert_array_equal(steps["observation"], before[0])
    np.testing.assert_array_equal(own["goal_points"], before[1])


def test_an_empty_dataset_is_empty_and_a_recording_refused(tmp_path: Path, made: Episodes) -> None:
    with pytest.raises(InvalidInput, match="recording"):
        arrays(written(tmp_path / "r.h5", made.recording()))
    path = written(tmp_path / "a.h5", made.select([]))
    assert {name: len(column) for name, column in arrays(path).items()} == dict.fromkeys(
        ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts"), 0
    )


def test_sequences_are_copies_of_the_columns(made: Episodes, path: Path) -> None:
    data = Sequences(path, 3)
    assert len(Sequences(path, 1)) > len(data)
    assert data.starts.tolist() == [0, 1, 6, 7, 8, 9, 10, 13]
    one = data[3]
    np.testing.assert_array_equal(one["observation"], made.steps["observation"][7:10])
    assert one["episode"].tolist() == [2]
    one["observation"][:] = 0  # as torch would in mapped memory, which ended the process
    several = data[[2, 3]]
    assert several["episode"].tolist() == [[2], [2]] and several["observation"][1].any()
    assert len(pickle.loads(pickle.dumps(data))) == len(data)


@clients
def test_items_of_all_datasets_are_taken_by_any_index(path: Path, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    ropes = open_episodes(TINY["expert"]).episodes.steps["observation"][:4].astype(np.float64)
    table = PictureRow.drawn(picture_rows([*ropes]), AppearanceConfig())
    (tmp_path / "train.parquet").write_bytes(parquet(table))
    every: Any = torch_dataset(path), Sequences(path, 3), images(tmp_path / "train.parquet")
    for data in every:
        ones = [*data]
        for part in ones[0].values():
            part[...] = 9  # changes no other reader's item
        ones[0] = data[0]
        for index in (1, np.uint8(1), np.array(1), torch.tensor(1), 1 - len(data)):
            assert all((part == ones[1][name]).all() for name, part in data[index].items())
        for several in ([2, 0], np.array([2, 0]), torch.tensor([2, 0]), slice(2, None, -2)):
            for name, part in data[several].items():
                assert (part == np.stack([ones[2][name], ones[0][name]])).all()
        for wrong in (len(data), -len(data) - 1, True, 1.5, "1", [[1]], torch.ones(3) > 0):
            with pytest.raises(IndexError, match=f"whole numbers below {len(data)}, got "):
                data[wrong]
        assert len([*torch.utils.data.Subset(data, torch.randperm(3))]) == 3


@clients
@pytest.mark.parametrize("workers", [0, 2])
def test_torch_transitions_are_aligned_with_any_number_of_workers(path: Path, workers: int) -> None:
    DataLoader = pytest.importorskip("torch.utils.data").DataLoader
    held = arrays(path)
    loader = DataLoader(torch_dataset(path), batch_size=4, num_workers=workers)
    batches = [*loader]
    for name, column in (("observation", "observations"), ("reward", "rewards")):
        found = np.concatenate([batch[name].numpy() for batch in batches])
        np.testing.assert_allclose(found, held[column].astype(np.float32))
    chunks = torch_dataset(path, window=Window(n_step=5, chunk=5))
    batch = next(iter(DataLoader(chunks, batch_size=N, num_workers=workers)))
    assert batch["action"].shape == (N, 5, 6) and batch["action_mask"].any(1).all()
    assert batch["reward"].shape == batch["discount"].shape == (N,)


@clients
def test_a_tensordict_holds_all_transitions_in_memory_or_mapped(
    path: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    pytest.importorskip("tensordict")
    held = arrays(path)
    monkeypatch.setattr("knotgym.loaders.converters._AT_ONCE", 5)
    drawn: Any = {"window": Window(goals=GoalSampling(negatives=2))}  # they depend on no block
    once, mapped = to_tensordict(path, **drawn), to_tensordict(path, folder=tmp_path / "a", **drawn)
    assert (once == mapped).all() and len(once["negatives"]) == N
    for data in (to_tensordict(path), to_tensordict(path, folder=tmp_path / "td")):
        assert data.batch_size == (N,)
        np.testing.assert_array_equal(data["observation"].numpy(), held["observations"])
        np.testing.assert_array_equal(
            data["next", "observation"].numpy(), held["next_observations"]
        )
        np.testing.assert_array_equal(data["episode"].numpy(), OWNERS)
        ends = held["terminals"] | held["timeouts"]
        np.testing.assert_array_equal(data["next", "done"].numpy()[:, 0], ends)
    mapped = to_tensordict(path, folder=tmp_path / "own")
    # another set's tensors are never written over those that somebody holds
    with pytest.raises(Occupied, match="own exists already; choose another folder"):
        to_tensordict(path, relabel="all", folder=tmp_path / "own")
    np.testing.assert_array_equal(mapped["action"].numpy(), held["actions"])
    assert {one.name for one in tmp_path.iterdir()} == {"a", "own", "td"}


@clients
def test_d3rlpy_holds_every_transition_and_pictures_channels_first(path: Path) -> None:
    pytest.importorskip("d3rlpy")
    buffer = to_d3rlpy(path)
    held, row = arrays(path), 0
    for episode, length in zip(buffer.episodes, LENGTHS, strict=True):
        assert episode.transition_count == length
        np.testing.assert_array_equal(
            episode.observations[:length], held["observations"][row : row + length]
        )
        row += length
    buffer = to_d3rlpy(TINY["expert"], observation="pixels")
    assert buffer.episodes[0].observations.shape[1:] == (3, 32, 64)
    with pytest.raises(InvalidInput, match="use action 'pull'"):
        to_d3rlpy(TINY["expert"], action="bead")
    with pytest.raises(InvalidInput, match="windows of its own"):
        to_d3rlpy(TINY["expert"], window=Window())


def test_several_datasets_load_as_one(tmp_path: Path) -> None:
    task = replace(TASK, nx=3, engine="mujoco", horizon=9)
    two = written(tmp_path / "one.h5", episodes([2, 1])), tmp_path / "two.h5"
    written(two[1], episodes([3], seed=1), task)
    both = pickle.loads(pickle.dumps(Transitions([*two], observation="symbolic")))
    for name, column in both.batch(range(6)).items():
        apart = [arrays(one, observation="symbolic")[name] for one in two]
        np.testing.assert_array_equal(column, np.concatenate(apart))
    written(tmp_path / "hold.h5", episodes([3]), replace(TASK, hold=2))
    with pytest.raises(InvalidInput, match=r"must have one hold: .*one.h5 has 1, .*hold.h5 has 2"):
        arrays([two[0], tmp_path / "hold.h5"])


def test_statistics_are_those_of_the_arrays(path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("knotgym.loaders.converters._AT_ONCE", 5)
    drawn: Any = {"window": Window(goals=GoalSampling())}
    held, found = arrays(path, **drawn), statistics(path, **drawn)
    for name in ("observations", "actions"):
        np.testing.assert_allclose(found[name]["mean"], held[name].mean(axis=0), atol=1e-6)
        spread = held[name].std(axis=0)
        kept = spread > 1e-4
        np.testing.assert_allclose(found[name]["std"][kept], spread[kept], rtol=1e-3)
        assert (found[name]["std"] > 0).all()
        assert np.array_equal(found[name]["min"], held[name].min(axis=0))
        assert np.array_equal(found[name]["max"], held[name].max(axis=0))
