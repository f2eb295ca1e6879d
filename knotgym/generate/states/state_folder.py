"""Lay out the states and demonstrations of a run as rows of a state file and Minari datasets."""

import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.configuration import as_json
from knotgym.common.streams import Stream, generator
from knotgym.datasets.episode_writer import EpisodeWriter
from knotgym.datasets.minari_dataset import MinariMetadata, publish
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.states.demonstrations import POLICY, Demonstration
from knotgym.generate.states.drawn_states import MadeState
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.random_walk import WalkState
from knotgym.quality.measures import UNITS
from knotgym.rendering.picture import draw_many, picture_of
from knotgym.rope.model import rope_of
from knotgym.states.schema import DRAWING
from knotgym.states.split_names import STATE_SPLITS
from knotgym.states.splits import kept_together, split
from knotgym.states.state_file import States, demonstrations_id
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type

HORIZON = 200  # actions, longer than any demonstration


def states_of(
    config: GenerateConfig,
    knot: str,
    made: Sequence[MadeState],
    demonstrations: Sequence[Demonstration | None],
) -> States:
    """Return accepted states, sorted by nx and code, as rows of a state file.

    `knot` is the type of all, as `type_of` names it.
    """
    splits: list[str] = []
    for nx in config.nx:
        codes = [one.code for one in made if one.code.nx == nx]
        rng = generator(Stream.SPLIT, config.seed, nx)
        splits += split(codes, config.split_by, config.train_share, rng).tolist()
    crossings = np.array([one.code.nx for one in made], dtype=np.int64)
    points = np.stack([one.points for one in made])
    dealt = kept_together(np.array(splits), points, [one.code for one in made])
    drawing, source = json.dumps(as_json(config.drawing)), source_of(made)
    return rows_of(
        made,
        split=dealt.tolist(),
        source={
            **source,
            **demonstrations_of(
                crossings, dealt, knot, [one is not None for one in demonstrations]
            ),
            "step": np.array(
                [
                    steps if one is None else len(one)
                    for steps, one in zip(source["steps"], demonstrations, strict=True)
                ],
                dtype=np.int64,
            ),
            "drawing": np.array([drawing if one.policy == DRAWING else "" for one in made]),
        },
        config=as_json(config),
    )


def source_of(made: Sequence[MadeState]) -> dict[str, NDArray[Any]]:
    """Return the columns from which the states can be made again."""
    longest = max(len(one.actions) for one in made)
    actions = [np.pad(one.actions, ((0, longest - len(one.actions)), (0, 0))) for one in made]
    return {
        "start_qpos": np.stack([one.start_qpos for one in made]),
        "actions": np.stack(actions),
        "steps": np.array([len(one.actions) for one in made], dtype=np.int64),
        "seed": np.array([one.seed for one in made], dtype=np.int64),
        "policy": np.array([one.policy for one in made]),
    }


def rows_of(
    made: Sequence[MadeState] | Sequence[WalkState],
    split: Sequence[str],
    source: dict[str, NDArray[Any]],
    config: dict[str, Any],
) -> States:
    """Return measured states as rows of a state file, with their pictures and labels."""
    points = np.stack([one.points for one in made])
    return States.of(
        {
            "qpos": np.stack([one.qpos for one in made]),
            "points": points,
            "image": draw_many(points, picture_of(points.shape[1])),
            "gauss_code": np.array([str(one.code) for one in made]),
            "gauss_code_chiral": np.array([one.code.chiral for one in made]),
            "knot": np.array([knot_type(one.code) for one in made]),
            "nx": np.array([one.code.nx for one in made], dtype=np.int64),
            "split": np.array(split),
            **{
                f"quality/{name}": np.array([getattr(one.quality, name) for one in made])
                for name in UNITS
            },
            **{f"source/{name}": values for name, values in source.items()},
        },
        {
            "knotgym": knotgym.__version__,
            "mujoco": mujoco.__version__,
            "rope": rope_of(points.shape[1]).fingerprint,
            "engine": config["engine"],
            "config": config,
        },
    )


def demonstrations_of(
    nx: NDArray[np.int64], splits: NDArray[np.str_], knot: str, demonstrated: Sequence[bool]
) -> dict[str, NDArray[Any]]:
    """Return the columns that locate each state's demonstration.

    There is one dataset per nx and split, with episodes in the order of the states: "dataset", str
    (n,), and "trajectory", int64 (n,), the index of the episode in it; "" and -1 for states without
    a demonstration.
    """
    ids = [
        demonstrations_id(crossings, split, knot) if has else ""
        for crossings, split, has in zip(nx.tolist(), splits.tolist(), demonstrated, strict=True)
    ]
    return {
        "dataset": np.array(ids, dtype=np.str_),
        "trajectory": np.array(
            [ids[:row].count(one) if one else -1 for row, one in enumerate(ids)], dtype=np.int64
        ),
    }


def write_demonstrations(
    states: States,
    demonstrations: Sequence[Demonstration | None],
    config: GenerateConfig,
    knot: str,
    folder: Path,
    carried: Path,
) -> None:
    """Write one Minari dataset per nx and split below `folder`, with pixels and states.

    It has one episode for each state with a demonstration, in the order of the states.
    """
    for nx, name in product(config.nx, STATE_SPLITS):
        rows = [row for row in states.rows(nx, name).tolist() if states.source["dataset"][row]]
        if not rows:
            continue
        shard = folder / f"nx{nx}.h5"
        with EpisodeWriter(shard, demonstration_task(nx, name, knot, config.engine)) as writer:
            for row in rows:
                made = demonstrations[row]
                assert made is not None
                goal = GaussCode.parse(str(states.gauss_code[row]))
                writer.add(made.episode(states.points[row], goal))
        publish_demonstrations(nx, name, knot, config.engine, [shard], len(rows), folder, carried)
        shard.unlink()


def demonstration_task(nx: int, split: str, knot: str, engine: str) -> TaskConfig:
    """Return the task of the demonstrations for states with nx crossings in a split."""
    # Plain loops have nothing to tie, so their task is unknot, with the goal reached at the start.
    return TaskConfig(
        task="tie" if nx else "unknot",
        nx=max(1, nx),
        split=split,
        observation="both",
        horizon=HORIZON,
        states=demonstrations_id(nx, split, knot),
        engine=engine,
    )


def publish_demonstrations(
    nx: int,
    split: str,
    knot: str,
    engine: str,
    sources: Sequence[Any],
    count: int,
    root: Path,
    states: Path,
) -> None:
    """Publish `count` demonstrations, the episodes of `sources` in that order, below `root`.

    The sources may come from either split. The dataset includes the file `states`, so that the
    environment recovered from it resets from the states whose codes the episodes reach.
    """
    metadata = MinariMetadata(
        dataset_id=demonstrations_id(nx, split, knot),
        algorithm_name=POLICY,
        description=(
            f"Action sequences to the Gauss codes of {count} rope states with {nx} crossings, those"
            f" of the {split} split, engine {engine}, found by random and scripted play and by"
            " planning. An episode ends where the rope first shows the code of its goal; the goal"
            " itself, another configuration of that code, is in general not reached."
        ),
    )
    publish(
        sources,
        metadata,
        root,
        concatenate=True,
        states=states,
        task=demonstration_task(nx, split, knot, engine),
    )
