"""Exports to other formats keep every row of an episode.

They are read back with NumPy and pyarrow and, with -m clients, with the target libraries.
"""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from PIL import Image

from knotgym.common.errors import InvalidInput, Occupied
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import replay
from knotgym.datasets.episode_writer import EpisodeWriter
from knotgym.datasets.exports import lerobot_export
from knotgym.datasets.exports.forms import export
from knotgym.datasets.exports.lerobot_export import LEAST_PSNR, task_text
from knotgym.datasets.exports.minari_export import to_minari
from knotgym.datasets.minari_dataset import MinariMetadata, publish
from knotgym.datasets.trajectory import Episode
from knotgym.envs.environment import KnotEnv
from knotgym.envs.tasks import TaskConfig
from knotgym.states.state_file import read_states, shipped, write_states

from ..small_job import knotgym
from .test_episodes import record


@pytest.fixture(scope="module")
def task(states_path: str) -> TaskConfig:
    return TaskConfig(task="tie", states=states_path, observation="both", horizon=5, image_size=16)


@pytest.fixture(scope="module")
def episodes(task: TaskConfig) -> list[Episode]:
    env = KnotEnv(**vars(task))
    return [record(env, seed)[0] for seed in range(4)]


@pytest.fixture(scope="module")
def dataset(
    tmp_path_factory: pytest.TempPathFactory, task: TaskConfig, episodes: list[Episode]
) -> Path:
    """A small Minari dataset of pictures and vertices."""
    room = tmp_path_factory.mktemp("exports")
    with EpisodeWriter(room / "a.h5", task) as writer:
        for episode in episodes:
            writer.add(episode)
    told = MinariMetadata(
        dataset_id="knotgym/tie-nx2/noisy-expert-v0", algorithm_name="noisy", description="Few."
    )
    return publish([room / "a.h5"], told, room)


def test_the_episodes_are_those_of_a_replay(task: TaskConfig, episodes: list[Episode]) -> None:
    assert replay(episodes, task) == [None] * 4


def wanted(dataset: Path, observation: str, rows: list[int]) -> dict[str, Any]:
    """Compute the expected OGBench arrays from their definition."""
    reader = EpisodeReader(dataset)
    seen = [reader.observations(k, observation=observation) for k in rows]
    half = [one[:, :300] if observation == "state" else one[:, :, :16] for one in seen]
    acted = [reader.episode(k).actions for k in rows]
    return {
        "observations": np.concatenate(half),
        "actions": np.concatenate([np.concatenate([a, np.zeros((1, 6))]) for a in acted]),
        "terminals": np.concatenate([np.arange(len(a) + 1) == len(a) for a in acted]),
    }


def test_ogbench_files_hold_every_state_once(dataset: Path, tmp_path: Path) -> None:
    counted: list[tuple[str, int, int]] = []
    export(dataset, tmp_path, "ogbench", lambda *said: counted.append(said))
    assert counted[:4] == [("episodes of pixels", *at) for at in ((0, 3), (1, 3), (2, 3), (0, 1))]
    for look, observation in (("", "state"), ("visual-", "pixels")):
        name = f"{look}tie-nx2-noisy_expert-v0"
        for end, rows in (("-train", [0, 1, 2]), ("-val", [3]), ("", [0, 1, 2])):
            held, right = np.load(tmp_path / f"{name}{end}.npz"), wanted(dataset, observation, rows)
            assert {*held} == {*right}
            assert all(np.array_equal(held[key], right[key]) for key in right)
            assert held["actions"].dtype == np.float32
    with pytest.raises(Occupied, match="exists already"):
        export(dataset, tmp_path, "ogbench")


def test_lerobot_rows_are_the_episodes_steps(dataset: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    counted: list[tuple[str, int, int]] = []
    export(dataset, tmp_path / "a", "lerobot", lambda *said: counted.append(said))
    assert counted == [("episodes", done, 4) for done in range(4)]
    info = json.loads((tmp_path / "a/meta/info.json").read_text())
    rows = parquet.read_table(tmp_path / "a/data/chunk-000/file-000.parquet").to_pylist()
    tasks = parquet.read_table(tmp_path / "a/meta/tasks.parquet").to_pydict()["task"]
    assert (info["codebase_version"], info["total_frames"]) == ("v3.0", len(rows))
    reader, at = EpisodeReader(dataset), 0
    for k, episode in enumerate(reader):
        seen = reader.observations(k)
        for step in range(len(episode)):
            row = rows[at]
            picture = np.asarray(Image.open(io.BytesIO(row["observation.image"]["bytes"])))
            assert np.array_equal(picture, seen["pixels"][step])
            assert row["observation.environment_state"] == seen["state"][step].tolist()
            assert row["action"] == episode.actions[step].tolist()
            assert np.allclose(row["observation.state"], episode.points[step].mean(axis=0))
            assert row["next.reward"] == episode.rewards[step]
            assert row["next.done"] is (step == len(episode) - 1)
            assert row["gauss_code"] == episode.gauss_code[step]
            assert (row["index"], row["episode_index"], row["frame_index"]) == (at, k, step)
            assert tasks[row["task_index"]] == task_text(episode.goal_gauss_code)
            at += 1
    assert at == len(rows)
    stats = json.loads((tmp_path / "a/meta/stats.json").read_text())
    actions = np.array([row["action"] for row in rows])
    assert np.allclose(stats["action"]["mean"], actions.mean(axis=0))
    assert np.allclose(stats["action"]["std"], actions.std(axis=0))
    assert stats["action"]["count"] == [len(rows)] and info["video_path"] is None
    episodes = parquet.read_table(
        tmp_path / "a/meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    for k, row in enumerate(episodes):
        own = reader.column(k, "actions")
        assert np.allclose(row["stats/action/q10"], np.quantile(own, 0.1, axis=0))
        seen = reader.observations(k, slice(0, len(own)), observation="pixels") / 255
        assert np.allclose(np.ravel(row["stats/observation.image/mean"]), seen.mean((0, 1, 2)))
    weights = [row["length"] / len(rows) for row in episodes]
    of_all = np.average([row["stats/action/q90"] for row in episodes], axis=0, weights=weights)
    assert np.allclose(stats["action"]["q90"], of_all)
    assert np.shape(stats["observation.image"]["mean"]) == (3, 1, 1)
    assert "lossless PNG" in (tmp_path / "a/README.md").read_text()


@pytest.mark.parametrize("video", ["h264", "av1"])
def test_lerobot_s_video_shows_the_pictures(states_path: str, tmp_path: Path, video: str) -> None:
    av, parquet = pytest.importorskip("av"), pytest.importorskip("pyarrow.parquet")
    task = TaskConfig(task="tie", states=states_path, horizon=3)
    env = KnotEnv(**vars(task))
    with EpisodeWriter(tmp_path / "a.h5", task) as writer:
        for seed in range(2):
            writer.add(record(env, seed)[0])
    out = tmp_path / "a"
    assert (
        knotgym("dataset", "export", tmp_path / "a.h5", "--to", "lerobot", "--video", video,
                "--out", out) == 0
    )  # fmt: skip
    reader = EpisodeReader(tmp_path / "a.h5")
    shown = np.concatenate(
        [reader.observations(k, slice(0, int(reader.lengths[k]))) for k in range(2)]
    )
    with av.open(str(out / "videos/observation.image/chunk-000/file-000.mp4")) as film:
        frames = [*film.decode(video=0)]
    decoded = np.array([frame.to_ndarray(format="rgb24") for frame in frames], dtype=np.float64)
    assert decoded.shape == shown.shape
    errors = ((decoded - shown) ** 2).mean(axis=(1, 2, 3))
    assert 10 * np.log10(255**2 / errors.max()) >= LEAST_PSNR[video]
    assert np.allclose([frame.time for frame in frames], np.arange(len(shown)) / 5)
    episodes = parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    begins = [row["videos/observation.image/from_timestamp"] for row in episodes]
    ends = [row["videos/observation.image/to_timestamp"] for row in episodes]
    assert begins == [0, ends[0]] and ends[1] == len(shown) / 5
    info = json.loads((out / "meta/info.json").read_text())
    assert info["features"]["observation.image"]["dtype"] == "video"
    columns = parquet.read_table(out / "data/chunk-000/file-000.parquet").column_names
    assert "observation.image" not in columns
    assert "**lossy**" in (out / "README.md").read_text()


@pytest.mark.clients
@pytest.mark.parametrize(("video", "most"), [("h264", 1), ("av1", 2**20)])
def test_lerobot_reads_the_frames_of_video(
    states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, video: str, most: int
) -> None:
    library = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    monkeypatch.setattr(
        lerobot_export, "_VIDEO_BYTES", most
    )  # one file per episode, or one for all
    task = TaskConfig(task="tie", states=states_path, horizon=4)
    env = KnotEnv(**vars(task))
    with EpisodeWriter(tmp_path / "a.h5", task) as writer:
        for seed in range(3):
            writer.add(record(env, seed)[0])
    export(tmp_path / "a.h5", tmp_path / "a", "lerobot", video=video)
    given: dict[str, Any] = {"root": tmp_path / "a", "video_backend": "pyav"}
    held = library.LeRobotDataset("knotgym/tie-nx2", **given)
    reader, at = EpisodeReader(tmp_path / "a.h5"), 0
    assert len([*(tmp_path / "a/videos").rglob("*.mp4")]) == (3 if most == 1 else 1)
    for k, length in enumerate(reader.lengths.tolist()):
        for picture in reader.observations(k, slice(0, length)):
            seen = np.moveaxis(held[at]["observation.image"].numpy(), 0, -1) * 255
            assert 10 * np.log10(255**2 / ((seen - picture) ** 2).mean()) >= LEAST_PSNR[video]
            at += 1
    windowed = library.LeRobotDataset(
        "knotgym/tie-nx2", **given, delta_timestamps={"observation.image": [-0.2, 0.0]}
    )
    assert windowed[2]["observation.image"].shape == (2, 3, 128, 256)
    assert set(held.meta.stats["observation.image"]) >= {"mean", "std", "q01", "q99", "count"}


def test_what_can_t_be_video_is_refused(
    dataset: Path, task: TaskConfig, episodes: list[Episode], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(InvalidInput, match="no video 'vp9'; there is h264, av1"):
        export(dataset, out, "lerobot", video="vp9")
    with pytest.raises(InvalidInput, match="AV1 needs an even number of at least 64 pixels"):
        export(dataset, out, "lerobot", video="av1")
    with pytest.raises(InvalidInput, match="format ogbench has no video, got 'h264'"):
        export(dataset, out, "ogbench", video="h264")
    with EpisodeWriter(tmp_path / "a.h5", replace(task, observation="state")) as writer:
        writer.add(episodes[0])
    with pytest.raises(InvalidInput, match="has no pictures to write as video"):
        export(tmp_path / "a.h5", out, "lerobot", video="h264")
    given = ("dataset", "export", dataset, "--to", "minari", "--video", "h264", "--out", out)
    assert knotgym(*given) == 2 and not out.exists()


def test_what_has_no_place_in_a_form_is_refused(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    with EpisodeWriter(tmp_path / "a.h5", replace(task, observation="symbolic")) as writer:
        writer.add(episodes[0])
    with pytest.raises(InvalidInput, match="at least 2 episodes .* has 1 of symbolic"):
        export(tmp_path / "a.h5", tmp_path / "out", "ogbench")
    with pytest.raises(InvalidInput, match="has 1 episodes of symbolic in layout beside"):
        export(tmp_path / "a.h5", tmp_path / "out", "lerobot")
    with pytest.raises(match="no format 'hdf5'; formats are compact, lerobot, ogbench"):
        export(tmp_path / "a.h5", tmp_path / "out", "hdf5")
    assert (
        knotgym("dataset", "export", tmp_path / "a.h5", "--to", "x", "--out", tmp_path / "o") == 2
    )
    assert not (tmp_path / "out").exists()


@pytest.fixture
def two(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """Two datasets in a Minari root, each with a copy of the states that they start from."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    ids = [f"knotgym/tie-nx2/{name}-v0" for name in ("a", "b")]
    for k, own in enumerate(ids):
        with EpisodeWriter(tmp_path / f"{k}.h5", replace(task, states=own)) as writer:
            for episode in episodes[2 * k : 2 * k + 2]:
                writer.add(episode)
        told = MinariMetadata(
            dataset_id=own, algorithm_name=f"policy {k}", description=f"Dataset {k}.", author=("A",)
        )
        publish([tmp_path / f"{k}.h5"], told, states=task.states)
    return ids


def test_two_datasets_merge_into_one_that_minari_loads(
    two: list[str], episodes: list[Episode]
) -> None:
    assert knotgym("dataset", "merge", *two, "--id", "knotgym/both-v0") == 0
    held = minari.load_dataset("knotgym/both-v0")
    assert held.total_episodes == 4 and held.spec.env_spec.kwargs["states"] == "knotgym/both-v0"
    assert held.storage.metadata["algorithm_name"] == "policy 0, policy 1"
    pixels = [one.observations["pixels"] for one in held.iterate_episodes()]
    for source, part in zip(two, (pixels[:2], pixels[2:]), strict=True):
        reader = EpisodeReader(source)
        for k, seen in enumerate(part):
            assert np.array_equal(seen, reader.observations(k)["pixels"])
    environment = held.recover_environment(eval_env=True)
    assert environment.unwrapped.config.split == "test"
    assert knotgym("dataset", "merge", *two, "--id", "knotgym/both-v0") == 2  # it is there


def test_datasets_of_two_state_files_are_not_merged(
    two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "minari" / two[1] / "data" / "states.h5"
    write_states(other, read_states(shipped()))
    assert knotgym("dataset", "merge", *two, "--id", "knotgym/both-v0") == 2
    assert "these differ in states" in "".join(capsys.readouterr())


def test_a_plain_file_never_lands_in_minaris_folder(
    two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "minari" / "knotgym" / "both-v0"
    assert knotgym("dataset", "merge", *two, "--out", out) == 2
    assert knotgym("dataset", "export", two[0], "--out", out.with_suffix(".h5")) == 2
    assert knotgym("dataset", "merge", *two) == 2
    told = " ".join("".join(capsys.readouterr()).split())
    assert "merge with --id knotgym/name-v0" in told and "give an output" in told
    assert [*out.parent.glob("both*")] == []


@pytest.mark.clients
def test_ogbench_reads_its_files_and_makes_their_environment(
    dataset: Path, tmp_path: Path, states_path: str
) -> None:
    ogbench = pytest.importorskip("ogbench")
    export(dataset, tmp_path / "knotgym", "ogbench")
    for look, observation in (("", "state"), ("visual-", "pixels")):
        env, train, val = ogbench.make_env_and_datasets(
            f"knotgym/{look}tie-nx2-noisy_expert-v0",
            dataset_dir=str(tmp_path),
            states=states_path,
            image_size=16,
        )
        right = wanted(dataset, observation, [0, 1, 2])
        last = right["terminals"]
        assert np.array_equal(train["observations"], right["observations"][~last])
        assert np.array_equal(train["next_observations"], right["observations"][1:][~last[:-1]])
        assert np.array_equal(train["actions"], right["actions"][~last])
        assert len(val["actions"]) == 5 and train["observations"][0].shape == env.reset()[0].shape
        seen, info = env.reset(options={"task_id": 5, "render_goal": True})
        assert info["goal"].shape == seen.shape and "success" in env.step(train["actions"][0])[4]


def test_lerobot_s_task_is_a_sentence_for_the_plain_loop_too() -> None:
    assert task_text("") == "Untie the rope into a plain loop."
    assert task_text("1+,1-") == "Move the rope until its Gauss code is 1+,1-."


@pytest.mark.clients
def test_lerobot_reads_every_row(dataset: Path, tmp_path: Path) -> None:
    library = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    export(dataset, tmp_path / "a", "lerobot")
    held = library.LeRobotDataset("knotgym/tie-nx2", root=tmp_path / "a")
    reader = EpisodeReader(dataset)
    assert (held.num_episodes, held.num_frames) == (4, int(reader.lengths.sum()))
    at = 0
    for k, episode in enumerate(reader):
        seen = reader.observations(k)
        for step in range(len(episode)):
            item = held[at]
            picture = (item["observation.image"].numpy() * 255).round().astype(np.uint8)
            assert np.array_equal(np.moveaxis(picture, 0, -1), seen["pixels"][step])
            state = item["observation.environment_state"].numpy()
            assert np.array_equal(state, seen["state"][step])
            assert np.array_equal(item["action"].numpy(), episode.actions[step])
            assert item["next.reward"].item() == episode.rewards[step]
            assert item["task"] == task_text(episode.goal_gauss_code)
            at += 1
    part = library.LeRobotDataset("knotgym/tie-nx2", root=tmp_path / "a", episodes=[2])
    assert part.num_frames == int(reader.lengths[2])
    windowed = library.LeRobotDataset(
        "knotgym/tie-nx2", root=tmp_path / "a", delta_timestamps={"action": [0.0, 0.2]}
    )
    assert np.array_equal(windowed[0]["action"].numpy(), reader.episode(0).actions[:2])


def test_an_id_that_leads_out_is_refused(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    told = json.loads((copy / "data" / "metadata.json").read_text())
    for name, said in (("knotgym/../../x-v0", "leads out"), (None, "not a Minari dataset")):
        changed = {**told, "dataset_id": name} if name else {"dataset_id": "knotgym/x-v0"}
        (copy / "data" / "metadata.json").write_text(json.dumps(changed))
        with pytest.raises(InvalidInput, match=said):
            to_minari([copy], tmp_path / "out" / "root")
    assert not (tmp_path / "out").exists()
