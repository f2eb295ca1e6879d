"""Ten jobs that people come with. Each is a function of at most 15 lines, in the order of a first
week; later ones use the datasets of earlier ones."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import knotgym
from knotgym.loaders import Window, arrays, images, torch_dataset

from .scripts import ROOT
from .small_job import knotgym as typed

MOST_LINES = 15
FAST = ("--engine", "chain", "--workers", 1, "--quiet")
RANDOM = "knotgym/random-v0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An empty folder to work in, with a dataset of random play."""
    with pytest.MonkeyPatch.context() as patched:
        place = tmp_path_factory.mktemp("jobs")
        patched.chdir(place)
        # the link `datasets` of a checkout would be found for Hugging Face's library
        patched.setattr(sys, "path", [one for one in sys.path if Path(one).resolve() != ROOT])
        patched.setenv("MINARI_DATASETS_PATH", str(place / "minari"))
        assert typed("collect", "--policy", "random", "--episodes", 4, "--id", RANDOM, *FAST) == 0
        yield place


def ppo_on_small_pictures(folder: Path) -> None:
    from stable_baselines3 import PPO

    from knotgym.adapters import sb3_vec_env

    envs = sb3_vec_env("tie", num_envs=4, nx=2, image_size=64, layout="stacked", engine="chain")
    model = PPO("CnnPolicy", envs, n_steps=8, batch_size=32, n_epochs=1).learn(32)
    assert model.num_timesteps == 32 and model.observation_space.shape == (6, 64, 64)


def chunks_of_random_play(folder: Path) -> None:
    from torch.utils.data import DataLoader

    window = Window(n_step=5, chunk=5)
    data = torch_dataset(RANDOM, observation="state", window=window)
    batch = next(iter(DataLoader(data, batch_size=32, shuffle=True)))
    assert batch["action"].shape == (32, 5, 6) and batch["action_mask"].any(1).all()
    assert batch["reward"].shape == batch["discount"].shape == (32,)


def a_network_on_pictures(folder: Path) -> None:
    import torch
    from torch.utils.data import DataLoader

    count = ("--count", 8, "--set", "test_nx=none", "--set", "code_share=0")
    assert typed("images", "--nx", "0,1", *count, "--out", "pictures", "--workers", 1) == 0
    layers = [torch.nn.LazyConv2d(8, 5, 4), torch.nn.ReLU(), torch.nn.Flatten()]
    network = torch.nn.Sequential(*layers, torch.nn.LazyLinear(2))
    batch = next(iter(DataLoader(images("pictures", "train"), batch_size=4)))
    logits = network(batch["image"].float() / 255)
    loss = torch.nn.functional.cross_entropy(logits, batch["nx"])
    loss.backward()
    assert loss.isfinite()


def a_folder_for_hugging_face(folder: Path) -> None:
    datasets: Any = pytest.importorskip("datasets")

    export = ("dataset", "export", RANDOM, "--to", "huggingface", "--out", "upload")
    assert typed(*export, "--quiet") == 0
    assert "license: cc-by-4.0" in Path("upload/README.md").read_text()
    rows = datasets.load_dataset("upload", "steps", cache_dir="cache")["train"]
    assert len(rows[0]["points"]) == 300


def a_policy_of_my_own(folder: Path) -> None:
    lines = "import numpy as np\ndef act(seen):\n    return np.append(seen[:3] / 2, [0, 0, 1])\n"
    Path("mine.py").write_text(lines)
    line = ("evaluate", "--policy", "mine:act", "--episodes", 4, "--out", "scores.json", *FAST)
    assert typed(*line) == 0
    assert '"success_rate"' in Path("scores.json").read_text()


def a_reward_of_my_own(folder: Path) -> None:
    def fewer(episode: dict[str, Any], steps: Any) -> Any:
        return -steps["crossings"][1:] - 0.1 * np.abs(steps["force"][:-1]).sum(axis=1)

    data = arrays(RANDOM, observation="state", reward=fewer, window=Window(n_step=3))
    assert data["rewards"].shape == (len(data["actions"]),) and (data["rewards"] < 0).all()


def wrappers_and_vector_environments(folder: Path) -> None:
    settings: dict[str, Any] = {"nx": 2, "observation": "state", "engine": "chain"}
    env = gym.wrappers.FrameStackObservation(gym.make("knotgym/Tie-v0", **settings), 3)
    assert env.reset(seed=0)[0].shape == (3, 600)
    envs = gym.make_vec("knotgym/Tie-v0", num_envs=3, **settings)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=0)
    seen, rewards, *_ = envs.step(envs.action_space.sample())
    assert seen.shape == (3, 600) and rewards.shape == (3,)


def playing_by_hand(folder: Path) -> None:
    from knotgym.envs import TaskConfig
    from knotgym.play import Recorder, Session

    task, name = TaskConfig(task="tie", observation="both", engine="chain"), "knotgym/human-v0"
    session = Session(task, seed=0)
    for _ in range(3):
        session.pull(bead=10, force=(1.0, 0.0, 0.5))
    with Recorder(task, 0, name, player="Ann") as recorder:
        recorder.finish(session.number, session.pulls)
    assert knotgym.verify(name) == [] and len(arrays(name)["actions"]) == task.horizon


def states_of_my_own(folder: Path) -> None:
    from knotgym.states import write_states

    turn = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    curl = np.exp(1j * turn) + 0.75 * np.exp(2j * turn)  # one crossing
    curve = np.stack([curl.real, curl.imag, 0.1 * np.sin(turn)], axis=1)
    write_states("own.h5", knotgym.States.from_points([knotgym.Rope().from_curve(curve)]))
    env = gym.make("knotgym/Unknot-v0", nx=1, states="own.h5", observation="state")
    assert env.reset(seed=0)[1]["crossings"] == 1


def sets_that_are_merged_and_filtered(folder: Path) -> None:
    for nx in (2, 3):
        line = ("--nx", nx, "--policy", "random", "--episodes", 3, "--id", f"knotgym/nx{nx}-v0")
        assert typed("collect", *line, *FAST) == 0
    both, late, few = "knotgym/both-v0", "late.h5", "few.h5"
    assert typed("dataset", "merge", "knotgym/nx2-v0", "knotgym/nx3-v0", "--id", both) == 0
    assert typed("dataset", "select", both, "--where", "nx = 3", "--out", late) == 0
    assert typed("dataset", "select", both, "--where", "episode not in (0, 5)", "--out", few) == 0
    found = [knotgym.datasets.open_episodes(name).episodes.episodes.rows for name in (late, few)]
    assert found == [3, 4]


JOBS: list[Callable[[Path], None]] = [
    ppo_on_small_pictures,
    chunks_of_random_play,
    a_network_on_pictures,
    a_folder_for_hugging_face,
    a_policy_of_my_own,
    a_reward_of_my_own,
    wrappers_and_vector_environments,
    playing_by_hand,
    states_of_my_own,
    sets_that_are_merged_and_filtered,
]


@pytest.mark.clients
@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.__name__)
def test_a_job_is_done(job: Callable[[Path], None], folder: Path) -> None:
    for library in ("torch", "stable_baselines3", "pyarrow", "datasets"):
        pytest.importorskip(library)
    assert Path.cwd() == folder and os.listdir(folder)
    job(folder)


def test_no_job_takes_more_lines() -> None:
    counts = {job.__name__: len(inspect.getsource(job).strip().splitlines()) - 1 for job in JOBS}
    assert {name: count for name, count in counts.items() if count > MOST_LINES} == {}
