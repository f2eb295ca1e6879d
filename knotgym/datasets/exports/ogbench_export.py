"""Export episodes as data files for OGBench's agents and reader.

    {out}/{name}-train.npz      nine of ten episodes
    {out}/{name}-val.npz        every tenth episode
    {out}/{name}.npz            the training file again, under the name that the agents look for

An episode of T actions takes T + 1 consecutive rows of each array:

    observations    float32 (300,), vertices of the rope, or uint8 (size, size, 3); never the goal
    actions         float32 (6,); zeros in the last row, which has no action
    terminals       bool, true in the last row

A name consists of task, crossings and policy, as `tie-nx2-expert-v0`, with the prefix "visual-" for
pictures. Without the policy it is the id of the environment, see `adapters.ogbench_environment`.
"""

import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import Count, EpisodeReader, goal_axis, uncounted
from knotgym.datasets.minari_dataset import metadata_of

_TENTH = 10  # every tenth episode is for validation
_LOOKS = {"pixels": "visual-", "state": ""}


def to_ogbench(
    source: Any,
    out: str | os.PathLike[str],
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> None:
    """Write the files into the folder `out`, see `forms.export`; OGBench reads ~/.ogbench/data.

    A dataset with both pictures and vertices gives two sets of files.

    Raises:
        InvalidInput: fewer than two episodes, or neither pictures nor vertices.
    """
    reader, folder = EpisodeReader(source), Path(out)
    shown = reader.task.observation
    looks = [name for name in _LOOKS if shown in (name, "both")]
    if len(reader) < 2 or not looks:
        raise InvalidInput(
            "OGBench needs at least 2 episodes of pixels, state or both, for its training and its"
            f" validation file; {reader.path} has {len(reader)} of {shown}"
        )
    names = {look: _LOOKS[look] + _name(source, reader) for look in looks}
    files = [f"{name}{end}.npz" for name in names.values() for end in ("-train", "-val", "")]
    for wanted in files:
        require_output(folder / wanted, folder=False, overwrite=overwrite)
    last = min(_TENTH, len(reader)) - 1
    parts = {
        end: [k for k in range(len(reader)) if (k % _TENTH == last) == (end == "-val")]
        for end in ("-train", "-val")
    }
    for look, name in names.items():
        for end, episodes in parts.items():
            path = folder / f"{name}{end}.npz"
            with atomic_write(path, overwrite=overwrite) as temporary:
                arrays: dict[str, Any] = _rows(reader, episodes, look, count)
                with temporary.open("wb") as file:
                    np.savez_compressed(file, **arrays)
        with atomic_write(folder / f"{name}.npz", overwrite=overwrite) as temporary:
            shutil.copyfile(folder / f"{name}-train.npz", temporary)
    reader.close()


def _rows(
    reader: EpisodeReader, episodes: list[int], look: str, count: Count
) -> dict[str, NDArray[Any]]:
    """Concatenate the arrays of episodes."""
    ends = np.cumsum([int(reader.lengths[k]) + 1 for k in episodes])
    actions = np.zeros((ends[-1], 6), dtype=np.float32)
    terminals = np.zeros(ends[-1], dtype=bool)
    terminals[ends - 1] = True
    observations = np.empty(0)
    for done, (k, end) in enumerate(zip(episodes, ends, strict=True)):
        count(f"episodes of {look}", done, len(episodes))
        start = end - int(reader.lengths[k]) - 1
        rope = _rope_alone(reader.observations(k, observation=look), reader.task.layout)
        if not done:
            observations = np.empty((ends[-1], *rope.shape[1:]), rope.dtype)
        observations[start:end] = rope
        actions[start : end - 1] = reader.column(k, "actions")
    return {"observations": observations, "actions": actions, "terminals": terminals}


def _rope_alone(seen: NDArray[Any], layout: str) -> NDArray[Any]:
    """Return the rope's half of states (T + 1, 6 beads) or pictures (T + 1, size, ...)."""
    return np.split(seen, 2, axis=1 if seen.ndim == 2 else goal_axis(layout))[0]


def _name(source: Any, reader: EpisodeReader) -> str:
    """Return task, crossings, policy and version.

    OGBench splits names at dashes, so a policy has underscores instead.
    """
    metadata, task = metadata_of(source), reader.task
    dataset_id = metadata.dataset_id if metadata else f"{reader.attributes(0)['policy']}-v0"
    policy, _, version = dataset_id.rpartition("/")[2].rpartition("-")
    return f"{task.task}-nx{task.nx}-{re.sub(r'[^0-9A-Za-z_]', '_', policy)}-{version}"
