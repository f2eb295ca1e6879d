"""Policies from files: what a model says is what is done, for every kind of observation.

Run with -m clients, each where its library is.
"""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.errors import InvalidPolicy
from knotgym.control.learned_policies import Model, ModelPolicy, load_model
from knotgym.control.policies import make_policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import rollout
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig

OBSERVATIONS = ("state", "pixels", "both")


def needs(*names: str) -> Any:
    lacking = [name for name in names if importlib.util.find_spec(name) is None]
    return [
        pytest.mark.clients,
        pytest.mark.skipif(bool(lacking), reason=f"not installed: {', '.join(lacking)}"),
    ]


def chosen(path: Path, states_path: str, observation: str) -> tuple[NDArray[np.float32], list[Any]]:
    """What the policy in a file does in three episodes, float32 (3, 6), and what it saw of each."""
    task = TaskConfig(
        task="unknot", nx=2, states=states_path, observation=observation, image_size=16
    )
    episodes, policy = EpisodeBatch(task, 3), make_policy(PolicyConfig(policy=str(path)))
    for index in range(3):
        episodes.begin(index, np.random.default_rng(index))
        policy.begin(episodes, index, np.random.default_rng(index))
    return policy.act(episodes, np.arange(3)).actions, [
        episodes.observation(index) for index in range(3)
    ]


def expected(seen: Any) -> NDArray[np.float64]:
    """What the models below do with an observation.

    Of every part a hundredth of its first six numbers and of its mean, added up.
    """
    parts = seen.values() if isinstance(seen, dict) else [seen]
    return np.sum(
        [(part.reshape(-1)[:6] + part.mean(dtype=np.float64)) / 100 for part in parts], axis=0
    )


PIXELS = (16, 32, 3)
SHAPES: dict[str, Any] = {
    "state": {"": (600,)},
    "pixels": {"": PIXELS},
    "both": {"pixels": PIXELS, "state": (None,)},
    "symbolic": {"": (2, 64)},
}


def small(states_path: str, observation: str, **more: Any) -> TaskConfig:
    task: dict[str, Any] = {"task": "unknot", "nx": 2, "states": states_path, "horizon": 2}
    return TaskConfig(**task, observation=observation, image_size=16, **more)


@pytest.mark.parametrize("asked", ["state", "pixels", "both", "symbolic"])
@pytest.mark.parametrize("own", [*SHAPES])
def test_a_model_that_states_its_observations_gets_those(
    own: str, asked: str, states_path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def act(batch: Any) -> Any:
        seen.append(
            {k: v.shape[1:] for k, v in batch.items()} if own == "both" else batch.shape[1:]
        )
        return np.zeros((2, 6))

    if own in ("state", "symbolic"):  # no picture is drawn for a model that sees none
        monkeypatch.setattr(EpisodeBatch, "picture", None)
    rollout(small(states_path, asked), ModelPolicy(Model(act, SHAPES[own]), "m"), [0, 1], 0)
    wanted = {"pixels": PIXELS, "state": (600,)} if own == "both" else SHAPES[own][""]
    assert seen == [wanted] * 2


def test_a_model_of_stacked_pictures_gets_them_stacked(states_path: str) -> None:
    seen = []

    def act(batch: Any) -> Any:
        seen.append(batch.shape)
        return np.zeros((1, 6))

    policy = ModelPolicy(Model(act, {"": (16, 16, 6)}), "m")
    rollout(small(states_path, "pixels"), policy, [0], 0)
    assert seen == [(1, 16, 16, 6)] * 2


def test_a_model_whose_observations_no_task_has_is_refused_with_both_shapes(
    states_path: str,
) -> None:
    policy = ModelPolicy(Model(lambda batch: np.zeros((1, 6)), {"": (64, 128, 3)}), "m")
    with pytest.raises(InvalidPolicy, match=r"shape \(64, 128, 3\), .* pixels \(16, 32, 3\)"):
        rollout(small(states_path, "pixels"), policy, [0], 0)


def test_what_a_model_raises_is_one_line_with_the_shape_it_was_given(states_path: str) -> None:
    def act(batch: Any) -> Any:
        raise RuntimeError("mat1 and mat2\ncan't be multiplied")

    with pytest.raises(InvalidPolicy, match=r"state of shape \(600\).* mat2 can't") as refused:
        rollout(small(states_path, "state"), ModelPolicy(act, "m"), [0], 0)
    assert "\n" not in str(refused.value)


class TestTorchScript:
    pytestmark = needs("torch")

    @pytest.mark.parametrize("observation", OBSERVATIONS)
    def test_does_what_the_model_says(
        self, observation: str, states_path: str, tmp_path: Path
    ) -> None:
        import torch

        class OnePart(torch.nn.Module):
            def forward(self, seen: torch.Tensor) -> torch.Tensor:
                flat = seen.reshape(len(seen), -1).float()
                return (flat[:, :6] + flat.mean(1, keepdim=True)) / 100

        class Parts(torch.nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.part = OnePart()

            def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
                return self.part(seen["pixels"]) + self.part(seen["state"])

        model = Parts() if observation == "both" else OnePart()
        torch.jit.script(model).save(str(tmp_path / "model.pt"))
        actions, seen = chosen(tmp_path / "model.pt", states_path, observation)
        wanted = [expected(observation) for observation in seen]
        assert np.allclose(actions, wanted, atol=1e-6) and np.abs(actions).max() > 0

    def test_runs_on_one_thread(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        import torch

        threads, model = list[int](), torch.nn.Identity()
        model.register_forward_hook(lambda *_: threads.append(torch.get_num_threads()))
        monkeypatch.setattr(torch.jit, "load", lambda *_, **__: model)
        (tmp_path / "model.pt").write_bytes(b"")
        before = torch.get_num_threads()
        torch.set_num_threads(3)
        try:
            load_model(tmp_path / "model.pt")(np.zeros((2, 6), dtype=np.float32))
            assert threads == [1] and torch.get_num_threads() == 3
        finally:
            torch.set_num_threads(before)

    def test_another_observation_is_one_line(self, states_path: str, tmp_path: Path) -> None:
        import torch

        torch.jit.script(torch.nn.Linear(600, 6)).save(str(tmp_path / "model.pt"))
        policy = make_policy(PolicyConfig(policy=str(tmp_path / "model.pt")))
        with pytest.raises(InvalidPolicy, match=r"pixels of shape \(16, 32, 3\)") as refused:
            rollout(small(states_path, "pixels"), policy, [0], 0)
        assert "\n" not in str(refused.value) and len(str(refused.value)) < 400


class TestOnnx:
    pytestmark = needs("onnx", "onnxruntime")

    @pytest.mark.parametrize("observation", OBSERVATIONS)
    def test_does_what_the_model_says(
        self, observation: str, states_path: str, tmp_path: Path
    ) -> None:
        from onnx import TensorProto, helper, numpy_helper, save

        parts = ("pixels", "state") if observation == "both" else (observation,)
        shapes = {
            "pixels": (TensorProto.UINT8, ["n", 16, 32, 3]),
            "state": (TensorProto.FLOAT, ["n", 600]),
        }
        numbers = {"flat": [0, -1], "from": [0], "to": [6], "axis": [1]}
        constants = [
            numpy_helper.from_array(np.array(value, dtype=np.int64), name)
            for name, value in numbers.items()
        ]
        constants.append(numpy_helper.from_array(np.array(100, dtype=np.float32), "hundred"))
        nodes = []
        for part in parts:
            nodes += [
                helper.make_node("Reshape", [part, "flat"], [f"{part} flat"]),
                helper.make_node("Cast", [f"{part} flat"], [f"{part} float"], to=TensorProto.FLOAT),
                helper.make_node("Slice", [f"{part} float", "from", "to", "axis"], [f"{part} six"]),
                helper.make_node(
                    "ReduceMean", [f"{part} float"], [f"{part} mean"], axes=[1], keepdims=1
                ),
                helper.make_node("Add", [f"{part} six", f"{part} mean"], [f"{part} both"]),
                helper.make_node("Div", [f"{part} both", "hundred"], [f"{part} small"]),
            ]
        nodes.append(helper.make_node("Sum", [f"{part} small" for part in parts], ["actions"]))
        inputs = [helper.make_tensor_value_info(part, *shapes[part]) for part in parts]
        outputs = [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", 6])]
        graph = helper.make_graph(nodes, "six", inputs, outputs, constants)
        save(
            helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9),
            str(tmp_path / "model.onnx"),
        )
        actions, seen = chosen(tmp_path / "model.onnx", states_path, observation)
        wanted = [expected(observation) for observation in seen]
        assert np.allclose(actions, wanted, atol=1e-6) and np.abs(actions).max() > 0


class TestStableBaselines3:
    pytestmark = needs("stable_baselines3")

    @pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
    def test_does_what_the_model_says(
        self, algorithm: str, states_path: str, tmp_path: Path
    ) -> None:
        import stable_baselines3

        env = gym.make("knotgym/Unknot-v0", nx=2, states=states_path, observation="state")
        model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, device="cpu", seed=0)
        model.save(tmp_path / "model.zip")
        actions, seen = chosen(Path(f"{tmp_path}/model.zip:{algorithm}"), states_path, "state")
        assert np.allclose(actions, model.predict(np.stack(seen), deterministic=True)[0], atol=1e-6)

    @pytest.mark.parametrize(
        ("observation", "network"),
        [("state", "MlpPolicy"), ("pixels", "CnnPolicy"), ("both", "MultiInputPolicy")],
    )
    def test_a_model_gets_the_observation_it_was_trained_on(
        self, observation: str, network: str, states_path: str, tmp_path: Path
    ) -> None:
        from stable_baselines3 import PPO

        settings: dict[str, Any] = {"nx": 2, "states": states_path, "image_size": 64}
        env = gym.make("knotgym/Unknot-v0", observation=observation, **settings)
        PPO(network, env, device="cpu", n_steps=8, batch_size=8).save(tmp_path / "model.zip")
        policy = make_policy(PolicyConfig(policy=f"{tmp_path}/model.zip"))
        for asked in ("state", "pixels", "both", "symbolic"):
            task = replace(small(states_path, asked), image_size=64)
            assert len(rollout(task, policy, [0], 0)) == 1

    def test_an_algorithm_it_lacks_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "model.zip").write_bytes(b"")
        with pytest.raises(InvalidPolicy, match="no algorithm 'Magic'"):
            make_policy(PolicyConfig(policy=f"{tmp_path}/model.zip:Magic"))


@pytest.mark.parametrize(
    ("name", "library"),
    [("a.zip", "stable_baselines3"), ("a.onnx", "onnxruntime"), ("a.pt", "torch")],
)
def test_a_library_that_is_missing_is_named_in_one_line(
    name: str, library: str, tmp_path: Path
) -> None:
    if importlib.util.find_spec(library) is not None:
        pytest.skip(f"{library} is installed")
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InvalidPolicy, match=f"pip install {library.replace('_', '-')}") as refused:
        make_policy(PolicyConfig(policy=str(tmp_path / name)))
    assert "\n" not in str(refused.value)


@pytest.mark.clients
@pytest.mark.parametrize(
    ("name", "library"),
    [("a.zip", "stable_baselines3"), ("a.onnx", "onnxruntime"), ("a.pt", "torch")],
)
def test_a_file_that_is_no_model_is_refused_in_one_line(
    name: str, library: str, tmp_path: Path
) -> None:
    pytest.importorskip(library)
    (tmp_path / name).write_bytes(b"not a model")
    with pytest.raises(InvalidPolicy, match="holds no .* may run its code") as refused:
        make_policy(PolicyConfig(policy=str(tmp_path / name)))
    assert "\n" not in str(refused.value)
