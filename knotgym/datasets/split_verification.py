"""Verify that starts and goals are of the task's split and that no episode occurs twice.

A goal is the state that its row names, bit for bit. A start is stirred by reset noise, so it must
be near the state that its row names, or at least near none of another split.
"""

from collections.abc import Hashable, Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from knotgym.common import KnotgymError, MissingFile
from knotgym.datasets.episode_dataset import EpisodeDataset
from knotgym.datasets.episodes import episode_digests
from knotgym.envs import task_sides
from knotgym.rope import Array, Rope
from knotgym.states import NEAR, States, distances, pairs_within, repeated

# metres, root mean square over the beads, after the best translation and rotation about z. Reset
# noise at its default scale stays below 6 mm, and no two states of a curated set are that close.
_MATCH = NEAR / 2
_HUGE = 1e3  # metres; coordinates beyond this are corrupted, a rope is 1.3 m long


def split_faults(dataset: EpisodeDataset) -> list[str]:
    """List the episodes whose start or goal isn't of the task's split.

    They are compared with the states that the task resets from. A single episode file whose states
    aren't found is skipped; a dataset without its states is a fault.
    """
    try:
        sides = _sides(dataset)
    except KnotgymError as error:
        return [f"{dataset.path}: its split can't be checked: {error}"]
    own, task, rope = dataset.episodes.episodes, dataset.task, Rope(dataset.task.rope_config)
    faults: list[str] = []
    for name, (states, allowed) in sides.items():
        for row, named in enumerate(own[name].tolist()):
            if not 0 <= named < len(states):
                fault = f"its {name} is row {named}, of {len(states)} states"
            elif named not in allowed:
                fault = f"its {name} is row {named}, none of those of the {task.split} split"
            elif name == "start":
                fault = _start_fault(rope.points(own["start_qpos"][row]), named, states, dataset)
            elif "goal_points" in own and not np.array_equal(
                own["goal_points"][row], states.points[named].astype(np.float32)
            ):
                fault = f"its goal isn't row {named} of the states, as the column goal says"
            else:
                continue
            faults += [f"{dataset.path}, episode {row}: {fault}"] if fault else []
    return faults


def shared_faults(
    points: Array, split: NDArray[np.str_], ropes: Sequence[Hashable], numbers: Sequence[int]
) -> Iterator[str]:
    """Yield what splits share: near-duplicates, and frames of one rope.

    Args:
        points: float64 (n, beads, 3), metres; rows that aren't finite or are huge are passed over.
        split: (n,).
        ropes: of each row, the rope that it is a frame of.
        numbers: of the rows.
    """

    def both(row: int, other: int) -> str:
        return f"rows {numbers[row]} ({split[row]}) and {numbers[other]} ({split[other]})"

    sound = (np.abs(points) < _HUGE).all(axis=(1, 2))
    for one, other in combinations(sorted(set(split.tolist()), reverse=True), 2):
        rows, others = (np.flatnonzero(sound & (split == name)) for name in (one, other))
        for i, k, apart in pairs_within(points[others], points[rows]):
            yield (
                f"{both(rows[k], others[i])} are near-duplicates: {1000 * apart:.1f} mm apart at"
                " the best symmetry"
            )
    for other, row in repeated(ropes):
        if split[other] != split[row]:
            yield f"{both(other, row)} come from one rope"


def duplicate_faults(dataset: EpisodeDataset) -> list[str]:
    """List the episodes with the same start, goal and pulls, bit for bit, as an earlier one.

    Without reset noise two seeds may give the same episode; then only a repeated seed is a fault.
    """
    digests, seeds = episode_digests(dataset.episodes), dataset.episodes.episodes["seed"].tolist()
    free = bool(dataset.task.reset_noise)
    keys = [(one, None if free else seed) for one, seed in zip(digests, seeds, strict=True)]
    return [
        f"{dataset.path}, episode {row}: the same as episode {earlier}, start, goal and pulls"
        for earlier, row in repeated(keys)
    ]


def _start_fault(points: Array, named: int, states: States, dataset: EpisodeDataset) -> str:
    """Say which state of another split a start is, "" if it is none."""
    if distances(points, states.points[named][None])[0] < _MATCH:
        return ""
    split = dataset.task.split
    mine = np.concatenate([states.rows(nx, split) for nx in set(states.nx.tolist())])
    apart = distances(points, states.points)
    apart[mine] = np.inf
    row = int(apart.argmin())
    return (
        f"its start is row {row}, which isn't of the {split} split" if apart[row] < _MATCH else ""
    )


def _sides(dataset: EpisodeDataset) -> dict[str, tuple[States, NDArray[np.int64]]]:
    """Read the states, and the rows of them, that starts and goals are drawn from, as a reset."""
    try:
        task = dataset.found_task
    except MissingFile:
        if dataset.metadata is None:
            return {}
        raise
    starts, goals = zip(*task_sides(task), strict=True)
    return {
        name: (same[0].states, np.unique(np.concatenate([one.rows for one in same])))
        for name, same in (("start", starts), ("goal", goals))
    }
