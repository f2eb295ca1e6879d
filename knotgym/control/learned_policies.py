"""Policies from files: models that map observations to actions.

They come from Stable-Baselines3, ONNX or TorchScript; each needs its own library, imported only
here and only then.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.control.policy import Choice, InvalidPolicy, Policy, UnplannedPolicy, checked
from knotgym.episode_batch import EpisodeBatch
from knotgym.errors import install_command, one_line

Model = Callable[[Any], Any]


class ModelPolicy(UnplannedPolicy):
    """A model that maps a batch of observations to a batch of actions."""

    def __init__(self, model: Model, name: str) -> None:
        super().__init__(name)
        self._model = model

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        seen = [episodes.observation(index) for index in ids.tolist()]
        batch: Any
        if isinstance(seen[0], dict):
            batch = {
                part: np.stack([observation[part] for observation in seen]) for part in seen[0]
            }
        else:
            batch = np.stack(seen)
        return checked(list(np.asarray(self._model(batch))), episodes, ids, self._name)


def load_model(path: Path, algorithm: str = "") -> Model:
    """A function from a batch of observations to actions (n, 6).

    Args:
        path: .zip, .onnx (inputs named as the observation's parts, or one input) or .pt; the model
            takes the environment's observations with one more axis in front.
        algorithm: of Stable-Baselines3, "PPO" for "".

    Raises:
        InvalidPolicy: there is no such file, it holds no such model, or its library isn't
            installed.
    """
    if not path.is_file():
        raise InvalidPolicy(f"no policy file at {path}")
    try:
        return MODEL_FILES[path.suffix](path, algorithm)
    except InvalidPolicy:
        raise
    except Exception as error:  # each library has its own for a file it can't read
        raise InvalidPolicy(
            f"{path} holds no {path.suffix} model that can be read:"
            f" {one_line(error)[:200]}; reading one may run its code, so take only those you trust,"
            " or a learner's folder, which holds safetensors"
        ) from error


@contextmanager
def inference(torch: Any) -> Iterator[None]:
    """Ask a network of the module `torch`: without gradients, and on one thread.

    With more, sums are of another order on another machine, and the threads of worker processes
    wait for each other, which makes them many times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)


def is_learner(place: str) -> bool:
    """Whether a policy's name is that of a learner's folder, or of the one that ships."""
    return place == "pretrained" or (place != "" and Path(place).is_dir())


def load_learner(place: str) -> Policy:
    """The policy of a learner that `knotgym train` wrote, or of the one that ships.

    Raises:
        InvalidPolicy: torch or safetensors isn't installed.
        InvalidCheckpoint: the folder holds no learner that this version can read.
    """
    for library in ("torch", "safetensors"):
        if importlib.util.find_spec(library) is None:
            raise InvalidPolicy(
                f"the learner {place} needs {library}, which isn't installed; install it:"
                f" {install_command('learn')}"
            )
    policy: Policy = importlib.import_module("knotgym.learn.picture_policy").learned_policy(place)
    return policy


def learner_card(place: str) -> dict[str, Any]:
    """What the folder of a learner, or of the one that ships, says of its training, see the file
    `policy.json`.

    Raises:
        InvalidCheckpoint: the folder holds no learner that this version can read.
    """
    checkpoint = importlib.import_module("knotgym.learn.checkpoint")
    card: dict[str, Any] = checkpoint.read_card(checkpoint.policy_folder(place))
    return card


def _stable_baselines3(path: Path, algorithm: str) -> Model:
    algorithms = _library("stable_baselines3", path)
    name = algorithm or "PPO"
    if not hasattr(algorithms, name):
        raise InvalidPolicy(
            f"Stable-Baselines3 has no algorithm {name!r}; name it after the file, as in {path}:SAC"
        )
    model = getattr(algorithms, name).load(path, device="cpu")
    torch = _library("torch", path)

    def act(batch: Any) -> Any:
        with inference(torch):
            return model.predict(batch, deterministic=True)[0]

    return act


def _onnx(path: Path, algorithm: str) -> Model:
    runtime = _library("onnxruntime", path)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1  # as `inference`
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    first = session.get_inputs()[0].name

    def act(batch: Any) -> Any:
        return session.run(None, batch if isinstance(batch, dict) else {first: batch})[0]

    return act


def _torchscript(path: Path, algorithm: str) -> Model:
    torch = _library("torch", path)
    model = torch.jit.load(str(path), map_location="cpu").eval()

    def act(batch: Any) -> Any:
        with inference(torch):
            if isinstance(batch, dict):
                return np.asarray(
                    model({part: torch.from_numpy(values) for part, values in batch.items()})
                )
            return np.asarray(model(torch.from_numpy(batch)))

    return act


# suffix -> what reads such a file, given a Stable-Baselines3 algorithm's name or ""
MODEL_FILES: dict[str, Callable[[Path, str], Model]] = {
    ".zip": _stable_baselines3,
    ".onnx": _onnx,
    ".pt": _torchscript,
}


def _library(name: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.replace("_", "-")
        raise InvalidPolicy(
            f"{path} needs {package}, which isn't installed: pip install {package}"
        ) from error
