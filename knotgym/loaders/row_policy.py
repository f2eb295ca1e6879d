"""Models as policies: a function from rows of observations to rows of actions acts in episodes.

The views are those that the model's data were loaded with. `arrays(..., action=..., frame=...)`
turns pulls into such actions, and `control` turns the actions into pulls again.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, InvalidPolicy
from knotgym.envs import ACTIONS, OBSERVATIONS, require_frame, split
from knotgym.rope import NEAR

# Rows that a model is given at a time: a network's sums depend on their number, and an episode must
# not depend on those beside it.
_BLOCK = 32


@dataclass(frozen=True)
class RowPolicy:
    """A model and the views that it was learned in, see `as_policy`."""

    predict: Callable[[Any], Any]
    action: str
    frame: str
    observation: str

    def actions(self, observations: Any) -> NDArray[Any]:
        """Return the actions (n, ...) for observations (n, ...)."""
        count = len(observations)
        padded = np.resize(observations, (-(-count // _BLOCK) * _BLOCK, *observations.shape[1:]))
        blocks = [self._of_block(block) for block in np.split(padded, len(padded) // _BLOCK)]
        return np.concatenate(blocks)[:count]

    def __call__(self, observation: Any) -> NDArray[Any]:
        """Return the action for one observation, such as one of `env.step`."""
        found: NDArray[Any] = self.actions(np.asarray(observation)[None])[0]
        return found

    def _of_block(self, observations: NDArray[Any]) -> NDArray[Any]:
        found = self.predict(observations.copy())
        # copied, because the model may return the same array again
        if not isinstance(found, tuple):
            return np.array(found)
        beads, rest = (np.array(part) for part in found)
        beads = beads.argmax(axis=1) if beads.ndim == 2 else beads.astype(np.int64)
        if self.observation == "marked":
            points = split(observations).points
        else:
            points = observations.reshape(len(observations), 2, -1, 3)[:, 0]
            points = points - points.mean(axis=1, keepdims=True)
        places = points[np.arange(len(beads)), beads] / NEAR
        return np.concatenate([places, rest], axis=1).clip(-1, 1).astype(np.float32)


def as_policy(
    model: Any,
    action: str = "decision",
    frame: str = "canonical",
    observation: str = "marked",
) -> RowPolicy:
    """Make a policy of a model that was learned from `arrays` or another loader.

        act = as_policy(d3rlpy.load_learnable("model.d3").predict)
        act = as_policy(torch.jit.load("model.pt"))
        act = as_policy(onnxruntime.InferenceSession("model.onnx"))

    In a module, `knotgym evaluate --policy module:act` plays it. In an environment made with the
    same three words, `act(observation)` is the action of one step.

    Args:
        model: a function from observations, an array (n, ...), to actions (n, ...); or a torch
            module, or an ONNX session. For decisions it may return a pair instead: the bead, int
            (n,) or logits (n, beads), and the other 40 numbers of the decision.
        action, frame, observation: as of `arrays`, when the model's data were loaded.

    Raises:
        InvalidInput: there is no such view.
        InvalidPolicy: the model can't be called.
    """
    for name, given, known in (
        ("action", action, ACTIONS),
        ("observation", observation, OBSERVATIONS),
    ):
        if given not in known:
            raise InvalidInput(f"no {name} {given!r}; there is {', '.join(known)}")
    require_frame(frame, observation, action)
    return RowPolicy(_function_of(model), action, frame, observation)


def _function_of(model: Any) -> Callable[[Any], Any]:
    torch: Any = sys.modules.get("torch")
    if torch is not None and isinstance(model, torch.nn.Module):
        network = model.eval()

        def of_arrays(observations: NDArray[Any]) -> Any:
            with torch.inference_mode():
                found = network(torch.from_numpy(observations))
            return tuple(map(np.asarray, found)) if isinstance(found, tuple) else np.asarray(found)

        return of_arrays
    if hasattr(model, "get_inputs") and hasattr(model, "run"):
        name = model.get_inputs()[0].name

        def of_session(observations: NDArray[Any]) -> Any:
            found = model.run(None, {name: observations})
            return found[0] if len(found) == 1 else tuple(found)

        return of_session
    if not callable(model):
        raise InvalidPolicy(
            "a model must be a function of observations, such as model.predict, a torch module or"
            f" an ONNX session; got {type(model).__name__}"
        )
    function: Callable[[Any], Any] = model
    return function
