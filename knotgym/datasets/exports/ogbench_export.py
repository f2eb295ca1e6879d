"""Export episodes as data files for OGBench's agents and reader.

    {out}/{name}-train.npz      nine of ten episodes
    {out}/{name}-val.npz        every tenth episode
    {out}/{name}.npz            the training file again, under the name that the agents look for

An episode of T actions takes T + 1 consecutive rows of each array:

    observations    float32 (300,), vertices of the rope, or uint8 (size, size, 3); never the goal
    actions         float32 (6,); zeros in the last row, which has no action
    terminals       bool, true in the last row

A name consists of task, crossings and policy, as `tie-nx2-expert-v0`, with the prefix "visual-" for
pictures. Without the policy it is the id of the environment, see `adapters.OGBenchEnv`.
"""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import Counts, InvalidInput, atomic_write, require_output
from knotgym.datasets.episode_dataset import EpisodeDataset, columns_of
from knotgym.datasets.episode_verification import Replay
from knotgym.datasets.located import Located
from knotgym.datasets.minari_form import metadata_of

_TENTH = 10  # every tenth episode is for validation
_LOOKS = {"pixels": "visual-", "state": ""}


def to_ogbench(source: Located, out: Path, _: Replay, overwrite: bool) -> str:
    """Write the files into the folder `out`, and return a one-line summary.

    OGBench reads ~/.ogbench/data. A dataset with both pictures and vertices gives two sets of
    files.

    Raises:
        InvalidInput: several datasets, fewer than two episodes, or neither pictures nor vertices.
        Occupied: a file exists, and `overwrite` is False.
    """
    if len(source.episodes) > 1:
        raise InvalidInput(
            f"{source.title} has {len(source.episodes)} datasets; export them to ogbench one by one"
        )
    dataset = columns_of(source.episodes[0])
    shown, count = dataset.task.observation, dataset.episodes.episodes.rows
    looks = [name for name in _LOOKS if shown in (name, "both")]
    if count < 2 or not looks:
        raise InvalidInput(
            "OGBench needs at least 2 episodes of pixels, state or both, for its training and its"
            f" validation file; {dataset.path} has {count} of {shown}"
        )
    names = {look: _LOOKS[look] + _name(dataset) for look in looks}
    files = [f"{name}{end}.npz" for name in names.values() for end in ("-train", "-val", "")]
    for wanted in files:
        require_output(out / wanted, folder=False, overwrite=overwrite, reads=[source.root])
    validates = np.arange(count) % _TENTH == min(_TENTH, count) - 1
    with atomic_write(out, *files, overwrite=overwrite) as staged:
        for look, name in names.items():
            for end, chosen in (("-val", validates), ("-train", ~validates)):
                arrays = _arrays(dataset.select(chosen), look)
                np.savez_compressed(staged / f"{name}{end}.npz", allow_pickle=False, **arrays)
            shutil.copyfile(staged / f"{name}-train.npz", staged / f"{name}.npz")
    return f"{count} episodes for ogbench"


def _arrays(dataset: EpisodeDataset, look: str) -> dict[str, Any]:
    steps = dataset.episodes.steps
    terminals = np.zeros(steps.rows, dtype=bool)
    terminals[dataset.episodes.last()] = True
    seen = steps["observation"].reshape(steps.rows, -1)
    if look != "state":
        rows = dataset.episodes.episodes.rows
        told = Counts.over(range(rows), "drawing episodes", rows)
        seen = np.concatenate([dataset.select([k]).pictures(beside_goals=False) for k in told])
    return {"observations": seen, "actions": steps["action"], "terminals": terminals}


def _name(dataset: EpisodeDataset) -> str:
    """Return task, crossings, policy and version.

    OGBench splits names at dashes, so a policy has underscores instead.
    """
    task, policies = dataset.task, dataset.episodes.episodes["policy"]
    metadata = metadata_of(dataset)  # checks the id, which names files here
    dataset_id = metadata.dataset_id if metadata else f"{policies[0]}-v0"
    policy, _, version = dataset_id.rpartition("/")[2].rpartition("-")
    return f"{task.name}-{re.sub(r'[^0-9A-Za-z_]', '_', policy)}-{version}"
