"""Policies from files: models that map observations to actions.

They come from Stable-Baselines3, ONNX or TorchScript; each needs its own library, imported only
here and only then.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import one_line
from knotgym.control.policy import Choice, InvalidPolicy, UnplannedPolicy, checked
from knotgym.envs.environment import observation_space
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import LAYOUTS, OBSERVATIONS, TaskConfig

Shapes = Mapping[str, tuple[int | None, ...]]


@dataclass(frozen=True)
class Model:
    """A function from a batch of observations to a batch of actions.

    Attributes:
        function: takes an array (n, ...), or a dict of them.
        takes: shape of each part of one observation, or of "" if it has no parts, with None for a
            size that isn't fixed; None where the model doesn't state its observation space.
    """

    function: Callable[[Any], Any]
    takes: Shapes | None = None

    def __call__(self, batch: Any) -> Any:
        return self.function(batch)


class ModelPolicy(UnplannedPolicy):
    """A model that maps a batch of observations to a batch of actions.

    A `Model` that states its observation space gets that observation, whatever the task's is.
    """

    def __init__(self, model: Callable[[Any], Any], name: str) -> None:
        super().__init__(name)
        self._model, self._takes = model, model.takes if isinstance(model, Model) else None

    def suited(self, task: TaskConfig) -> TaskConfig:
        if self._takes is None:
            return task
        choices = dict.fromkeys((task.observation, *OBSERVATIONS))
        layouts = dict.fromkeys((task.layout, *LAYOUTS))
        for observation in choices:
            for layout in layouts:
                seen = replace(task, observation=observation, layout=layout)
                if _fits(_shapes(observation_space(seen)), self._takes):
                    return seen
        offered = ", ".join(
            f"{choice} {_told(_shapes(observation_space(replace(task, observation=choice))))}"
            for choice in choices
        )
        raise InvalidPolicy(
            f"policy {self._name} takes observations of shape {_told(self._takes)}, which this task"
            f" doesn't have: {offered}"
        )

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        seen = [episodes.observation(index) for index in ids.tolist()]
        batch: Any
        if isinstance(seen[0], dict):
            batch = {
                part: np.stack([observation[part] for observation in seen]) for part in seen[0]
            }
        else:
            batch = np.stack(seen)
        try:
            actions = list(np.asarray(self._model(batch)))
        except Exception as error:  # each library has its own for an input that doesn't fit
            task = episodes.config
            shapes = _told(_shapes(observation_space(task)))
            raise InvalidPolicy(
                f"policy {self._name} can't act on observations {task.observation} of shape"
                f" {shapes}, so try another --observation:"
                f" {one_line(error)[-200:]}"
            ) from error
        return checked(actions, episodes, ids, self._name)


def _shapes(space: Any) -> Shapes:
    """The shapes of a Gymnasium space, as `Model.takes`."""
    parts = getattr(space, "spaces", None)
    if isinstance(parts, Mapping):
        return {str(name): tuple(part.shape or ()) for name, part in parts.items()}
    return {"": tuple(space.shape or ())}


def _fits(given: Shapes, taken: Shapes) -> bool:
    return given.keys() == taken.keys() and all(
        len(given[name]) == len(taken[name])
        and all(size in (one, None) for one, size in zip(given[name], taken[name], strict=True))
        for name in given
    )


def _told(shapes: Shapes) -> str:
    """Shapes as an error names them.

    >>> _told({"": (600,)}), _told({"pixels": (None, 8, 3), "state": (600,)})
    ('(600)', 'pixels (any, 8, 3) and state (600)')
    """
    return " and ".join(
        f"{name} ({', '.join('any' if size is None else str(size) for size in shape)})".strip()
        for name, shape in shapes.items()
    )


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

    takes = _shapes(model.observation_space)
    # it keeps pictures with their channels first, and turns those it is given
    turned = {
        name: (*shape[1:], shape[0]) if len(shape) == 3 and (shape[0] or 0) < 16 else shape
        for name, shape in takes.items()
    }
    return Model(act, turned)


def _onnx(path: Path, algorithm: str) -> Model:
    runtime = _library("onnxruntime", path)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1  # as `inference`
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    inputs = session.get_inputs()
    takes = {
        one.name if len(inputs) > 1 else "": tuple(
            size if isinstance(size, int) else None for size in one.shape[1:]
        )
        for one in inputs
    }

    def act(batch: Any) -> Any:
        return session.run(None, batch if isinstance(batch, dict) else {inputs[0].name: batch})[0]

    return Model(act, takes)


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

    return Model(act)


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
