"""Recordings as their files have them: without what follows from seeds, and forces in fewer bytes.

A start takes 3 kB, and forces most of the bytes of the steps. So a start that its seed draws is
stored as zeros, and forces as whole numbers if all of them are `quantized`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile, KnotgymError, Table
from knotgym.datasets.episodes import PULLS, STORED_PULLS, Episodes
from knotgym.envs import EpisodeBatch
from knotgym.rope import Rope

if TYPE_CHECKING:
    from knotgym.datasets.episode_dataset import EpisodeDataset

_DRAWN = 1024  # starts that are drawn together


def packed(parts: Sequence[Episodes], place: "EpisodeDataset") -> list[Episodes]:
    """Return recordings as the file of the dataset `place` has them."""
    wanted = "seed", *({"setup"} & {*parts[0].episodes})
    counts = [part.episodes.rows for part in parts]
    try:
        drawn = _starts(place, Table.joined([part.episodes.only(*wanted) for part in parts]))
    except KnotgymError:  # the states aren't here, so that all starts stay
        drawn = np.full((sum(counts), 1), np.nan)
    stored = list[Episodes]()
    for part, again in zip(parts, np.split(drawn, np.cumsum(counts)[:-1]), strict=True):
        starts = part.episodes["start_qpos"].copy()
        starts[(starts.view(np.int64) == again.view(np.int64)).all(axis=1)] = 0
        stored.append(part._replace(episodes=part.episodes.replaced(start_qpos=starts)))
    binned = (Episodes.binned(part.steps["force"]) for part in parts)
    bins = [forces for forces in binned if forces is not None]
    if len(bins) < len(parts):
        return stored
    schema = parts[0].steps.schema.without("force")
    schema = schema.extended(*STORED_PULLS.only("force_bins").columns)
    return [
        part._replace(steps=Table(schema, {**part.steps, "force_bins": forces}))
        for part, forces in zip(stored, bins, strict=True)
    ]


def unpacked(stored: "EpisodeDataset") -> "EpisodeDataset":
    """Return a recording with all starts and forces.

    Raises:
        MissingFile: starts must be drawn, and the states aren't here.
        InvalidFile: it has no forces, or starts of another rope.
    """
    rows, steps = stored.episodes
    lacking = np.flatnonzero(~rows["start_qpos"].any(axis=1))
    if len(lacking):
        starts = rows["start_qpos"].copy()
        drawn = _starts(stored, rows.take(lacking))
        if drawn.shape[1] != starts.shape[1]:
            raise InvalidFile(f"{stored.path} has starts of another rope than its task")
        starts[lacking] = drawn
        rows = rows.replaced(start_qpos=starts)
    columns = {**steps}
    if "force_bins" in columns:
        columns["force"] = Episodes.unbinned(columns.pop("force_bins"))
    if "force" not in columns:
        raise InvalidFile(f"{stored.path} has no forces")
    schema = PULLS.with_own(columns).only(*columns)
    return replace(stored, episodes=Episodes(rows, Table(schema, columns)))


def _starts(place: "EpisodeDataset", rows: Table) -> NDArray[np.float64]:
    """Draw the starts of episodes again, float64 (n, nq); zeros where no seed is known.

    `rows` are those of a dataset's table of episodes, with the columns `seed` and, if any, `setup`.
    """
    states, seeds = place.found_task.states, rows["seed"]
    setup = rows.get("setup", np.zeros(rows.rows, np.int16))
    starts = np.zeros((rows.rows, Rope(place.task.rope_config).nq))
    for number, task in enumerate(place.tasks):
        batch = EpisodeBatch(replace(task, states=states))
        known = np.flatnonzero((seeds >= 0) & (setup == number))
        for first in range(0, len(known), _DRAWN):
            some = known[first : first + _DRAWN]
            starts[some] = batch.drawn(seeds[some].tolist())["start_qpos"]
    return starts
