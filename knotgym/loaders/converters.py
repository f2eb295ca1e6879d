"""Datasets for the learners' own libraries: torch's Dataset, d3rlpy's buffer, a TensorDict."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.errors import KnotgymError, MissingExtra, install_command
from knotgym.loaders.rows import rows
from knotgym.loaders.transitions import Transitions

# d3rlpy 2.8.1 pins gymnasium 1.0.0, which all of this runs with; an extra would pin it for everyone
# who asks for all extras
_HOW = {
    "torch": install_command("torch"),
    "tensordict": install_command("torchrl"),
    "d3rlpy": "pip install d3rlpy (it pins Gymnasium 1.0.0, with which all of this works)",
}


class UnknownKind(KnotgymError, ValueError):
    """A loader gives nothing of this kind."""

    def __init__(self, kind: str, known: Iterable[str]) -> None:
        super().__init__(f"kind must be one of {', '.join(known)}, got {kind!r}")


def torch_dataset(
    dataset: Any,
    kind: str = "transitions",
    *,
    observation: str | None = None,
    picture: Any = None,
    relabel: str | None = None,
    labels: bool = False,
    cache: Any = None,
) -> Any:
    """Make a `torch.utils.data.Dataset` that reads from the file when asked.

    Any number of DataLoader workers may share it.

    Args:
        dataset, observation, picture, relabel, labels, cache: see `knotgym.loaders`.
        kind: what an item is:
            "transitions": observation, action, reward, next_observation, terminal, timeout; asked
                for a list of numbers, as a BatchSampler does, a batch of them;
            "episodes": observations (T + 1, ...), actions, rewards, terminals, timeouts (T, ...),
                of unequal T;
            "frames": observation, gauss_code, crossings, episode, step: a state, the last of an
                episode too.

    Returns:
        A Dataset of dicts of tensors: observations uint8 (views * size, 2 size, 3 or 4) as the
        environment's, or float32 (6 beads,), a dict of both, or int16 (2, symbols); rewards
        float32; frames' gauss_code a str.

    Raises:
        MissingExtra: torch isn't installed.
        UnknownKind: there is no such kind.
    """
    _needed("torch")
    from knotgym.loaders.pytorch import KINDS

    if kind not in KINDS:
        raise UnknownKind(kind, KINDS)
    return KINDS[kind](
        Transitions(
            dataset,
            observation=observation,
            picture=picture,
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
    """Make a `d3rlpy.dataset.ReplayBuffer` that holds every transition.

    Pictures are channels first, "both" is a tuple of pixels and state.

    d3rlpy keeps T observations for T actions and drops the last transition of an episode that
    didn't terminate, here the one that pays for failing. So such an episode has its last state as
    one more step, of a zero action and reward: no transition starts there, one ends there.

    Args:
        dataset, observation, picture, relabel, labels, cache: see `knotgym.loaders`.

    Raises:
        MissingExtra: d3rlpy isn't installed.
    """
    d3rlpy = _needed("d3rlpy")
    transitions = Transitions(
        dataset,
        observation=observation,
        picture=picture,
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
    relabel: str | None = None,
    labels: bool = False,
    cache: Any = None,
) -> Any:
    """Make a `tensordict.TensorDict` of N transitions, ready for a TorchRL buffer's `extend`.

    Args:
        dataset, observation, picture, relabel, labels, cache: see `knotgym.loaders`.

    Returns:
        batch size [N]: observation (or pixels and state, for "both"), action, done, terminated,
        truncated (N, 1), all False; episode int64 (N,), the number of the segment, a SliceSampler's
        `traj_key`; and under next: observation, reward float32 (N, 1), done, terminated, truncated.

    Raises:
        MissingExtra: tensordict or torch isn't installed.
    """
    tensordict = _needed("tensordict")
    transitions = Transitions(
        dataset,
        observation=observation,
        picture=picture,
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


def _needed(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), _HOW[module]) from error
