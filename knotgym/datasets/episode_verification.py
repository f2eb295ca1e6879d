"""Whether episodes tell the truth: everything stored twice or computable is computed again and
compared.

Points are compared bit for bit, as are rewards and observations; a code is asked of both labellers.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import EpisodeReader, InvalidEpisodeFile
from knotgym.datasets.trajectory import Episode
from knotgym.rope import Rope
from knotgym.simulation import Simulation
from knotgym.tasks import TaskConfig
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.reference_labeller import pyknotid_code

_BATCH = 64  # episodes replayed side by side


def replay(episodes: Sequence[Episode], task: TaskConfig, threads: int = 1) -> list[int | None]:
    """Act every episode out again from its start.

    Args:
        episodes: of one task; side by side in one simulation.
        task: whose rope they pull.
        threads: of the simulation, 0 for every core.

    Returns:
        For each episode the first state that comes out different in any bit, None where none does.
    """
    if not episodes:
        return []
    simulation = Simulation(len(episodes), Rope(task.rope), threads)
    simulation.lay(np.array([one.start_qpos for one in episodes]))
    lengths = np.array([len(one) for one in episodes])
    different: list[int | None] = [None] * len(episodes)
    for step in range(int(lengths.max()) + 1):
        going = np.flatnonzero(lengths >= step).tolist()
        if step:
            simulation.act(np.array([episodes[i].actions[step - 1] for i in going]), going)
        for i in going:
            if different[i] is None and not np.array_equal(
                simulation.points[i], episodes[i].points[step]
            ):
                different[i] = step
    return different


def verify_episodes(
    source: Any,
    *,
    frames: int | None = 4,
    pyknotid: bool = True,
    act_out: bool = False,
    threads: int = 1,
) -> list[str]:
    """Check an episode file or a Minari dataset.

    Args:
        source: what `EpisodeReader` takes.
        frames: stored observations redrawn in each episode, evenly spread from the first to the
            last; None for all.
        pyknotid: ask the independent labeller about each episode's last state, about 10 ms each.
        act_out: `replay` every episode without a fault.
        threads: of the simulation that does.

    Returns:
        Faults, each naming the file, the episode and where it can the step; empty when all is well.
    """
    try:
        reader = EpisodeReader(source)
    except InvalidEpisodeFile as error:
        return [str(error)]
    rope = Rope(reader.task.rope)
    faults = _file_faults(reader, rope)
    right: list[int] = []
    for index, row in enumerate(reader.rows):
        where = f"{reader.path}, episode {row}"
        found: list[str] = []
        try:
            episode = reader.episode(index)
            if episode.digest() != reader.group(index).attrs["digest"]:
                found.append("its contents don't have the digest they were written with")
            found += episode_faults(episode, reader.task, rope)
            found += _observation_faults(reader, index, episode, frames)
            second = (
                pyknotid_code(episode.points[-1]).chiral
                if pyknotid
                else episode.gauss_code_chiral[-1]
            )
            if second != episode.gauss_code_chiral[-1]:
                found.append(
                    f"step {len(episode)}: pyknotid reads {second!r}, the file says"
                    f" {str(episode.gauss_code_chiral[-1])!r}"
                )
        except (InvalidEpisodeFile, OSError, KeyError, ValueError) as error:
            found.append(" ".join(str(error).split()).removeprefix(f"{where}: "))
        faults += [f"{where}: {fault}" for fault in found]
        if not found:
            right.append(index)
    for start in range(0, len(right) if act_out else 0, _BATCH):
        batch = right[start : start + _BATCH]
        for index, step in zip(
            batch,
            replay([reader.episode(index) for index in batch], reader.task, threads),
            strict=True,
        ):
            if step is not None:
                faults.append(
                    f"{reader.path}, episode {reader.rows[index]}: step {step}: acted out again,"
                    " the rope lies elsewhere"
                )
    reader.close()
    return faults


def episode_faults(episode: Episode, task: TaskConfig, rope: Rope) -> list[str]:
    """What is wrong in an episode of a task: numbers, labels, rewards and ends, each fault with its
    step.
    """
    numbers = {name: array for name, array in episode.arrays().items() if array.dtype.kind == "f"}
    faults = [
        f"{name} holds a number that isn't finite"
        for name, array in numbers.items()
        if not np.isfinite(array).all()
    ]
    if faults:
        return faults
    codes = label_many(episode.points)
    read = {
        "gauss_code": np.array([str(code) for code in codes]),
        "gauss_code_chiral": np.array([code.chiral for code in codes]),
        "crossings": np.array([code.nx for code in codes]),
        **_pulled(episode, rope),
        **_outcome(episode, codes, task),
    }
    for name, right in read.items():
        stored = getattr(episode, name)
        wrong = np.flatnonzero((stored != right).reshape(len(right), -1).any(axis=1))
        if len(wrong):
            faults.append(
                f"step {wrong[0]}: {name} is {stored[wrong[0]].tolist()!r}, should be"
                f" {right[wrong[0]].tolist()!r} ({len(wrong)} such)"
            )
    if np.abs(episode.actions).max() > 1:
        faults.append("an action lies outside [-1, 1]")
    if str(label(episode.goal_points)) != episode.goal_gauss_code:
        faults.append(
            f"the goal shows {str(label(episode.goal_points))!r}, goal_gauss_code says"
            f" {episode.goal_gauss_code!r}"
        )
    if not np.array_equal(rope.points(episode.start_qpos), episode.points[0]):
        faults.append("step 0: the rope doesn't lie where start_qpos lays it")
    if episode.relabelled and not np.array_equal(episode.goal_points, episode.points[-1]):
        faults.append("relabelled, but its goal isn't its last state")
    ended = episode.terminations | episode.truncations
    if (
        np.flatnonzero(ended).tolist() != [len(episode) - 1]
        or (episode.terminations & episode.truncations).any()
    ):
        faults.append(
            f"ends at step {np.flatnonzero(ended).tolist()}, should end once, at step"
            f" {len(episode) - 1}, either terminated or truncated"
        )
    return faults


def show_episodes(source: Any) -> dict[str, Any]:
    """Sum up an episode file or a Minari dataset; every value is JSON-able."""
    reader = EpisodeReader(source)
    said = [dict(reader.group(i).attrs) for i in range(len(reader))]
    success = np.array([reader.column(i, "is_success")[-1] for i in range(len(reader))], dtype=bool)
    failed = sum(bool(reader.column(i, "simulation_failed")[-1]) for i in range(len(reader)))
    returns = np.array([reader.column(i, "rewards").sum() for i in range(len(reader))])
    size, frames = reader.path.stat().st_size, int(reader.lengths.sum()) + len(reader)
    metadata = json.loads(reader.file.attrs.get("metadata", "{}"))
    summary = {
        "path": str(reader.path),
        "dataset_id": metadata.get("dataset_id"),
        "task": json.loads(reader.file.attrs["task"]),
        "stored": reader.stored,
        "episodes": len(reader),
        "steps": int(reader.lengths.sum()),
        "lengths": _spread(reader.lengths),
        "returns": _spread(returns),
        "successes": int(success.sum()),
        "success_rate": float(success.mean()) if len(success) else None,
        "simulation_failures": failed,
        "policies": dict(sorted(Counter(str(one["policy"]) for one in said).items())),
        "goals": dict(sorted(Counter(str(one["goal_gauss_code"]) for one in said).items())),
        "relabelled": sum(bool(one["relabelled"]) for one in said),
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
            f"{reader.path}: made with rope model {reader.rope}, this version has"
            f" {rope.config.fingerprint}"
        )
    there = {
        int(name.removeprefix("episode_")): int(group.attrs["total_steps"])
        for name, group in reader.file.items()
    }
    if (
        "index" in reader.file.attrs
        and {int(row): int(steps) for row, steps in reader.file.attrs["index"]} != there
    ):
        faults.append(f"{reader.path}: its index isn't that of its episodes")
    if sorted(reader.rows) != list(range(len(reader.file))):
        faults.append(
            f"{reader.path}: episodes aren't numbered from 0 to {len(reader.file) - 1}, as Minari"
            " counts them"
        )
    beside = reader.path.with_name("metadata.json")
    if beside.is_file():
        entries = json.loads(beside.read_text(encoding="utf-8"))
        for name, right in {
            "total_episodes": len(reader),
            "total_steps": int(reader.lengths.sum()),
            "jpeg_encoding": False,
        }.items():
            if entries.get(name) != right:
                faults.append(f"{beside}: {name} is {entries.get(name)}, should be {right}")
    return faults


def _observation_faults(
    reader: EpisodeReader, index: int, episode: Episode, frames: int | None
) -> list[str]:
    """Compare stored observations with what the environment shows of the same points."""
    if reader.stored == "none":
        return []
    from knotgym.rendering.observations import observe, picture_config

    count = len(episode) + 1
    found = reader.group(index)["observations"]
    faults = []
    for name, data in (
        {"pixels": found["pixels"], "state": found["state"]}.items()
        if reader.stored == "both"
        else [(reader.stored, found)]
    ):
        if len(data) != count:
            faults.append(f"{len(data)} observations ({name}), should be {count}")
            continue
        steps = (
            np.arange(count)
            if frames is None
            else np.unique(np.linspace(0, count - 1, min(frames, count)).astype(int))
        )
        right = observe(
            episode.points[steps], episode.goal_points, name, picture_config(reader.task)
        )
        wrong = [
            int(step)
            for step, one in zip(steps, right, strict=True)
            if not np.array_equal(data[step], one)
        ]
        if wrong:
            faults.append(
                f"step {wrong[0]}: the stored {name} isn't what the environment shows ({len(wrong)}"
                f" of {len(steps)} looked at)"
            )
    return faults


def _pulled(episode: Episode, rope: Rope) -> dict[str, NDArray[Any]]:
    """The beads and forces that the actions stand for."""
    apart = episode.points[:-1] - rope.config.reach * episode.actions[:, None, :3].astype(
        np.float64
    )
    bead = np.argmin((apart**2).sum(axis=2), axis=1)
    force = rope.config.max_force * episode.actions[:, 3:].astype(np.float64)
    return {
        "bead": np.concatenate([[-1], bead]),
        "force": np.concatenate([np.zeros((1, 3)), force]),
    }


def _outcome(
    episode: Episode, codes: Sequence[GaussCode], task: TaskConfig
) -> dict[str, NDArray[Any]]:
    """What the environment pays and says for these codes, up to the step the episode ends at."""
    goal = GaussCode.parse(episode.goal_gauss_code)
    held, hold = 0, episode.hold or task.hold
    success, failed = np.zeros(len(codes), dtype=bool), episode.simulation_failed
    for step, code in enumerate(codes[1:], 1):
        held = held + 1 if code.matches(goal) else 0
        success[step] = held >= hold and not failed[step]
    late = np.arange(1, len(codes)) >= task.horizon
    truncations = failed[1:] | (late & ~success[1:])
    rewards = np.where(
        success[1:], task.success_reward, np.where(late & ~failed[1:], task.failure_reward, 0.0)
    )
    return {
        "is_success": success,
        "terminations": success[1:],
        "truncations": truncations,
        "rewards": rewards,
    }


def _spread(values: NDArray[Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    least, middle, most = np.quantile(values, [0.0, 0.5, 1.0]).tolist()
    return {"min": least, "mean": float(values.mean()), "median": middle, "max": most}
