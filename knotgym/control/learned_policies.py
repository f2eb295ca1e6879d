"""Learned policies from files: Stable-Baselines3, ONNX, TorchScript. Each needs its own library,
imported only here and only then.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.control.policies import InvalidPolicy


def load_model(path: Path, word: str = "") -> Callable[[Any], Any]:
    """A function from a batch of observations, as the environment's with one more axis in front, to
    actions (n, 6).

    Args:
        path: .zip, .onnx (inputs named as the observation's parts, or one input) or .pt.
        word: the Stable-Baselines3 algorithm, "PPO" for "".

    Raises:
        InvalidPolicy: there is no such file, it holds no such model, or its library isn't
            installed.
    """
    if not path.is_file():
        raise InvalidPolicy(f"no policy file at {path}")
    try:
        return {".zip": _sb3, ".onnx": _onnx, ".pt": _torchscript}[path.suffix](path, word)
    except InvalidPolicy:
        raise
    except Exception as error:  # each library has its own for a file it can't read
        raise InvalidPolicy(
            f"{path} holds no {path.suffix} model that can be read:"
            f" {' '.join(str(error).split())[:200]}"
        ) from error


def _sb3(path: Path, word: str) -> Callable[[Any], Any]:
    algorithms = _library("stable_baselines3", path)
    name = word or "PPO"
    if not hasattr(algorithms, name):
        raise InvalidPolicy(
            f"Stable-Baselines3 has no algorithm {name!r}; name it after the file, as in {path}:SAC"
        )
    model = getattr(algorithms, name).load(path, device="cpu")
    return lambda batch: model.predict(batch, deterministic=True)[0]


def _onnx(path: Path, word: str) -> Callable[[Any], Any]:
    session = _library("onnxruntime", path).InferenceSession(
        str(path), providers=["CPUExecutionProvider"]
    )
    names = [one.name for one in session.get_inputs()]
    return lambda batch: session.run(None, batch if isinstance(batch, dict) else {names[0]: batch})[
        0
    ]


def _torchscript(path: Path, word: str) -> Callable[[Any], Any]:
    torch = _library("torch", path)
    model = torch.jit.load(str(path), map_location="cpu").eval()

    def act(batch: Any) -> Any:
        with torch.no_grad():
            given = (
                {name: torch.from_numpy(part) for name, part in batch.items()}
                if isinstance(batch, dict)
                else torch.from_numpy(batch)
            )
            return np.asarray(model(given))

    return act


def _library(name: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InvalidPolicy(
            f"{path} needs {name.replace('_', '-')}, which isn't installed: pip install"
            f" {name.replace('_', '-')}"
        ) from error
