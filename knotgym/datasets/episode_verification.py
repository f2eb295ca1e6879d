"""Verify episodes: recompute everything that can be recomputed and compare.

Points, rewards and observations must agree bit for bit; codes must agree with two independent
labellers.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import as_json, read_json
from knotgym.common.errors import InvalidFile, one_line
from knotgym.common.hdf5_files import foreign_bytes_as
from knotgym.datasets.episode_reader import (
    ATTRIBUTES_DIGEST,
    GOAL_INFO,
    Count,
    EpisodeReader,
    attributes_digest,
    counted_index,
    stored_index,
    uncounted,
)
from knotgym.datasets.split_verification import duplicate_faults, split_faults
from knotgym.datasets.trajectory import Episode
from knotgym.envs.observations import observe, picture_config
from knotgym.envs.reward import consecutive
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.actions import steps_taken
from knotgym.rope.engines import simulation, simulation_class, simulation_of
from knotgym.rope.model import Rope
from knotgym.rope.towing import TowBound
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type
from knotgym.topology.reference_labeller import pyknotid_code

_BATCH = 64  # episodes replayed side by side


def replay(
    episodes: Sequence[Episode], task: TaskConfig, threads: int = 1, count: Count = uncounted
) -> list[int | None]:
    """Replay episodes of one task from their starts, side by side in one simulation.

    Returns:
        For each episode the first state that differs in any bit, or that needed another share of
        the force; None if there is no such state.
    """
    if not episodes:
        return []
    ropes = simulation(task.engine, len(episodes), Rope(task.rope), threads)
    ropes.lay(np.array([episode.start_qpos for episode in episodes]))
    lengths = np.array([len(episode) for episode in episodes])
    different: list[int | None] = [None] * len(episodes)
    for step in range(int(lengths.max()) + 1):
        going = np.flatnonzero(lengths >= step).tolist()
        if step:
            ropes.act(np.array([episodes[i].actions[step - 1] for i in going]), going)
            replayed = int(np.minimum(lengths, step).sum())
            count("steps replayed", replayed, int(lengths.sum()))
        for i in going:
            same = np.array_equal(ropes.points[i], episodes[i].points[step])
            if step:
                same &= ropes.applied_shares[i] == episodes[i].applied_share[step]
            if different[i] is None and not same:
                different[i] = step
    return different


def verify_episodes(
    source: Any,
    *,
    frames: int | None = 4,
    pyknotid: bool = True,
    act_out: bool = False,
    threads: int = 1,
    count: Count = uncounted,
) -> list[str]:
    """Verify an episode file or a Minari dataset.

    Args:
        source: what `EpisodeReader` takes.
        frames: number of stored observations rendered again per episode, evenly spaced from the
            first to the last; None for all.
        pyknotid: compare each episode's last state with pyknotid, an independent labeller; about
            10 ms each.
        act_out: `replay` every episode that has no other fault.
        threads: threads of the simulation that replays, 0 for all cores.
        count: progress callback, called before each episode and after each replayed step.

    Returns:
        Faults; each names the file, the episode and, where possible, the step. Empty if there are
        none.
    """
    try:
        reader = EpisodeReader(source)
        rope = Rope(reader.task.rope)
        with foreign_bytes_as(InvalidFile, f"{reader.path} isn't a whole episode file"):
            faults = [*_file_faults(reader, rope), *split_faults(reader), *duplicate_faults(reader)]
    except InvalidFile as error:
        return [str(error)]
    faultless: list[int] = []
    for index, row in enumerate(reader.rows):
        count("episodes", index, len(reader))
        where = f"{reader.path}, episode {row}"
        own = _faults_of(reader, index, rope, frames, pyknotid)
        faults += [f"{where}: {fault.removeprefix(f'{where}: ')}" for fault in own]
        if not own:
            faultless.append(index)
    if act_out:
        faults += _replay_faults(reader, faultless, threads, count)
    reader.close()
    return faults


def episode_faults(episode: Episode, task: TaskConfig, rope: Rope) -> list[str]:
    """List an episode's faults: its numbers, codes, rewards and end."""
    faults = [
        f"{name} contains a number that isn't finite"
        for name, array in episode.arrays().items()
        if array.dtype.kind == "f" and not np.isfinite(array).all()
    ]
    if faults:
        return faults
    codes = label_many(episode.points)
    beads, forces = steps_taken(episode.actions, episode.points, rope.config)
    recomputed = {
        "gauss_code": np.array([str(code) for code in codes]),
        "gauss_code_chiral": np.array([code.chiral for code in codes]),
        "crossings": np.array([code.nx for code in codes]),
        "bead": beads,
        "force": episode.applied_share[:, None] * forces,
        **_outcome(episode, codes, task),
    }
    for name, right in recomputed.items():
        stored = getattr(episode, name)
        wrong = np.flatnonzero((stored != right).reshape(len(right), -1).any(axis=1))
        if len(wrong):
            faults.append(
                f"step {wrong[0]}: {name} is {stored[wrong[0]].tolist()!r}, should be"
                f" {right[wrong[0]].tolist()!r} ({len(wrong)} such)"
            )
    # nothing was scaled before the start; later shares are those that the engine can choose
    shares = simulation_class(task.engine).shares
    wrong = np.flatnonzero(~np.isin(episode.applied_share, shares))
    if len(wrong) or episode.applied_share[0] != 1:
        step = wrong[0] if len(wrong) else 0
        faults.append(
            f"step {step}: applied_share is {episode.applied_share[step]}, should be"
            f" {_listed(shares) if step else '1.0'}"
        )
    for what, actions in (("action", episode.actions), ("expert's action", episode.expert_action)):
        if actions is not None and np.abs(actions).max() > 1:
            faults.append(f"an {what} lies outside [-1, 1]")
    goal = label(episode.goal_points)
    if str(goal) != episode.goal_gauss_code:
        faults.append(
            f"the goal shows {str(goal)!r}, goal_gauss_code says {episode.goal_gauss_code!r}"
        )
    knots = knot_type(codes[0]), knot_type(goal)
    if knots[0] != knots[1]:
        faults.append(
            f"starts as {knots[0]}, and its goal is {knots[1]}: no pull changes the knot type"
        )
    elif goal.nx and codes[0].matches(goal):
        faults.append("starts in its goal's code")
    at_start = simulation_of(1, task.rope, task.engine)
    at_start.lay(episode.start_qpos[None])
    if not np.array_equal(at_start.points[0], episode.points[0]):
        faults.append("step 0: the rope doesn't lie where start_qpos lays it")
    if episode.relabelled and not np.array_equal(episode.goal_points, episode.points[-1]):
        faults.append("relabelled, but its goal isn't its last state")
    ends = np.flatnonzero(episode.terminations | episode.truncations).tolist()
    if ends != [len(episode) - 1] or (episode.terminations & episode.truncations).any():
        faults.append(
            f"ends at step {ends}, should end once, at step"
            f" {len(episode) - 1}, either terminated or truncated"
        )
    return faults


def show_episodes(source: Any) -> dict[str, Any]:
    """Summarize an episode file or a Minari dataset; every value can be written as JSON."""
    reader = EpisodeReader(source)
    attributes = [reader.attributes(i) for i in range(len(reader))]
    success = np.array(
        [reader.column(i, "is_success").any() for i in range(len(reader))], dtype=bool
    )
    failed = sum(bool(reader.column(i, "simulation_failed")[-1]) for i in range(len(reader)))
    returns = np.array([reader.column(i, "rewards").sum() for i in range(len(reader))])
    size, frames = reader.path.stat().st_size, int(reader.lengths.sum()) + len(reader)
    metadata = reader.metadata() or {}
    summary = {
        "path": str(reader.path),
        "dataset_id": metadata.get("dataset_id"),
        "task": as_json(reader.task),
        "stored": reader.stored,
        "episodes": len(reader),
        "steps": int(reader.lengths.sum()),
        "lengths": _spread(reader.lengths),
        "returns": _spread(returns),
        "successes": int(success.sum()),
        "success_rate": float(success.mean()) if len(success) else None,
        "simulation_failures": failed,
        "policies": _counted(each["policy"] for each in attributes),
        "goals": _counted(each["goal_gauss_code"] for each in attributes),
        "relabelled": sum(bool(each["relabelled"]) for each in attributes),
        "bytes": size,
        "bytes_per_frame": size / max(1, frames),
        "rope": reader.rope,
        "versions": reader.versions,
    }
    reader.close()
    return summary


def _file_faults(reader: EpisodeReader, rope: Rope) -> list[str]:
    faults = []
    if reader.rope != rope.config.fingerprint:
        faults.append(
            f"{reader.path}: generated with rope model {reader.rope}, this version has"
            f" {rope.config.fingerprint}"
        )
    if stored_index(reader.file) != counted_index(reader.file):
        faults.append(f"{reader.path}: its index doesn't match its episodes")
    if reader.file.attrs.get(ATTRIBUTES_DIGEST) != attributes_digest(reader.file.attrs):
        faults.append(f"{reader.path}: its attributes don't match {ATTRIBUTES_DIGEST}")
    if sorted(reader.rows) != list(range(len(reader.file))):
        faults.append(
            f"{reader.path}: episodes aren't numbered from 0 to {len(reader.file) - 1}, as Minari"
            " expects"
        )
    beside = reader.path.with_name("metadata.json")
    if beside.is_file():
        found = read_json(beside)
        entries = found if isinstance(found, dict) else {}
        counts = {"total_episodes": len(reader), "total_steps": int(reader.lengths.sum())}
        faults += [
            f"{beside}: {name} is {entries.get(name)}, should be {right}"
            for name, right in {**counts, "jpeg_encoding": False}.items()
            if entries.get(name) != right
        ]
    return faults


def _faults_of(
    reader: EpisodeReader, index: int, rope: Rope, frames: int | None, pyknotid: bool
) -> list[str]:
    """List the faults of one episode of a file; see `verify_episodes`."""
    faults: list[str] = []
    try:
        episode = reader.episode(index)
        if episode.digest() != reader.attributes(index).get("digest"):
            faults.append("its contents don't match its digest")
        faults += episode_faults(episode, reader.task, rope)
        faults += _observation_faults(reader, index, episode, frames)
        stored = str(episode.gauss_code_chiral[-1])
        second = pyknotid_code(episode.points[-1]).chiral if pyknotid else stored
        if second != stored:
            faults.append(
                f"step {len(episode)}: pyknotid reads {second!r}, the file says {stored!r}"
            )
        if reader.goal_codes(index) != [episode.goal_gauss_code] * (len(episode) + 1):
            faults.append(f"{GOAL_INFO} isn't {episode.goal_gauss_code!r} at every state")
    # h5py raises RuntimeError where one of HDF5's own checksums is wrong
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        faults.append(one_line(error))
    return faults


def _replay_faults(
    reader: EpisodeReader, rows: Sequence[int], threads: int, count: Count
) -> Iterator[str]:
    """Yield the episodes whose replay differs, with the step where it does."""
    before, steps = 0, int(reader.lengths[rows].sum())

    def count_all(stage: str, done: int, _: int) -> None:
        count(stage, before + done, steps)

    for start in range(0, len(rows), _BATCH):
        batch = rows[start : start + _BATCH]
        episodes = [reader.episode(index) for index in batch]
        different = replay(episodes, reader.task, threads, count_all)
        before += sum(map(len, episodes))
        for index, step in zip(batch, different, strict=True):
            if step is not None:
                yield (
                    f"{reader.path}, episode {reader.rows[index]}: step {step}: replayed, the"
                    " rope lies elsewhere, or another share of the force was applied"
                )


def _observation_faults(
    reader: EpisodeReader, index: int, episode: Episode, frames: int | None
) -> list[str]:
    """Compare stored observations with ones rendered from the same points."""
    count, faults = len(episode) + 1, []
    steps = np.arange(count)
    if frames is not None:
        steps = np.unique(np.linspace(0, count - 1, min(frames, count)).astype(int))
    for name, stored in reader.stored_observations(index).items():
        picture = picture_config(reader.task)
        shown = observe(
            episode.points[steps], episode.goal_points, name, picture, reader.task.layout
        )
        wrong = [
            int(step)
            for step, right in zip(steps, shown, strict=True)
            if not np.array_equal(stored[step], right)
        ]
        if wrong:
            faults.append(
                f"step {wrong[0]}: the stored {name} isn't what the environment shows ({len(wrong)}"
                f" of {len(steps)} compared)"
            )
    return faults


def _outcome(
    episode: Episode, codes: Sequence[GaussCode], task: TaskConfig
) -> dict[str, NDArray[Any]]:
    """Recompute rewards, ends and success from these codes by the task's reward rule."""
    goal = GaussCode.parse(episode.goal_gauss_code)
    shown = np.array([code.matches(goal) for code in codes[1:]])
    towed = np.zeros(len(shown), dtype=bool)
    if task.tow_limit is not None:
        bound = TowBound.of_episode(episode.points, task.tow_limit)
        towed = bound.exceeded(episode.points[1:])
    held = consecutive(shown & ~towed)
    rule = replace(task.reward_rule, hold=episode.hold or task.hold)
    failed = episode.simulation_failed[1:]
    outcome = rule.outcome(held, np.arange(1, len(codes)), failed, towed)
    return {
        "is_success": np.concatenate([[False], rule.reached(held, failed)]),
        "terminations": outcome.terminated,
        "truncations": outcome.truncated,
        "rewards": outcome.rewards,
    }


def _listed(shares: Sequence[float]) -> str:
    """List shares, or what many of them are multiples of."""
    few = len(shares) < 10
    return ", ".join(map(str, shares)) if few else f"a multiple of 1/{len(shares) - 1}"


def _counted(names: Iterable[object]) -> dict[str, int]:
    return dict(sorted(Counter(map(str, names)).items()))


def _spread(values: NDArray[Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    least, middle, most = np.quantile(values, [0.0, 0.5, 1.0]).tolist()
    return {"min": least, "mean": float(values.mean()), "median": middle, "max": most}
