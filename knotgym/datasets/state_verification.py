"""Check of a folder of curated states: nothing is taken on trust, every fault is named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from knotgym.atomic_files import sha256
from knotgym.datasets.near_duplicates import NEAR, distances
from knotgym.datasets.states import InvalidStates, States, read_states


def state_faults(states: States) -> Iterator[str]:
    """Faults of the rows: schema, labels by both labellers, knot type, picture, replay of the
    provenance, split leakage.
    """
    from knotgym.rendering.picture import draw
    from knotgym.rope import Rope
    from knotgym.simulation import Simulation
    from knotgym.topology.crossings import label
    from knotgym.topology.knots import knot_type
    from knotgym.topology.reference_labeller import pyknotid_code

    rope = Rope()
    if states.attributes.get("rope") != rope.config.fingerprint:
        yield (
            f"rope model {states.attributes.get('rope')} is not this version's,"
            f" {rope.config.fingerprint}"
        )
        return
    misshapen = _misshapen(states, rope.nq, rope.config.beads)
    if misshapen:
        yield from misshapen
        return
    simulation = Simulation(1, rope)
    for row in range(len(states)):
        where, points = f"states.h5 row {row}", states.points[row]
        if not (np.isfinite(points).all() and np.isfinite(states.qpos[row]).all()):
            yield f"{where}: coordinates are not finite"
            continue
        if not np.array_equal(rope.points(states.qpos[row]), points):
            yield f"{where}: points are not those of qpos"
        code = label(points)
        for name, stored, right in (
            ("gauss_code", states.gauss_code[row], str(code)),
            ("gauss_code_chiral", states.gauss_code_chiral[row], code.chiral),
            ("nx", states.nx[row], code.nx),
            ("knot", states.knot[row], knot_type(code)),
        ):
            if stored != right:
                yield f"{where}: {name} is {stored!s}, recomputed {right}"
        if pyknotid_code(points) != code:
            yield (
                f"{where}: pyknotid reads {pyknotid_code(points).chiral} where ours is"
                f" {code.chiral}"
            )
        if states.image is not None and not np.array_equal(states.image[row], draw(points)):
            yield f"{where}: image is not the picture of points"
        if states.split[row] not in ("train", "test"):
            yield f"{where}: split is {str(states.split[row])!r}"
        simulation.lay(states.source["start_qpos"][row][None])
        actions = states.source["actions"][row, : states.source["steps"][row]]
        if not (np.abs(actions) <= 1).all():
            yield f"{where}: an action lies outside [-1, 1]"
        elif not all(
            simulation.act(action[None]).all() for action in actions
        ) or not np.array_equal(simulation.qpos()[0], states.qpos[row]):
            yield f"{where}: replay of its start and actions does not end in qpos bit for bit"
    yield from _leaks(states)


def folder_faults(folder: Path) -> Iterator[str]:
    """Faults of a folder that `knotgym generate` made: manifest and checksums first, then the rows,
    then the trajectories.
    """
    from knotgym.datasets.episode_verification import verify_episodes

    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        listed, config = dict(manifest["files"]), dict(manifest["config"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield f"manifest.json can't be read: {error}"
        listed, config = {}, None
    for name, digest in listed.items():
        if not (folder / name).is_file():
            yield f"{name} is missing"
        elif sha256(folder / name) != digest:
            yield f"{name} is not the file the manifest lists (SHA-256 differs)"
    try:
        states = read_states(folder / "states.h5")
    except (InvalidStates, FileNotFoundError) as error:
        yield str(error)
        return
    yield from state_faults(states)
    for dataset in sorted(folder.glob("minari/**/main_data.hdf5")):
        yield from verify_episodes(dataset, act_out=True)
    if config is not None:
        if config.get("split_by") == "code":
            shared = set(states.gauss_code[states.split == "train"]) & set(
                states.gauss_code[states.split == "test"]
            )
            yield from (
                f"code {code or 'loop'} is in both splits, which share no code"
                for code in sorted(shared)
            )
        yield from _misplaced(states, manifest)


def _misshapen(states: States, nq: int, beads: int) -> list[str]:
    """Columns that a curated state needs and that are missing or of another shape."""
    n, out = len(states), []
    columns = {
        "qpos": states.qpos,
        "points": states.points,
        **{f"source/{name}": values for name, values in states.source.items()},
    }
    shapes = {
        "qpos": (n, nq),
        "points": (n, beads, 3),
        "source/start_qpos": (n, nq),
        "source/actions": (n, None, 6),
    }
    for name, shape in {**shapes, "source/steps": (n,), "source/seed": (n, None)}.items():
        found = columns[name].shape if name in columns else None
        if (
            found is None
            or len(found) != len(shape)
            or any(
                right is not None and size != right
                for size, right in zip(found, shape, strict=True)
            )
        ):
            yours = "missing" if found is None else f"of shape {found}"
            out.append(
                f"states.h5: {name} is {yours}, should be"
                f" ({', '.join('any' if size is None else str(size) for size in shape)})"
            )
    return out


def _misplaced(states: States, manifest: dict[str, object]) -> Iterator[str]:
    """Splits that the manifest's own list doesn't have."""
    listed = manifest.get("splits")
    if isinstance(listed, list):
        for row, (stored, right) in enumerate(zip(states.split.tolist(), listed, strict=False)):
            if stored != right:
                yield f"states.h5 row {row}: split is {stored}, the manifest says {right}"


def _leaks(states: States) -> Iterator[str]:
    """Near-duplicates and shared trajectories between the splits."""
    train, test = np.flatnonzero(states.split == "train"), np.flatnonzero(states.split == "test")
    for row in test:
        near = (
            train[distances(states.points[row], states.points[train]) < NEAR]
            if len(train)
            else train
        )
        yield from (
            f"states.h5 rows {other} (train) and {row} (test) are near-duplicates" for other in near
        )
    seeds = {tuple(states.source["seed"][row]): row for row in train}
    for row in test:
        if tuple(states.source["seed"][row]) in seeds:
            yield (
                f"states.h5 rows {seeds[tuple(states.source['seed'][row])]} (train) and {row}"
                " (test) come from one trajectory"
            )
