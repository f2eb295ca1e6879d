"""Whole datasets as arrays, and for other libraries: torch Dataset, d3rlpy buffer, TensorDict.

Arrays have one row per transition and the keys of D4RL and OGBench.
"""

import os
import sys
from glob import escape
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from knotgym.common import (
    InvalidInput,
    MissingExtra,
    Occupied,
    Stream,
    atomic_write,
    require_output,
)
from knotgym.datasets import Statistics
from knotgym.loaders.data_stream import DataStream, Pictured, Played
from knotgym.loaders.transitions import Opening, Transitions

_AT_ONCE = 4096  # transitions read at once
# d3rlpy has no extra: 2.8.1 pins gymnasium 1.0.0, and an extra would pin it for all extras
_D3RLPY = "pip install d3rlpy (it pins Gymnasium 1.0.0, which knotgym supports)"


def arrays(dataset: Any, **opening: Unpack[Opening]) -> dict[str, Any]:
    """Load all N transitions of a dataset, in the order of its episodes.

    Args:
        dataset, opening: see `knotgym.loaders`.

    Returns:
        observations, next_observations: uint8 (N, views * size, 2 size, 3 or 4), float32
            (N, 6 beads), dicts of both, or int16 (N, 2, symbols). Each picture is held twice,
            which takes 200 kB per transition at size 128 with one view and no depth. With
            `stack`, an axis of that length follows N.
        actions: float32 (N, 6), or (N, 43) in the view "decision"; int64 (N, 4) in "bead" and
            (N, 3) in "macro". With `chunk`, an axis of that length follows N, and action_mask, bool
            (N, chunk), says which actions the episode has; the others are zeros.
        beads, whole: in the view "decision" only: int64 (N,), the bead that is pulled, numbered as
            in the frame; and bool (N,), False where a pull of another kind cut the decision short.
        rewards: float64 (N,).
        pulls: int64 (N,), of macro-actions and decisions, and with a window: pulls from one
            observation to the next, to discount by.
        terminals, timeouts: bool (N,); exactly one of them is true in the last row of an episode.
        discounts: float64 (N,), with a window only: what to multiply the value of the next
            observation with.
        history, next_history: actions (N, history, 6), with `history` only: those that led to the
            observation and to the next one, the latest last. history_mask and next_history_mask,
            bool (N, history), say which actions the episode has; the others are zeros.
        negatives: (N, negatives, ...), with `negatives` only: the halves of observations that show
            a goal.
    """
    return _rows(Transitions(dataset, **opening))


def _rows(transitions: Transitions) -> dict[str, Any]:
    """Load opened transitions; return what `arrays` does."""
    loaded = transitions.batch(np.arange(len(transitions)), rng=_drawn_generator(transitions))
    if transitions.leads:
        loaded.setdefault("pulls", transitions.pulls)
    return loaded


def _drawn_generator(transitions: Transitions) -> np.random.Generator | None:
    """Return the generator that the goals of all transitions are drawn from; None for none."""
    goals = transitions.window.goals if transitions.window else None
    return None if goals is None else Stream.SAMPLED_GOALS.generator(goals.seed)


def statistics(dataset: Any, **opening: Unpack[Opening]) -> dict[str, dict[str, NDArray[Any]]]:
    """Return what to normalize observations and actions by; give it the train split alone.

    Minari's metadata hold the same of what Minari loads, unless that is pictures.

    Args:
        dataset, opening: see `knotgym.loaders`; observations are no pictures.

    Returns:
        "observations" and "actions" -> "mean", "std", "min" and "max" of each of their numbers,
        float32 (...). A number that never changes has std 1, so that one can divide by it.

    Raises:
        InvalidInput: there are pictures, or no transitions.
    """
    transitions = Transitions(dataset, **opening)
    if not len(transitions):
        raise InvalidInput(f"{transitions.dataset.path} has no transitions to take statistics of")
    totals = Statistics()
    for _, block in transitions.blocks(_AT_ONCE, _drawn_generator(transitions)):
        arrays = {name: block[name] for name in ("observations", "actions")}
        if any(isinstance(array, dict) or array.dtype == np.uint8 for array in arrays.values()):
            raise InvalidInput("pictures need no statistics: divide them by 255")
        totals.add(arrays)
    return totals.found()


def torch_dataset(dataset: Any, **opening: Unpack[Opening]) -> Any:
    """Make a `torch.utils.data.Dataset` that reads each transition from the file on demand.

    Any number of DataLoader workers can share it. For stretches of whole episodes see `Sequences`.

    Args:
        dataset, opening: see `knotgym.loaders`.

    Returns:
        A Dataset of dicts of tensors: observation uint8 (views * size, 2 size, 3 or 4) as in the
        environment, or float32 (6 beads,), a dict of both, or int16 (2, symbols); action; reward
        float32; next_observation; terminal; timeout; and what a window adds: discount, pulls, and
        the others named as in `arrays`. A list of indices, as from a BatchSampler, gives a batch.

    Raises:
        MissingExtra: torch isn't installed.
    """
    MissingExtra.imported("torch", "torch")
    from knotgym.loaders.pytorch import TransitionDataset

    return TransitionDataset(Transitions(dataset, **opening))


def to_d3rlpy(dataset: Any, **opening: Unpack[Opening]) -> Any:
    """Make a `d3rlpy.dataset.ReplayBuffer` of all transitions.

    Actions are pulls or decisions: d3rlpy has no actions of several whole numbers. Pictures are
    channels first;
    "both" is a tuple of pixels and state. For several steps or stacks use d3rlpy's own transition
    pickers and frame stacks.

    d3rlpy keeps T observations for T actions and drops the last transition of an episode that
    didn't terminate, which here is the one with the reward for failing. To keep that transition,
    such an episode gets its last state as one more step, with zero action and reward.

    Args:
        dataset, opening: see `knotgym.loaders`; without a window.

    Raises:
        MissingExtra: d3rlpy isn't installed.
        InvalidInput: there is a window, the action is neither "pull" nor "decision", or there are
            no transitions.
    """
    d3rlpy = MissingExtra.imported("d3rlpy", _D3RLPY)
    if opening.get("window") is not None:
        raise InvalidInput("d3rlpy has windows of its own: leave out window, use its pickers")
    transitions = Transitions(dataset, **opening)
    if np.issubdtype(transitions.actions.dtype, np.integer):
        raise InvalidInput(
            "d3rlpy has no actions of several whole numbers: use action 'pull' or 'decision', got"
            f" {transitions.action!r}"
        )
    if not len(transitions):
        raise InvalidInput(f"{transitions.dataset.path} has no transitions for d3rlpy")
    episodes = []
    for segment in range(transitions.segments):
        part = slice(*transitions.starts[segment : segment + 2])
        actions = transitions.seen_actions(np.arange(part.start, part.stop))["actions"]
        rewards = transitions.rewards[part, None].astype(np.float32)
        terminated = bool(transitions.terminals[part][-1])
        if not terminated:
            actions = np.concatenate([actions, np.zeros_like(actions[:1])])
            rewards = np.concatenate([rewards, np.zeros_like(rewards[:1])])
        seen = transitions.observations(segment, 0, len(actions))
        parts = [
            np.ascontiguousarray(np.moveaxis(part, -1, -3)) if part.dtype == np.uint8 else part
            for part in (seen.values() if isinstance(seen, dict) else [seen])
        ]
        shown = parts[0] if len(parts) == 1 else tuple(parts)
        episodes.append(d3rlpy.dataset.Episode(shown, actions, rewards, terminated))
    return d3rlpy.dataset.ReplayBuffer(
        d3rlpy.dataset.InfiniteBuffer(),
        episodes=episodes,
        action_space=d3rlpy.ActionSpace.CONTINUOUS,
        action_size=episodes[0].actions.shape[1],
    )


def to_tensordict(
    dataset: Any, *, folder: str | os.PathLike[str] | None = None, **opening: Unpack[Opening]
) -> Any:
    """Make a `tensordict.TensorDict` of all N transitions, to `extend` a TorchRL buffer with.

    Args:
        dataset, opening: see `knotgym.loaders`.
        folder: a new folder to keep the tensors in as memory-mapped files, for datasets that are
            larger than the memory; None to hold them in memory. `TensorDict.load_memmap(folder)`
            opens it again.

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
        Occupied: the folder exists.
    """
    tensordict = MissingExtra.imported("tensordict", "torchrl")
    transitions = Transitions(dataset, **opening)
    if folder is None:
        return _tensors(tensordict, transitions, _rows(transitions), slice(None))
    if os.path.lexists(folder):
        raise Occupied(f"{folder} exists already; choose another folder, or load_memmap this one")
    require_output(folder, folder=True, reads=[transitions.dataset.path])
    count, mapped = len(transitions), None
    with atomic_write(folder, overwrite=False) as part:
        for some, columns in transitions.blocks(_AT_ONCE, _drawn_generator(transitions)):
            block = _tensors(tensordict, transitions, columns, some)
            if mapped is None:
                mapped = block[:1].expand(count).memmap_like(part) if count else block.memmap(part)
            if count:
                mapped[some] = block
    return tensordict.TensorDict.load_memmap(folder)


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

    seen, then = (
        half if isinstance(half, dict) else {"observation": half}
        for half in (columns["observations"], columns["next_observations"])
    )
    added |= {name: columns[name] for name in ("beads", "whole") if name in columns}
    episode = np.repeat(np.arange(transitions.segments), np.diff(transitions.starts))
    return tensordict.TensorDict(
        {
            **seen,
            "action": columns["actions"],
            "episode": episode[some],
            **added,
            "done": running,
            "terminated": running.copy(),
            "truncated": running.copy(),
            "next": {
                **after,
                **then,
                "reward": columns["rewards"][:, None].astype(np.float32),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
        },
        batch_size=[len(terminated)],
    )


def stream(
    config: Played | Pictured,
    seed: int | None = None,
    *,
    batch: int = 256,
    block: int = 64,
    shuffled: int = 8,
    repeats: int = 4,
    batches: int | None = None,
    **opening: Unpack[Opening],
) -> DataStream:
    """Make episodes or pictures without end, and return batches of their transitions or rows.

    Where torch is imported, it is a torch `IterableDataset`:

        for batch in stream(CollectConfig(task=task, policy=policy), seed=0, action="decision"): ...
        DataLoader(stream(config, 0, batches=1000), batch_size=None, num_workers=4)

    A pass is what one `iter` of the stream or of its DataLoader gives. With `batches` pass p has
    the batches p * batches to (p + 1) * batches - 1, and the next one begins after them, even if
    this one wasn't read to its end. Without, a pass has no end: the next one goes on after the last
    batch given, and where workers read, which run ahead, there is no next one, but an error.

    The batches and their order are the same with any number of workers, however they are started,
    persistent or not; ranks of `torch.distributed` take turns, so each has every so manieth. Leave
    such a loader out of accelerate's `prepare`, which would share the batches of rank 0 among all.

    Training goes on after a kill with the next batch, and its pass ends where it would have: by
    `state_dict` where no workers read or between passes, else by torchdata's `StatefulDataLoader`.
    Memory holds `shuffled` blocks, the shuffle buffer.

    Args:
        config: a CollectConfig: which task, policy and labels; or an ImagesConfig: pictures of
            split train alone, so that its other splits stay unseen.
        seed: of the episodes, as of `collect --seed`, and of what is drawn from them; None for the
            configuration's.
        batch: transitions or pictures of a batch, all of one block.
        block: episodes or pictures of a block; the more, the less alike is a batch.
        shuffled: blocks that take turns; nothing is made twice if it is a multiple of the number of
            all workers.
        repeats: batches of a block; its rows come in random order, and again if there are fewer.
        batches: of a pass, by all ranks together, whose number divides it; None for no end.
        opening: see `knotgym.loaders`; not for pictures, whose batches are those of `images`.
    """
    if "torch" not in sys.modules:
        return DataStream(config, seed, batch, block, shuffled, repeats, batches, opening)
    from knotgym.loaders.pytorch import TorchStream

    return TorchStream(config, seed, batch, block, shuffled, repeats, batches, opening)


def images(
    path: str | os.PathLike[str],
    split: str | None = None,
    kind: str = "torch",
    *,
    max_nx: int | None = None,
) -> Any:
    """Load a perception table written by `knotgym images`.

    Args:
        path: the folder, or one shard.
        split: "train", "test", "test-code" or "test-nx"; None for all rows.
        kind: "torch" for a `knotgym.loaders.pytorch.PictureDataset`, which any number of
            DataLoader workers can share; "huggingface" for a `datasets.Dataset`, or a `DatasetDict`
            of all splits if split is None.
        max_nx: pad labels to this number of crossings (torch only); None for the largest in the
            table.

    Raises:
        MissingExtra: torch or Hugging Face's datasets isn't installed.
        InvalidInput: kind is neither of the two.
        InvalidFile: the table has no such split, or a row has more than max_nx crossings.
        MissingFile: nothing exists at path.
    """
    if kind == "torch":
        MissingExtra.imported("torch", "torch")
        from knotgym.loaders.pytorch import PictureDataset

        return PictureDataset(path, split, max_nx)
    if kind != "huggingface":
        raise InvalidInput(f"kind must be one of torch, huggingface, got {kind!r}")
    from knotgym.datasets import shards

    library = MissingExtra.imported("datasets", "huggingface")
    files: dict[str, list[str]] = {}
    for shard in map(Path.absolute, shards(path, split)):
        if "::" in str(shard):
            raise InvalidInput(f"Hugging Face takes '::' for a chain of paths, got {shard}")
        # a path is a pattern there: of `run[1]` the rows of `run1` would be read
        files.setdefault(shard.name.partition("-")[0], []).append(escape(str(shard)))
    wanted = None if split is None else next(iter(files))
    return library.load_dataset("parquet", data_files=files, split=wanted)
