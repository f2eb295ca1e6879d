"""Policies from model files: Stable-Baselines3, ONNX or TorchScript.

Each format needs its own library, which is imported when such a file is loaded.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidPolicy, one_line
from knotgym.control.policy import Choice, UnplannedPolicy, checked
from knotgym.envs.environment import observation_space
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import LAYOUTS, OBSERVATIONS, TaskConfig

Shapes = Mapping[str, tuple[int | None, ...]]


@dataclass(frozen=True)
class Model:
    """A function from a batch of observations to a batch of actions.

    Attributes:
        function: takes an array (n, ...), or a dict of such arrays.
        takes: shape of each part of an observation by its name, or by "" if the observation is a
            single array; sizes that aren't fixed are None. None as a whole if the model doesn't
            state its observation space.
    """

    function: Callable[[Any], Any]
    takes: Shapes | None = None

    def __call__(self, batch: Any) -> Any:
        return self.function(batch)


class ModelPolicy(UnplannedPolicy):
    """Acts as a model says.

    A `Model` that states its observation space gets that observation, whichever one the task asks
    for.
    """

    def __init__(self, model: Callable[[Any], Any], name: str) -> None:
        super().__init__(name)
        self._model, self._takes = model, model.takes if isinstance(model, Model) else None

    def suited(self, task: TaskConfig) -> TaskConfig:
        if self._takes is None:
            return task
        # the task's own observation and layout are tried first
        choices = dict.fromkeys((task.observation, *OBSERVATIONS))
        layouts = dict.fromkeys((task.layout, *LAYOUTS))
        for observation in choices:
            for layout in layouts:
                seen = replace(task, observation=observation, layout=layout)
                if _fits(_shapes(observation_space(seen)), self._takes):
                    return seen
        offered = ", ".join(
            f"{choice} {_as_text(_shapes(observation_space(replace(task, observation=choice))))}"
            for choice in choices
        )
        raise InvalidPolicy(
            f"policy {self._name} takes observations of shape {_as_text(self._takes)}, but this"
            f" task offers {offered}"
        )

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        try:
            actions = list(np.asarray(self._model(episodes.observations(ids))))
        except Exception as error:  # every library raises its own type for an unfit input
            task = episodes.config
            shapes = _as_text(_shapes(observation_space(task)))
            raise InvalidPolicy(
                f"policy {self._name} can't act on observation {task.observation} of shape"
                f" {shapes}; try another --observation: {one_line(error)[-200:]}"
            ) from error
        return checked(actions, episodes, ids, self._name)


def _shapes(space: Any) -> Shapes:
    """The shapes of a Gymnasium space, in the form of `Model.takes`."""
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


def _as_text(shapes: Shapes) -> str:
    """Format shapes for an error message.

    >>> _as_text({"": (600,)}), _as_text({"pixels": (None, 8, 3), "state": (600,)})
    ('(600)', 'pixels (any, 8, 3) and state (600)')
    """
    return " and ".join(
        f"{name} ({', '.join('any' if size is None else str(size) for size in shape)})".strip()
        for name, shape in shapes.items()
    )


def load_model(path: Path, algorithm: str = "") -> Model:
    """Load a model from a file.

    Args:
        path: .zip, .onnx (one input, or inputs named like the parts of the observation) or .pt. The
            model takes a batch of the environment's observations and returns actions of its view,
            such as (n, 6).
        algorithm: class name of the Stable-Baselines3 algorithm; PPO if empty.

    Raises:
        InvalidPolicy: the file doesn't exist, holds no such model, or needs a library that isn't
            installed.
    """
    if not path.is_file():
        raise InvalidPolicy(f"no policy file at {path}")
    try:
        return MODEL_FILES[path.suffix](path, algorithm)
    except InvalidPolicy:
        raise
    except Exception as error:  # every library raises its own type for a file it can't read
        raise InvalidPolicy(
            f"{path} holds no {path.suffix} model that can be read: {one_line(error)[:200]};"
            " loading a model may run its code, so load only files that you trust"
        ) from error


@contextmanager
def inference(torch: Any) -> Iterator[None]:
    """Run networks of the module `torch` without gradients and on one thread.

    With more threads, the order of sums, and so their rounding, depends on the machine, and the
    threads of several worker processes wait for each other, which is many times slower.
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
    # Stable-Baselines3 states images channels first, but takes ours and transposes them itself
    transposed = {
        name: (*shape[1:], shape[0]) if len(shape) == 3 and (shape[0] or 0) < 16 else shape
        for name, shape in takes.items()
    }
    return Model(act, transposed)


def _onnx(path: Path, algorithm: str) -> Model:
    runtime = _library("onnxruntime", path)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1  # for the reasons given in `inference`
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


# suffix -> loader, which gets the path and a Stable-Baselines3 algorithm's name or ""
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
