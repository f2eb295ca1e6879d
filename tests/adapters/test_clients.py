"""The code of docs/clients.md and the clients' own readers, each where it is installed."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import MinariMetadata, publish
from knotgym.envs import TaskConfig

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/clients.md").read_text(encoding="utf-8")
ID = "knotgym/tie-nx2/expert-v0"
NEEDS = {
    "Minari": "minari",
    "TorchRL": "torchrl",
    "d3rlpy": "d3rlpy",
    "Stable-Baselines3": "stable_baselines3",
    "OGBench": "ogbench",
    "LeRobot": "lerobot",
    "tianshou": "tianshou",
    "CleanRL": "gymnasium",
}
TRAIN = "lerobot.scripts.lerobot_train"  # the module of LeRobot's command
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.S | re.M))
TASK = TaskConfig(task="tie", observation="both", horizon=6, image_size=32, engine="chain")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a home folder whose Minari folder has the dataset that the page uses."""
    home = tmp_path_factory.mktemp("home")
    played = rollouts(make_policy(PolicyConfig(policy="expert")), TASK, range(12))
    metadata = MinariMetadata(dataset_id=ID, algorithm_name="expert", description="Few.")
    publish([played], TASK, metadata, home / "minari")
    return home


@pytest.mark.clients
@pytest.mark.parametrize("client", NEEDS)
def test_the_lines_of_the_page_run(client: str, room: Path) -> None:
    pytest.importorskip(NEEDS[client])
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "HOME": str(room),
        "MINARI_DATASETS_PATH": str(room / "minari"),
    }
    programs = {
        "knotgym": "-m knotgym",
        "lerobot-train": f"-m {TRAIN}",
        "python examples": f"{ROOT}/examples",
    }
    lines = re.findall(rf"^    ((?:{'|'.join(programs)})(?:.+\\\n)*.+)$", SECTIONS[client], re.M)
    for name, run in programs.items():
        lines = [line.replace(name, run, 1) if line.startswith(name) else line for line in lines]
    commands = [
        [sys.executable, *shlex.split(line.replace("~", str(room)).replace("\\\n", " "))]
        for line in lines
    ]
    blocks = re.findall(r"```python\n(.*?)```", SECTIONS[client], re.S)
    for words in [*commands, *([sys.executable, "-c", block] for block in blocks)]:
        ended = subprocess.run(words, cwd=room, env=environment, capture_output=True, text=True)
        assert ended.returncode == 0, ended.stderr[-2000:]


@pytest.mark.clients
def test_torchrl_reads_last_infos_of_the_batch() -> None:
    envs = pytest.importorskip("torchrl.envs")
    batch = gym.make_vec(
        "knotgym/Tie-v0",
        num_envs=3,
        observation="state",
        horizon=4,
        numeric_infos=True,
        autoreset_mode="same_step",
    )
    rollout = envs.GymWrapper(batch).rollout(6, break_when_any_done=False)
    assert rollout["next", "truncated"].sum() == 3
    assert rollout["next", "goal_gauss_code"].shape == (3, 6, 64)
