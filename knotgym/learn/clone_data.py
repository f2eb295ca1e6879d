"""Decisions to clone: which macro-action, or pull, was chosen in which state for which goal."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidInput, one_line
from knotgym.common.hdf5_files import require_regular
from knotgym.common.streams import Stream, generator
from knotgym.control.demonstrator import RANDOM
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.trajectory import MACRO_INFOS, Episode
from knotgym.envs.marked import Marked, mark
from knotgym.learn.clone_config import CloneConfig
from knotgym.learn.imagination import BEADS
from knotgym.learn.training_data import require_trainable
from knotgym.rope.actions import force_choices
from knotgym.rope.model import RopeConfig
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import shifted_base

Macro = tuple[int, int, int]  # or a `Pass`, which is one

MISSED = 11  # macro-actions without success that are kept of a state, at most
NONE = -1
NO_MACRO = NONE, NONE, 1


class Decisions(NamedTuple):
    """n choices of macro-actions, in the world.

    Attributes:
        points: float32 (n, beads, 3), metres.
        goals: str (n,), codes without chirality.
        macros: int64 (n, 1 + MISSED, 3): bead to lead, bead of the strand to pass, +1 over or -1
            under; first the one chosen, then some that were tried and led nowhere. Those that there
            aren't have bead and strand NONE.
        forces: float32 (n, 3), relative to the largest, of pulls; not used for macro-actions.
        episodes: int64 (n,), episodes are held out whole.
        intended: bool (n,), whether the goal was the one intended; else it was reached by chance,
            or the rope is a copy whose beads are numbered from another one.
    """

    points: NDArray[np.float32]
    goals: NDArray[np.str_]
    macros: NDArray[np.int64]
    forces: NDArray[np.float32]
    episodes: NDArray[np.int64]
    intended: NDArray[np.bool_]

    def rows(self, index: NDArray[Any]) -> Decisions:
        """Return some of the decisions."""
        return Decisions(*(column[index] for column in self))

    @property
    def digest(self) -> str:
        """SHA-256 of all columns, hexadecimal."""
        whole = hashlib.sha256("\n".join(self.goals.tolist()).encode())
        for column in (self.points, self.macros, self.forces, self.episodes, self.intended):
            whole.update(np.ascontiguousarray(column).tobytes())
        return whole.hexdigest()


class DecidedStep(NamedTuple):
    """One decision.

    Attributes:
        points: float32 (beads, 3), metres, before it.
        landed: the same after it.
        before, after: codes.
        macro: see `Decisions`; NO_MACRO where nothing is to be imitated.
        missed: what was tried there in vain.
    """

    points: NDArray[np.float32]
    landed: NDArray[np.float32]
    before: GaussCode
    after: GaussCode
    macro: Macro
    missed: tuple[Macro, ...] = ()

    def numbered_from(self, base: int) -> DecidedStep:
        """Return the same decision on a rope whose beads are numbered from bead `base`."""
        count = len(self.points)
        macro, *missed = (
            ((bead - base) % count, (target - base) % count, side)
            for bead, target, side in (self.macro, *self.missed)
        )
        before, after = (
            shifted_base(find_crossings(points.astype(np.float64)), base)
            for points in (self.points, self.landed)
        )
        return DecidedStep(
            np.roll(self.points, -base, axis=0),
            np.roll(self.landed, -base, axis=0),
            before,
            after,
            macro,
            tuple(missed),
        )


class Examples(NamedTuple):
    """n decisions in the canonical frame.

    Attributes:
        seen: states; frames apart, all that the network is shown.
        macros: int64 (n, 1 + MISSED, 3): bead, strand, 0 for under or 1 for over; see `Decisions`.
        forces: int64 (n, 3), choices of the force components of pulls.
        intended: bool (n,), as of `Decisions`.
    """

    seen: Marked
    macros: NDArray[np.int64]
    forces: NDArray[np.int64]
    intended: NDArray[np.bool_]

    def rows(self, index: NDArray[Any]) -> Examples:
        """Return some of the examples."""
        own = self.macros[index], self.forces[index], self.intended[index]
        return Examples(self.seen.rows(index), *own)

    def plus(self, other: Examples) -> Examples:
        """Return these examples and others."""
        own = [np.concatenate(both) for both in zip(self[1:], other[1:], strict=True)]
        return Examples(self.seen.plus(other.seen), *own)


def examples(decisions: Decisions) -> Examples:
    """Bring decisions into the canonical frame."""
    codes = {text: GaussCode.parse(text) for text in set(decisions.goals.tolist())}
    seen = mark(decisions.points, [codes[text] for text in decisions.goals.tolist()])
    frames = seen.frames
    macros = np.full_like(decisions.macros, NONE)
    for number, (beads, targets, sides) in enumerate(decisions.macros.transpose(1, 2, 0)):
        own = frames.renumber(beads), frames.renumber(targets), (frames.sides(sides) + 1) // 2
        macros[:, number] = np.where(beads[:, None] == NONE, NONE, np.stack(own, axis=1))
    forces = np.clip(frames.vectors(decisions.forces), -1, 1)
    return Examples(
        seen._replace(points=seen.points.astype(np.float32)),
        macros,
        force_choices(forces),
        decisions.intended,
    )


def read_decisions(datasets: Sequence[Any], config: CloneConfig) -> Decisions:
    """Read the decisions of datasets, given as ids or folders.

    Args:
        datasets: of the train split.
        config: says what is imitated.

    Raises:
        InvalidInput: a dataset is not of the train split, has no episodes, was made with another
            rope or engine, or holds no macro-actions.
        InvalidFile, MissingFile: a dataset is missing or not of this version.
    """
    parts = list[Decisions]()
    number = 0
    for dataset in datasets:
        reader = EpisodeReader(dataset)
        require_trainable(reader, dataset, config.engine)
        if config.action == "macro" and not reader.has("macro_start"):
            raise InvalidInput(
                f"{dataset} doesn't say which macro-actions its policy chose, so the clone can't"
                " learn them; use a demonstrator's set, or set action = bead to learn pulls"
            )
        for index in range(len(reader)):
            episode = reader.episode(index)
            if config.action == "macro":
                parts.append(_macros(episode, number, config))
            elif config.failed or episode.terminations[-1]:
                parts.append(_pulls(episode, number))
            number += 1
        reader.close()
    if datasets and not any(part.intended.any() for part in parts):
        raise InvalidInput(
            f"no episode of {', '.join(map(str, datasets))} reached its goal, so there is nothing"
            " to imitate; set failed = true to learn from the others too"
        )
    return join([none(), *parts])


def none() -> Decisions:
    """Return no decisions."""
    return gathered([], [], GaussCode(), 0, CloneConfig())


def join(parts: Sequence[Decisions]) -> Decisions:
    """Return all decisions in one; episode numbers stay as they are."""
    return Decisions(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def without_loops(steps: Sequence[DecidedStep]) -> list[DecidedStep]:
    """Leave out what happened between two visits to the same code, and steps that changed none."""
    way = list[DecidedStep]()
    for step in steps:
        codes = [one.before for one in way]
        if step.before in codes:
            del way[codes.index(step.before) :]
        way.append(step)
    return [step for step in way if step.before != step.after]


def gathered(
    way: Sequence[DecidedStep],
    imitated: Sequence[DecidedStep],
    goal: GaussCode,
    number: int,
    config: CloneConfig,
    vain: Sequence[DecidedStep] = (),
) -> Decisions:
    """Return the decisions of an episode that are worth learning.

    Args:
        way: steps whose consequences are goals too, in order: a code that a step led to is taken
            for the goal of that step and of up to `window` - 1 steps before it (hindsight).
        imitated: steps to imitate for the episode's own goal.
        goal: the episode's own.
        number: of the episode.
        config: says how much hindsight there is, and how many copies.
        vain: steps that aren't imitated; what was tried there in vain is learned all the same.
    """
    rows = [(step, goal.plain, True) for step in imitated]
    for step in vain:
        rows.append((step._replace(macro=NO_MACRO), goal.plain, False))
    window = config.hindsight
    for end, last in enumerate(way):
        reached = last.after.plain
        for step in way[max(0, end + 1 - window) : end + 1]:
            if reached != goal.plain and not step.before.matches(reached):
                rows.append((step, reached, False))
    # a copy's goal is the code that the whole way led to, read from the copy's first bead
    if imitated and imitated[-1].after.matches(goal):
        rng = generator(Stream.LEARN_COPIES, config.seed, abs(number), int(number < 0))
        for base in rng.choice(np.arange(1, BEADS), config.copies, replace=False).tolist():
            copied = [step.numbered_from(base) for step in imitated]
            rows += [(step, copied[-1].after.plain, False) for step in copied]
    count = len(rows)
    points = np.stack([step.points for step, *_ in rows]) if rows else np.zeros((0, BEADS, 3))
    return Decisions(
        points.astype(np.float32),
        np.array([str(code) for _, code, _ in rows], dtype=np.str_),
        _table([(step.macro, *step.missed) for step, *_ in rows]),
        np.zeros((count, 3), dtype=np.float32),
        np.full(count, number, dtype=np.int64),
        np.array([own for *_, own in rows], dtype=bool),
    )


def save_decisions(path: Path, decisions: Decisions, rates: dict[str, float]) -> None:
    """Write decisions and the success rates of the play that made them, as safetensors."""
    arrays = decisions._asdict()
    arrays["goals"] = np.frombuffer(
        "".join(f"{goal}\n" for goal in decisions.goals.tolist()).encode(), dtype=np.uint8
    )
    with atomic_write(path) as part:
        part.write_bytes(save(arrays, metadata={key: repr(rate) for key, rate in rates.items()}))


def load_decisions(path: Path) -> tuple[Decisions, dict[str, float]]:
    """Read what `save_decisions` wrote; raise InvalidInput if it is corrupted."""
    require_regular(path, "training", InvalidInput)
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}
            rates = {key: float(rate) for key, rate in (file.metadata() or {}).items()}
        goals = np.array(bytes(arrays.pop("goals")).decode().split("\n")[:-1], dtype=np.str_)
        decisions = Decisions(goals=goals, **arrays)
        lengths = {len(column) for column in decisions}
    except (SafetensorError, TypeError, ValueError) as error:
        raise InvalidInput(f"{path} can't be read: {one_line(error)}") from error
    if len(lengths) != 1:
        raise InvalidInput(f"{path} is corrupted: its columns have different lengths")
    return decisions, rates


def _table(tried: Sequence[tuple[Macro, ...]]) -> NDArray[np.int64]:
    """Return macro-actions, the first of each row chosen, as of `Decisions`."""
    macros = np.full((len(tried), 1 + MISSED, 3), NONE, dtype=np.int64)
    for row, own in zip(macros, tried, strict=True):
        row[: len(own)] = own[: 1 + MISSED]
    return macros


def _pulls(episode: Episode, number: int) -> Decisions:
    """Return every pull of an episode as a decision."""
    count = len(episode)
    # an info at state t + 1 belongs to the pull that led there from state t
    macros = _table([((bead, bead, 1),) for bead in episode.bead[1:].tolist()])
    return Decisions(
        episode.points[:-1].astype(np.float32),
        np.full(count, episode.goal_gauss_code),
        macros,
        (episode.force[1:] / RopeConfig().max_force).astype(np.float32),
        np.full(count, number, dtype=np.int64),
        np.ones(count, dtype=bool),
    )


def _macros(episode: Episode, number: int, config: CloneConfig) -> Decisions:
    """Return the macro-actions of an episode as decisions, and what they reached in hindsight."""
    start, *macro = (getattr(episode, name)[1:] for name in MACRO_INFOS)
    count = len(episode)
    starts, part_of_none = np.flatnonzero(start), np.asarray(macro[0]) < 0
    reasons = np.full(count, "") if episode.move is None else episode.move[1:]
    table = np.stack(macro, axis=1)
    codes = [GaussCode.parse(text) for text in episode.gauss_code_chiral.tolist()]
    goal = GaussCode.parse(episode.goal_gauss_code)
    imitated, way, decisions = list[DecidedStep](), list[DecidedStep](), list[Decisions]()
    ends = [*starts[1:].tolist(), count][: len(starts)]  # none if nothing was chosen
    for at, end in zip(starts.tolist(), ends, strict=True):
        points, (bead, target, side) = episode.points.astype(np.float32), table[at].tolist()
        step = DecidedStep(points[at], points[end], codes[at], codes[end], (bead, target, side))
        # a pass that nobody chose isn't imitated, but led somewhere all the same
        if reasons[at] != RANDOM and (config.failed or episode.terminations[-1]):
            imitated.append(step)
        if part_of_none[at:end].any():  # cut short by a random pull
            decisions.append(gathered(without_loops(way), [], goal, number, config))
            way = []
        elif step.before != step.after:
            way.append(step)
    return join([*decisions, gathered(without_loops(way), imitated, goal, number, config)])
