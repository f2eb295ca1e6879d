"""What learners take from episode datasets: states and pulls, or decisions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig, mark
from knotgym.learn.colour_reading import BEADS
from knotgym.rope import RopeConfig
from knotgym.topology import CodeArrays, GaussCode


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


class Examples(NamedTuple):
    """n decisions in the canonical frame, in few bytes.

    Attributes:
        points, marks, code, goal: float16 and int8, all that the network sees, as of `Marked`.
        macros: int8 (n, 3): bead, strand, 0 for under or 1 for over.
        worked: bool (n,), whether it was on a way to the goal; the other decisions aren't
            imitated, but the network learns that they don't work there.
        episodes: int64 (n,), number of the episode; episodes are held out whole.
    """

    points: NDArray[np.float16]
    marks: NDArray[np.int8]
    code: NDArray[np.int8]
    goal: NDArray[np.int8]
    macros: NDArray[np.int8]
    worked: NDArray[np.bool_]
    episodes: NDArray[np.int64]

    def rows(self, index: NDArray[Any]) -> "Examples":
        """Return some of the examples."""
        return Examples(*(column[index] for column in self))

    @property
    def nx(self) -> NDArray[np.int64]:
        """Crossings of the goals, int64 (n,)."""
        return np.count_nonzero(self.goal[:, :, 0], axis=1) // 2


def examples(
    points: NDArray[np.floating],
    goals: Sequence[GaussCode],
    macros: NDArray[np.int64],
    worked: NDArray[np.bool_],
    episodes: NDArray[np.int64],
) -> Examples:
    """Bring n decisions into the canonical frame.

    Args:
        points: (n, beads, 3), metres, where each macro-action begins; taken as float32.
        goals: n codes; chirality is ignored.
        macros: int64 (n, 3): bead to lead, bead of the strand to pass, +1 over or -1 under.
        worked, episodes: as of `Examples`.
    """
    seen = mark(points.astype(np.float32), goals)
    (beads, targets, sides), frames = macros.T, seen.frames
    chosen = frames.renumber(beads), frames.renumber(targets), (frames.sides(sides) + 1) // 2
    marks, code, goal, small = (
        column.astype(np.int8) for column in (*seen[1:4], np.stack(chosen, axis=1))
    )
    return Examples(seen.points.astype(np.float16), marks, code, goal, small, worked, episodes)


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
        CodeArrays(np.asarray(episodes["goal_visits"][number], np.int16)).objects(),
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
