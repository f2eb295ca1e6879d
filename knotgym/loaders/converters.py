"""Convert datasets for other libraries: torch Dataset, d3rlpy ReplayBuffer, TensorDict."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import KnotgymError, MissingExtra, install_command
from knotgym.loaders.rows import rows
from knotgym.loaders.transitions import Transitions

# d3rlpy has no extra: 2.8.1 pins gymnasium 1.0.0 (which knotgym supports), and an extra would pin
# it for everyone who installs all extras
_INSTALL = {
    "datasets": install_command("huggingface"),
    "torch": install_command("torch"),
    "tensordict": install_command("torchrl"),
    "d3rlpy": "pip install d3rlpy (it pins Gymnasium 1.0.0, which knotgym supports)",
}


class UnknownKind(KnotgymError, ValueError):
    """The loader has no items of this kind."""

    def __init__(self, kind: str, known: Iterable[str]) -> None:
        super().__init__(f"kind must be one of {', '.join(known)}, got {kind!r}")


def torch_dataset(
    dataset: Any,
    kind: str = "transitions",
    *,
    observation: str | None = None,
    picture: Any = None,
    action: str | None = None,
    relabel: str | None = None,
    labels: bool = False,
    cache: Any = None,
) -> Any:
    """Make a `torch.utils.data.Dataset` that reads each item from the file on demand.

    Any number of DataLoader workers can share it.

    Args:
        dataset, observation, picture, action, relabel, labels, cache: see `knotgym.loaders`.
        kind: what an item is:
            "transitions": observation, action, reward, next_observation, terminal, timeout; a list
                of indices, as from a BatchSampler, gives a batch;
            "episodes": observations (T + 1, ...), actions, rewards, terminals, timeouts (T, ...);
                T differs between episodes;
            "frames": observation, gauss_code, crossings, episode, step of one state; the last state
                of an episode is included.

    Returns:
        A Dataset of dicts of tensors: observations uint8 (views * size, 2 size, 3 or 4) as in the
        environment, or float32 (6 beads,), a dict of both, or int16 (2, symbols); rewards float32.
        The gauss_code of a frame is a str.

    Raises:
        MissingExtra: torch isn't installed.
        UnknownKind: kind is none of these.
    """
    import_client("torch")
    from knotgym.loaders.pytorch import KINDS

    if kind not in KINDS:
        raise UnknownKind(kind, KINDS)
    return KINDS[kind](
        Transitions(
            dataset,
            observation=observation,
            picture=picture,
            action=action,
            relabel=relabel,
            labels=labels,
            cache=cache,
        )
    )


def to_d3rlpy(
    dataset: Any,
    *,
    observation: str | None = None,
    picture: Any = None,
    relabel: str | None = None,
    labels: bool = False,
    cache: Any = None,
) -> Any:
    """Make a `d3rlpy.dataset.ReplayBuffer` of all transitions.

    Actions are pulls: d3rlpy has no actions of several whole numbers. Pictures are channels first;
    "both" is a tuple of pixels and state.

    d3rlpy keeps T observations for T actions and drops the last transition of an episode that
    didn't terminate, which here is the one with the reward for failing. To keep that transition,
    such an episode gets its last state as one more step, with zero action and reward.

    Args:
        dataset, observation, picture, relabel, labels, cache: see `knotgym.loaders`.

    Raises:
        MissingExtra: d3rlpy isn't installed.
    """
    d3rlpy = import_client("d3rlpy")
    transitions = Transitions(
        dataset,
        observation=observation,
        picture=picture,
        action="pull",
        relabel=relabel,
        labels=labels,
        cache=cache,
    )
    episodes = []
    for segment in range(transitions.segments):
        part = slice(*transitions.starts[segment : segment + 2])
        actions = transitions.actions[part]
        rewards = transitions.rewards[part, None].astype(np.float32)
        terminated = bool(transitions.terminals[part][-1])
        if not terminated:
            actions = np.concatenate([actions, np.zeros_like(actions[:1])])
            rewards = np.concatenate([rewards, np.zeros_like(rewards[:1])])
        seen = transitions.observations(segment, 0, len(actions))
        observations: Any = (
            tuple(_channels_first(array) for array in seen.values())
            if isinstance(seen, dict)
            else _channels_first(seen)
        )
        episodes.append(d3rlpy.dataset.Episode(observations, actions, rewards, terminated))
    return d3rlpy.dataset.ReplayBuffer(
        d3rlpy.dataset.InfiniteBuffer(),
        episodes=episodes,
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
        action_size=6,
    )


def to_tensordict(
    dataset: Any,
    *,
    observation: str | None = None,
    picture: Any = None,
    action: str | None = None,
    relabel: str | None = None,
    labels: bool = False,
    cache: Any = None,
) -> Any:
    """Make a `tensordict.TensorDict` of all N transitions, to `extend` a TorchRL buffer with.

    Args:
        dataset, observation, picture, action, relabel, labels, cache: see `knotgym.loaders`.

    Returns:
        Batch size [N]. Keys: observation (for "both", pixels and state); action; done, terminated
        and truncated bool (N, 1), all False; episode int64 (N,), the index of the segment, which is
        the `traj_key` for a SliceSampler. Keys under next: observation, reward float32 (N, 1),
        done, terminated, truncated.

    Raises:
        MissingExtra: tensordict or torch isn't installed.
    """
    tensordict = import_client("tensordict")
    transitions = Transitions(
        dataset,
        observation=observation,
        picture=picture,
        action=action,
        relabel=relabel,
        labels=labels,
        cache=cache,
    )
    columns = rows(transitions)
    terminated, truncated = columns["terminals"][:, None], columns["timeouts"][:, None]
    running = np.zeros_like(terminated)

    def seen(observations: Any) -> dict[str, NDArray[Any]]:
        return observations if isinstance(observations, dict) else {"observation": observations}

    return tensordict.TensorDict(
        {
            **seen(columns["observations"]),
            "action": columns["actions"],
            "episode": np.repeat(np.arange(transitions.segments), np.diff(transitions.starts)),
            "done": running,
            "terminated": running.copy(),
            "truncated": running.copy(),
            "next": {
                **seen(columns["next_observations"]),
                "reward": columns["rewards"][:, None].astype(np.float32),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
        },
        batch_size=[len(transitions)],
    )


def _channels_first(observations: NDArray[Any]) -> NDArray[Any]:
    if observations.ndim != 4:
        return observations
    return np.ascontiguousarray(np.moveaxis(observations, -1, 1))


def import_client(module: str) -> Any:
    """Import an optional library; raise MissingExtra with its install command if it is missing.

    A checkout of knotgym has a link `datasets` at its top, which would shadow Hugging Face's
    `datasets` when Python runs from there, so such entries of `sys.path` are skipped.
    """
    searched, link = list(sys.path), ("knotgym", module)
    sys.path[:] = [one for one in searched if (Path(one) / module).resolve().parts[-2:] != link]
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), _INSTALL[module]) from error
    finally:
        sys.path[:] = searched
