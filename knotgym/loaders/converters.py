"""Convert datasets for other libraries: torch Dataset, d3rlpy ReplayBuffer, TensorDict."""

import importlib
import os
import sys
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput, MissingExtra, install_command
from knotgym.loaders.rows import drawn_generator, drawn_goals, rows
from knotgym.loaders.transitions import Opening, Transitions
from knotgym.loaders.windows import Window

# d3rlpy has no extra: 2.8.1 pins gymnasium 1.0.0 (which knotgym supports), and an extra would pin
# it for everyone who installs all extras
_AT_ONCE = 4096  # transitions written to mapped files at once
_INSTALL = {
    "datasets": install_command("huggingface"),
    "torch": install_command("torch"),
    "tensordict": install_command("torchrl"),
    "d3rlpy": "pip install d3rlpy (it pins Gymnasium 1.0.0, which knotgym supports)",
}


def torch_dataset(dataset: Any, kind: str = "transitions", **opening: Unpack[Opening]) -> Any:
    """Make a `torch.utils.data.Dataset` that reads each item from the file on demand.

    Any number of DataLoader workers can share it.

    Args:
        dataset, opening: see `knotgym.loaders`.
        kind: what an item is:
            "transitions": observation, action, reward, next_observation, terminal, timeout, and
                what a window adds: discount, pulls, and the others named as in `arrays`; a list of
                indices, as from a BatchSampler, gives a batch;
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
        InvalidInput: kind is none of these.
        InvalidInput: a window with another kind than "transitions".
    """
    import_client("torch")
    from knotgym.loaders.pytorch import KINDS

    if kind not in KINDS:
        raise InvalidInput(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    if opening.get("window") is not None and kind != "transitions":
        raise InvalidInput(f"a window needs kind 'transitions', got {kind!r}")
    return KINDS[kind](Transitions(dataset, **opening))


def to_d3rlpy(dataset: Any, **opening: Unpack[Opening]) -> Any:
    """Make a `d3rlpy.dataset.ReplayBuffer` of all transitions.

    Actions are pulls: d3rlpy has no actions of several whole numbers. Pictures are channels first;
    "both" is a tuple of pixels and state.

    Stacks follow each other along the first axis of an observation, chunks make one long action,
    and a history is one more array of a tuple; masks are left out, and what they mask is zeros.
    With a window, `sample_transition` gives windows, and `sample_trajectory` shouldn't be used with
    sampled goals.

    d3rlpy keeps T observations for T actions and drops the last transition of an episode that
    didn't terminate, which here is the one with the reward for failing. To keep that transition,
    such an episode gets its last state as one more step, with zero action and reward.

    Args:
        dataset, opening: see `knotgym.loaders`.

    Raises:
        MissingExtra: d3rlpy isn't installed.
        InvalidInput: the window has negatives.
        InvalidInput: the action isn't "pull".
    """
    d3rlpy, window = import_client("d3rlpy"), opening.get("window")
    if window is not None and window.goals is not None and window.goals.negatives:
        raise InvalidInput("d3rlpy's transitions have no place for negatives: leave them out")
    if (action := opening.get("action")) not in (None, "pull"):
        raise InvalidInput(
            f"d3rlpy has no actions of several whole numbers: use action 'pull', got {action!r}"
        )
    opening["action"] = "pull"
    transitions = Transitions(dataset, **opening)
    picker = None if window is None else _WindowPicker(d3rlpy, transitions, window)
    episodes = []
    for segment in range(transitions.segments):
        part = slice(*transitions.starts[segment : segment + 2])
        actions = transitions.actions[part] if picker is None else picker.actions[part]
        rewards = transitions.rewards[part, None].astype(np.float32)
        terminated = bool(transitions.terminals[part][-1])
        if not terminated:
            actions = np.concatenate([actions, np.zeros_like(actions[:1])])
            rewards = np.concatenate([rewards, np.zeros_like(rewards[:1])])
        if picker is None:
            seen = _parts(transitions.observations(segment, 0, len(actions)))
        else:
            last = slice(part.stop - 1, part.stop if len(actions) > part.stop - part.start else 0)
            pairs = zip(picker.before, picker.after, strict=True)
            seen = [np.concatenate([one[part], other[last]]) for one, other in pairs]
        episodes.append(d3rlpy.dataset.Episode(_joined(seen), actions, rewards, terminated))
        vars(episodes[-1])["first_row"] = part.start
    return d3rlpy.dataset.ReplayBuffer(
        d3rlpy.dataset.InfiniteBuffer(),
        transition_picker=picker,
        episodes=episodes,
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
        action_size=6 * ((window and window.chunk) or 1),
    )


class _WindowPicker:
    """Pick windows as d3rlpy's transitions; `first_row` of an episode is its first."""

    def __init__(self, d3rlpy: Any, transitions: Transitions, window: Window) -> None:
        self._transition, self._transitions = d3rlpy.dataset.Transition, transitions
        self._goals, self._columns = drawn_goals(transitions), rows(transitions)
        columns, stacked = self._columns, window.stack is not None
        self.before, self.after = (
            _parts(
                columns.pop(f"{side}observations"),
                stacked=stacked,
                history=columns.pop(f"{side}history", None),
            )
            for side in ("", "next_")
        )
        self.actions = columns["actions"].reshape(len(transitions), -1)

    def __call__(self, episode: Any, index: int) -> Any:
        row, columns, actions = episode.first_row + index, self._columns, self.actions
        end = episode.first_row + episode.transition_count
        steps = int(columns["pulls"][row])  # every transition is one pull
        rows = np.array([row])
        goals = None if self._goals is None else self._goals[rows]
        rewards, terminals, _, _, _ = self._transitions.outcomes(rows, end - row, goals)
        left = int(terminals[0].argmax()) + 1 if terminals.any() else end - row
        return self._transition(
            observation=_joined([array[row] for array in self.before]),
            action=actions[row],
            reward=columns["rewards"][rows].astype(np.float32),
            next_observation=_joined([array[row] for array in self.after]),
            next_action=actions[row + steps] if row + steps < end else np.zeros_like(actions[row]),
            terminal=float(columns["terminals"][row]),
            interval=steps,
            rewards_to_go=rewards[0, :left, None].astype(np.float32),
        )


def to_tensordict(
    dataset: Any, *, folder: str | os.PathLike[str] | None = None, **opening: Unpack[Opening]
) -> Any:
    """Make a `tensordict.TensorDict` of all N transitions, to `extend` a TorchRL buffer with.

    Args:
        dataset, opening: see `knotgym.loaders`.
        folder: where to keep the tensors in memory-mapped files, for datasets that are larger than
            the memory; None to hold them in memory.

    Returns:
        Batch size [N]. Keys: observation (for "both", pixels and state); action; done, terminated
        and truncated bool (N, 1), all False; episode int64 (N,), the index of the segment, which is
        the `traj_key` for a SliceSampler. Keys under next: observation, reward float32 (N, 1),
        done, terminated, truncated. A window adds steps_to_next_obs int64 (N, 1), the pulls between
        the observations, by which TorchRL's value estimators discount; discount float32 (N, 1)
        under next; and action_mask, history, history_mask and negatives as in `arrays`, the
        histories of the next observations under next.

    Raises:
        MissingExtra: tensordict or torch isn't installed.
    """
    tensordict = import_client("tensordict")
    transitions = Transitions(dataset, **opening)
    if folder is None:
        return _tensors(tensordict, transitions, rows(transitions), slice(None))
    goals, count = drawn_generator(transitions), len(transitions)
    mapped = None
    for first in range(0, count, _AT_ONCE):
        some = slice(first, min(first + _AT_ONCE, count))
        columns = transitions.gather(np.arange(some.start, some.stop), rng=goals)
        block = _tensors(tensordict, transitions, columns, some)
        if mapped is None:
            mapped = block[:1].expand(count).memmap_like(folder)
        mapped[some] = block
    return mapped


def _tensors(
    tensordict: Any, transitions: Transitions, columns: dict[str, Any], some: slice
) -> Any:
    """Return a TensorDict of the columns of some transitions."""
    terminated, truncated = columns["terminals"][:, None], columns["timeouts"][:, None]
    running = np.zeros_like(terminated)
    added, after = {}, {}
    if transitions.window is not None:
        added["steps_to_next_obs"] = columns["pulls"][:, None]
        after["discount"] = columns["discounts"][:, None].astype(np.float32)
        for name in ("action_mask", "history", "history_mask", "negatives"):
            if name in columns:
                added[name] = columns[name]
            if f"next_{name}" in columns:
                after[name] = columns[f"next_{name}"]

    def seen(observations: Any) -> dict[str, NDArray[Any]]:
        return observations if isinstance(observations, dict) else {"observation": observations}

    episode = np.repeat(np.arange(transitions.segments), np.diff(transitions.starts))
    return tensordict.TensorDict(
        {
            **seen(columns["observations"]),
            "action": columns["actions"],
            "episode": episode[some],
            **added,
            "done": running,
            "terminated": running.copy(),
            "truncated": running.copy(),
            "next": {
                **after,
                **seen(columns["next_observations"]),
                "reward": columns["rewards"][:, None].astype(np.float32),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
        },
        batch_size=[len(terminated)],
    )


def _parts(
    observations: Any, *, stacked: bool = False, history: NDArray[Any] | None = None
) -> list[NDArray[Any]]:
    """Return n observations as d3rlpy takes them: pictures channels first, no axis of stacks."""
    parts = list(observations.values()) if isinstance(observations, dict) else [observations]
    for index, array in enumerate(parts):
        if array.dtype == np.uint8:
            array = np.moveaxis(array, -1, -3)
        if stacked:
            array = array.reshape(len(array), -1, *array.shape[3:])
        parts[index] = np.ascontiguousarray(array)
    return parts if history is None else [*parts, history.reshape(len(history), -1)]


def _joined(parts: list[NDArray[Any]]) -> Any:
    return parts[0] if len(parts) == 1 else tuple(parts)


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
