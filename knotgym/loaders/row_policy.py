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

from knotgym.common import InvalidPolicy
from knotgym.envs import OBSERVATIONS, TaskConfig
from knotgym.rope import VIEWS, ActionView

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
        return self.actions(np.asarray(observation)[None])[0]

    def _of_block(self, observations: NDArray[Any]) -> NDArray[Any]:
        # copied, because the model may change what it gets and return the same array again
        actions = np.array(self.predict(observations.copy()))
        if actions.shape[:1] != (_BLOCK,):
            gave = f"{_BLOCK} gave {actions.shape}"
            raise InvalidPolicy(f"a model must return a row for each observation: {gave}")
        if not VIEWS[self.action].relative or actions.ndim != 3:
            return actions
        centred = OBSERVATIONS[self.observation].centred
        if centred is None:
            raise InvalidPolicy(f"decisions of each bead need vertices, not {self.observation!r}")
        points = centred(observations)
        wanted = (points.shape[1], 1 + 4 * ActionView.LONGEST)
        if actions.shape[1:] != wanted:
            raise InvalidPolicy(f"decisions of each bead are {wanted}, got {actions.shape[1:]}")
        rows, beads = np.arange(len(actions)), actions[..., 0].argmax(axis=1)
        decided = np.hstack([points[rows, beads] / ActionView.NEAR, actions[rows, beads, 1:]])
        return decided.clip(-1, 1).astype(np.float32)


def as_policy(
    model: Any, action: str = "decision", frame: str = "canonical", observation: str = "marked"
) -> RowPolicy:
    """Make a policy of a model that was learned from `arrays` or another loader.

        act = as_policy(d3rlpy.load_learnable("model.d3").predict)
        network.load_state_dict(torch.load("model.pt", weights_only=True))
        act = as_policy(network)
        act = as_policy(onnxruntime.InferenceSession("model.onnx"))

    In a module, `knotgym evaluate --policy module:act` plays it. In an environment made with the
    same three words, `act(observation)` is the action of one step.

    Args:
        model: a function from observations, an array (n, ...), to actions (n, ...); or a torch
            module, or an ONNX session. Decisions may be rows for each bead, (n, beads, 41): a
            number, the largest of which says which bead is pulled, and the decision's last 40.
        action, frame, observation: as of `arrays`, when the model's data were loaded.

    Raises:
        InvalidInput: there is no such view.
        InvalidPolicy: the model can't be called.
    """
    TaskConfig(task="tie", observation=observation, action=action, frame=frame)  # if there are such
    return RowPolicy(_function_of(model), action, frame, observation)


def _function_of(model: Any) -> Callable[[Any], Any]:
    torch: Any = sys.modules.get("torch")
    if torch is not None and isinstance(model, torch.nn.Module):
        # not at once: what makes the policy may train the network first
        return torch.inference_mode()(lambda seen: model.eval()(torch.from_numpy(seen)).numpy())
    if hasattr(model, "get_inputs") and hasattr(model, "run"):
        name = model.get_inputs()[0].name
        return lambda seen: model.run(None, {name: seen})[0]
    if not callable(model):
        raise InvalidPolicy(
            "a model must be a function of observations, such as model.predict, a torch module or"
            f" an ONNX session; got {type(model).__name__}"
        )
    return model
