"""What learners take from episode datasets: states and pulls, or decisions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.decisions import Examples, examples
from knotgym.rope import RopeConfig
from knotgym.topology import plain_codes


class TrainingData(NamedTuple):
    """States and pulls of all episodes, one after the other.

    Attributes:
        frames: float32 (n, BEADS, 3), every state of every episode, metres.
        beads: int64 (n,), bead pulled by the action that led to each state; -1 for a first state.
        forces: float32 (n, 3), force of that action, in units of the largest.
        starts: int64 (episodes,), index of each episode's first state.
    """

    frames: NDArray[np.float32]
    beads: NDArray[np.int64]
    forces: NDArray[np.float32]
    starts: NDArray[np.int64]


def states_and_pulls(sets: Sequence[Episodes]) -> TrainingData:
    """Return the states and pulls of sets of episodes."""
    parts, before = list[TrainingData](), 0
    for one in sets:
        steps, starts = one.steps, one.offsets[:-1]
        # a row holds the pull made in its state; here it belongs to the state that it led to
        beads = np.roll(steps["bead"].astype(np.int64), 1)
        forces = np.roll(steps["force"] * steps["applied_fraction"][:, None], 1, axis=0)
        beads[starts] = -1
        parts.append(TrainingData(steps["observation"], beads, forces, before + starts))
        before += steps.rows
    return TrainingData(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def decisions_of(one: Episodes, first: int = 0) -> Examples:
    """Return the passes of a set of episodes; the numbers of episodes begin at `first`."""
    steps, episodes = one.steps, one.episodes
    # other macro-actions, which the scripted policy has too, pass no strand
    passes = (steps["macro_side"] != 0) & (steps["macro_target"] < steps["observation"].shape[1])
    # the first pull of each: there the policy saw the state and chose
    chosen = np.flatnonzero(steps["macro_start"] & passes)
    number = one.episode_of()[chosen]
    macros = [steps[f"macro_{name}"][chosen] for name in ("bead", "target", "side")]
    return examples(
        steps["observation"][chosen],
        plain_codes(np.asarray(episodes["goal_visits"][number], np.int16)),
        np.stack(macros, axis=1).astype(np.int64),
        episodes["success"][number],
        first + number,
    )


def require_trainable(task: TaskConfig, rope: str, episodes: Episodes, name: Any) -> None:
    """Require episodes of the train split, with the rope that learners know.

    Args:
        task: of the episodes.
        rope: fingerprint of the rope model.
        episodes: the dataset's.
        name: of the dataset, for messages.

    Raises:
        InvalidInput: they are not.
    """
    if not task.split.startswith("train"):
        raise InvalidInput(
            f"{name} is of the {task.split} split, which is held out for evaluation; train on"
            " datasets of the train split"
        )
    if not episodes.episodes.rows:
        raise InvalidInput(f"{name} has no episodes; collect some with knotgym collect")
    if rope != RopeConfig().fingerprint or task.integrator_steps != 24:
        raise InvalidInput(
            f"{name} was made with rope {rope} and {task.integrator_steps} integrator steps; the"
            f" learner supports only {RopeConfig().fingerprint} and 24"
        )
    beads = episodes.steps["observation"].shape[1]
    if beads != BEADS:
        raise InvalidInput(f"{name} has ropes of {beads} beads; {BEADS} are needed")
