"""What a finished run leaves behind: states.h5, trajectories, gallery, card and manifest, in a
folder that appears whole.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, fields
from itertools import compress, product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import sha256
from knotgym.common.streams import Stream, generator
from knotgym.datasets.cards.state_card import card, summary
from knotgym.datasets.episode_writer import EpisodeWriter
from knotgym.datasets.gallery import write_gallery
from knotgym.datasets.machine import machine
from knotgym.datasets.minari_dataset import MinariMetadata, publish
from knotgym.datasets.trajectory import Episode
from knotgym.envs.reward import success_at_last
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.states.candidates import Candidate
from knotgym.generate.states.curation_run import CurationRun
from knotgym.quality.measures import UNITS, Quality
from knotgym.rendering.picture import draw_many
from knotgym.rope.actions import steps_taken
from knotgym.rope.model import RopeConfig
from knotgym.rope.simulation_pool import simulation_of
from knotgym.states.schema import STATE_SPLITS
from knotgym.states.splits import kept_together, split
from knotgym.states.state_file import States, demonstrations_id, write_states
from knotgym.topology.crossings import label_many
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import knot_type

HORIZON = 200  # actions, longer than any way
# the archive's action sequences, carried over by a symmetry, followed by a random walk, opened up
POLICY = "demonstrations"


def states_of(run: CurationRun) -> States:
    """The accepted candidates as rows, by nx and then in the order of acceptance."""
    config = run.config
    chosen = {nx: run.chosen(nx) for nx in config.nx}
    candidates = [(nx, candidate) for nx in config.nx for candidate in chosen[nx]]
    longest = max(len(candidate.actions) for _, candidate in candidates)
    splits: list[str] = []
    for nx in config.nx:
        rng = generator(Stream.SPLIT, config.seed, nx)
        splits += split(
            [candidate.code for candidate in chosen[nx]],
            config.split_by,
            config.train_share,
            rng,
        ).tolist()
    points = np.stack([candidate.points[-1] for _, candidate in candidates])
    crossings = np.array([nx for nx, _ in candidates], dtype=np.int64)
    codes = [candidate.code for _, candidate in candidates]
    dealt = kept_together(np.array(splits), points, codes)
    return States(
        qpos=np.stack([candidate.qpos for _, candidate in candidates]),
        points=points,
        image=draw_many(points),
        gauss_code=np.array([str(candidate.code) for _, candidate in candidates]),
        gauss_code_chiral=np.array([candidate.code.chiral for _, candidate in candidates]),
        knot=np.array([knot_type(candidate.code) for _, candidate in candidates]),
        nx=crossings,
        split=dealt,
        quality={
            field.name: np.array(
                [getattr(candidate.quality, field.name) for _, candidate in candidates]
            )
            for field in fields(Quality)
        },
        units=dict(UNITS),
        source={
            "start_qpos": np.stack([candidate.start_qpos for _, candidate in candidates]),
            "actions": np.stack([_padded(candidate, longest) for _, candidate in candidates]),
            "steps": np.array(
                [len(candidate.actions) for _, candidate in candidates], dtype=np.int64
            ),
            "seed": np.array([candidate.seed for _, candidate in candidates], dtype=np.int64),
            "policy": np.array([POLICY] * len(candidates)),
            **demonstrations_of(crossings, dealt, run.knot),
            "step": np.array(
                [len(candidate.actions) for _, candidate in candidates], dtype=np.int64
            ),
        },
        attributes={
            "knotgym": knotgym.__version__,
            "mujoco": mujoco.__version__,
            "rope": config.candidate.rope.fingerprint,
            "config": json.dumps(asdict(config), sort_keys=True),
        },
    )


def demonstrations_of(
    nx: NDArray[np.int64], splits: NDArray[np.str_], knot: str
) -> dict[str, NDArray[Any]]:
    """The columns that say which demonstration leads to each state.

    Each nx and split has a dataset, its episodes in the order of the states; "" of a state that
    has none.

    Args:
        nx: int64 (n,), of the states.
        splits: str (n,), of the states.
        knot: that they all are.

    Returns:
        "dataset", str (n,), and "trajectory", int64 (n,), the episode there.
    """
    ids = [
        demonstrations_id(*one, knot=knot) if _demonstrated(one[0], nx.tolist(), knot) else ""
        for one in zip(nx.tolist(), splits.tolist(), strict=True)
    ]
    return {
        "dataset": np.array(ids, dtype=np.str_),
        "trajectory": np.array(
            [ids[:row].count(one) for row, one in enumerate(ids)], dtype=np.int64
        ),
    }


def _demonstrated(nx: int, every: Sequence[int], knot: str) -> bool:
    """Whether states with nx crossings have demonstrations: those of a knot begin at its least
    diagram, so the states of fewest crossings have none.
    """
    return knot == UNKNOT or nx > min(every)


def report_of(run: CurationRun) -> dict[str, Any]:
    """What the run did, JSON-able and the same for the same configuration."""
    attempts: Counter[int] = Counter({nx: sum(tried.values()) for nx, tried in run.tried.items()})
    return {
        "version": knotgym.__version__,
        "mujoco": mujoco.__version__,
        "knot": run.knot,
        "existing_codes": {str(nx): count for nx, count in run.existing.items()},
        "attempts": attempts.total(),
        "actions": run.steps(),
        "rejected": {
            str(nx): dict(sorted(reasons.items())) for nx, reasons in run.rejected.items()
        },
        "growth": run.growth,
    }


def write(run: CurationRun, folder: Path, request: dict[str, Any]) -> None:
    """Write everything the contract lists into a new folder, the manifest last."""
    folder.mkdir(parents=True)
    states = states_of(run)
    write_states(folder / "states.h5", states)
    write_trajectories(run, states, folder / "minari", folder / "states.h5")
    run.archive.save(folder / "archive.h5")
    finish(folder, states, report_of(run), request)


def finish(
    folder: Path,
    states: States,
    report: dict[str, Any],
    request: dict[str, Any],
    machines: Sequence[dict[str, str]] | None = None,
) -> None:
    """Write gallery, card and manifest into a folder that has the states and the trajectories, made
    on these machines or on this one.
    """
    write_gallery(folder / "gallery.png", states)
    (folder / "README.md").write_text(card(states, report, request["config"]), encoding="utf-8")
    manifest = {
        "format": "knotgym-manifest",
        "format_version": 1,
        **request,
        "machines": machines or [machine()],
        "report": report,
        "summary": summary(states),
        "splits": states.split.tolist(),
        "files": {
            str(path.relative_to(folder)): sha256(path)
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        },
    }
    (folder / "manifest.json").write_text(
        json.dumps(manifest, indent=1, sort_keys=True), encoding="utf-8"
    )


def write_trajectories(run: CurationRun, states: States, folder: Path, carried: Path) -> None:
    """One Minari dataset for each nx and split below `folder`, knotgym/tie-nx3/demonstrations-v0
    for train and knotgym/tie-nx3/demonstrations-test-v0 for test, with pixels and states; an
    episode a state, in their order.
    """
    for nx, name in product(run.config.nx, STATE_SPLITS):
        splits = states.split[states.nx == nx].tolist()
        candidates = list(compress(run.chosen(nx), [one == name for one in splits]))
        if not candidates or not _demonstrated(nx, run.config.nx, run.knot):
            continue
        shard = folder / f"nx{nx}.h5"
        with EpisodeWriter(shard, demonstration_task(nx, name, run.knot)) as writer:
            for candidate in candidates:
                writer.add(episode_of(candidate))
        publish_demonstrations(nx, name, run.knot, [shard], len(candidates), folder, carried)
        shard.unlink()


def demonstration_task(nx: int, split: str, knot: str) -> TaskConfig:
    """The task that the ways to states with nx crossings in a split are episodes of."""
    # a loop has nothing to tie: its episodes are those of an unknot task whose goal is shown from
    # the start
    return TaskConfig(
        task="tie" if nx else "unknot",
        nx=max(1, nx),
        split=split,
        observation="both",
        horizon=HORIZON,
        states=demonstrations_id(nx, split, knot),
    )


def publish_demonstrations(
    nx: int,
    split: str,
    knot: str,
    sources: Sequence[Any],
    count: int,
    root: Path,
    states: Path,
) -> None:
    """Write `count` ways from the episodes of `sources`, one source after another, below `root`.

    The sources may be of either split: they are dealt out anew. The dataset carries `states`, so
    that the environment recovered from it resets from the very states that the ways lead to.
    """
    metadata = MinariMetadata(
        dataset_id=demonstrations_id(nx, split, knot),
        algorithm_name=POLICY,
        description=(
            f"The ways to {count} curated rope states with {nx} crossings, those of the {split}"
            " split: searched, carried over by symmetry, opened up. An episode goes on past the"
            " first time that its code is shown, until the rope lies open and at rest, and ends"
            " there."
        ),
    )
    publish(
        sources,
        metadata,
        root,
        concatenate=True,
        states=states,
        task=demonstration_task(nx, split, knot),
    )


def episode_of(candidate: Candidate) -> Episode:
    """The way to a state as an episode; it goes on past the first time that the code is shown,
    until the rope lies open and at rest.
    """
    steps, codes = len(candidate.actions), label_many(candidate.points)
    shown = np.array([code.matches(candidate.code) for code in codes])
    beads, forces = steps_taken(candidate.actions, candidate.points, RopeConfig())
    shares = _applied_shares(candidate)
    outcome = success_at_last(steps)
    return Episode(
        start_qpos=candidate.start_qpos,
        points=candidate.points,
        goal_points=candidate.points[-1],
        actions=candidate.actions,
        rewards=outcome.rewards,
        terminations=outcome.terminated,
        truncations=outcome.truncated,
        gauss_code=np.array([str(code) for code in codes]),
        gauss_code_chiral=np.array([code.chiral for code in codes]),
        crossings=np.array([code.nx for code in codes], dtype=np.int64),
        bead=beads,
        force=shares[:, None] * forces,
        applied_share=shares,
        is_success=np.concatenate([[False], outcome.terminated]),
        simulation_failed=np.zeros(steps + 1, dtype=bool),
        goal_gauss_code=str(candidate.code),
        policy=POLICY,
        hold=int(np.argmin(shown[:0:-1])) if not shown[1:].all() else steps,
    )


def _applied_shares(candidate: Candidate) -> NDArray[np.float64]:
    """The share of its force that led to each state of a candidate, float64 (T + 1,), 1 first."""
    simulation = simulation_of(1, RopeConfig())
    simulation.lay(candidate.start_qpos[None])
    shares = [1.0]
    for action in candidate.actions:
        simulation.act(action[None])
        shares.append(float(simulation.applied_shares[0]))
    return np.array(shares)


def _padded(candidate: Candidate, longest: int) -> np.ndarray:
    out = np.zeros((longest, 6), dtype=np.float32)
    out[: len(candidate.actions)] = candidate.actions
    return out
