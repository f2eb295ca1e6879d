"""Entries: scores that anyone can replay, because they are the pulls of every episode.

`knotgym evaluate --record FILE` writes one, `knotgym dataset verify FILE` replays it. No word of
the file is taken for a start or an outcome: each start is drawn from the seed, each pull is made
again, and successes, steps and interval are recounted. What no replay can prove, such as that a
policy and not a search chose the pulls, is shown as claimed.

    episodes    one row an episode, setup after setup: pulls, digest
    steps       one row a pull: bead and force, in bins if all are quantized
    config      attribute: of the evaluation, with its seed
    states      attribute: digests of the sets that starts and goals are from
    rope        attribute: fingerprint of the rope model
    claimed     attribute: for each setup its action view, whether its policy plans, and pulls that
                it simulated for each one made; its training (learner, data with digests,
                parameters, updates, seconds, seed, command) and files; versions, commit and command
    digest      attribute: SHA-256 of all of these
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym import common
from knotgym.common import Column, Counts, InvalidFile, KnotgymError, Schema, Stream, Table
from knotgym.control import replay
from knotgym.datasets import PULLS, Episodes
from knotgym.envs import TaskConfig
from knotgym.generate.collection import blocks
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.generate.recordings import DIGESTS, LENGTH, digests
from knotgym.generate.results import Result, show
from knotgym.rope import ENGINES, FORCE_BINS, RopeConfig
from knotgym.runs import Progress, executor
from knotgym.runs import Result as Kept
from knotgym.states import is_bundled, resolve_states

FORMAT, VERSION = "knotgym-entry", 1
ROWS = Schema("episodes", (LENGTH._replace(dtype="uint32"), DIGESTS), "an episode, setup by setup")
_BEAD, _FORCE = PULLS.columns[0], PULLS.columns[1]._replace(optional=True)
_UNIT = f"max_force / {FORCE_BINS}"
_BINS = Column("bins", "int8", (3,), _UNIT, "the force, where all forces are quantized", True)
PULLED = Schema("steps", (_BEAD, _FORCE, _BINS), "a pull, episode after episode")


class Entry(NamedTuple):
    """An entry that was read.

    Attributes:
        config: of the evaluation.
        rows: the table ROWS.
        pulls: bead and force of each pull.
        claimed: what replay doesn't prove, a dictionary for each setup.
    """

    config: EvaluateConfig
    rows: Table
    pulls: Table
    claimed: list[dict[str, Any]]

    def __str__(self) -> str:
        return f"{self.rows.rows} episodes of {self.pulls.rows} pulls, all replayed"

    def faults(self, progress: Progress) -> Iterator[str]:
        """Replay all episodes, show what they score beside what is claimed, and yield faults."""
        results = list[Result]()
        for result, faults in self.recounted():
            results.append(result)
            yield from faults
        if not progress.quiet:
            show(results, progress.console, self.config.task.engine)
        for number, claimed in enumerate(self.claimed, 1):
            progress.say(common.one_line(f"setup {number}, claimed: {json.dumps(claimed)}"))

    def recounted(self) -> Iterator[tuple[Result, list[str]]]:
        """Replay: yield the result of each setup, and its faults."""
        config, lengths, first = self.config, self.rows["length"].astype(np.int64), 0
        ends = np.concatenate([[0], np.cumsum(lengths)])
        seed_of = Stream.EVALUATION_EPISODE.derived_seed
        with executor(ENGINES[config.task.engine].workers) as pool:
            done = Counts.from_now(pool=pool)
            Counts.tell("episodes replayed", done, self.rows.rows)
            for setup, (policy, task) in enumerate(config.setups()):
                few = blocks(config.episodes, task, policy.plans, first)
                rows = [self.rows.take(slice(one.start, one.stop)) for one in few]
                pulls = [self.pulls.take(slice(ends[one.start], ends[one.stop])) for one in few]
                seeds = [[seed_of(config.seed, k - first) for k in one] for one in few]
                made = pool.map(_replayed, [task] * len(few), seeds, rows, pulls)
                columns = [*map(dict[str, Any], made)]
                wrong = np.concatenate([one.pop("wrong") for one in columns])
                faults = [
                    f"setup {setup + 1}, episode {k}: replayed, it ends otherwise or comes through"
                    " other states"
                    for k in np.flatnonzero(wrong).tolist()
                ]
                action = str(self.claimed[setup].get("action", ""))
                played = Episodes.merged([Episodes.of(one) for one in columns]).episodes
                yield Result.of(policy.policy, action, task, played), faults
                first += config.episodes


def write_entry(
    path: Path, config: EvaluateConfig, played: Sequence[Episodes], claimed: list[dict[str, Any]]
) -> None:
    """Write the episodes of all setups, played with all columns of steps, to a file."""
    rows = list[Table]()
    made = Table.joined([one.pulls().only(_BEAD.name, _FORCE.name) for one in played])
    for one in played:
        lengths: NDArray[Any] = one.episodes["length"].astype(np.uint32)
        own: dict[str, NDArray[Any]] = {"length": lengths, "digest": digests(one)}
        rows.append(Table(ROWS, own))
    bins = Episodes.binned(made["force"])
    exact = {"force": made["force"]} if bins is None else {"bins": bins}
    pulls = Table(PULLED, {"bead": made["bead"], **exact})
    attributes = {
        "config": common.as_json(config),
        "states": states_digests(config),
        "rope": RopeConfig().fingerprint,
        "claimed": claimed,
    }
    attributes["digest"] = _digest(attributes, rows, [pulls])
    common.write_tables(path, [rows, pulls], attributes, format=FORMAT, version=VERSION, pack=True)


def read_entry(path: Path) -> Entry | None:
    """Read an entry; None if it isn't a file that says that it is one.

    Raises:
        InvalidFile: it is damaged, changed, incomplete, or made with other states or another rope.
    """
    if not (path.is_file() and common.format_of(path) == FORMAT):
        return None
    (rows, pulls), attributes = common.read_tables(
        path, ROWS, PULLED, format=FORMAT, version=VERSION
    )
    if attributes.pop("digest", None) != _digest(attributes, [rows], [pulls]):
        raise InvalidFile(f"{path}: its columns and attributes don't match its digest")
    raised = KnotgymError, LookupError, TypeError, ValueError
    with InvalidFile.instead(f"{path} has no valid configuration", *raised):
        config = common.from_json(EvaluateConfig, attributes["config"])
        states, claimed = states_digests(config), [dict(one) for one in attributes["claimed"]]
    if attributes.get("states") != states:
        raise InvalidFile(f"{path} was played from other states than {', '.join(states)} here")
    if unlike := RopeConfig().unlike(attributes.get("rope")):
        raise InvalidFile(f"{path} was played with {unlike}")
    if ("bins" in pulls) == ("force" in pulls):
        raise InvalidFile(f"{path} needs one column of forces: 'force' or 'bins'")
    if "bins" in pulls:
        forces = Episodes.unbinned(pulls["bins"])
        pulls = Table(PULLED, {"bead": pulls["bead"], "force": forces})
    wanted, count = len([*config.setups()]) * config.episodes, int(rows["length"].sum())
    if rows.rows != wanted or pulls.rows != count or len(claimed) * config.episodes != wanted:
        raise InvalidFile(
            f"{path} has {rows.rows} episodes and {pulls.rows} pulls, its configuration asks for"
            f" {wanted} episodes, which have {count}"
        )
    absent = pulls["bead"] >= config.task.beads
    wrong = np.flatnonzero(absent | ~(np.abs(pulls["force"]) <= 1).all(axis=1))
    if len(wrong):
        episode = int(np.searchsorted(np.cumsum(rows["length"]), wrong[0], side="right"))
        raise InvalidFile(
            f"{path}, episode {episode}: a pull is of a bead or with a force that doesn't exist"
        )
    return Entry(config, rows, pulls, claimed)


def _replayed(task: TaskConfig, seeds: list[int], rows: Table, pulls: Table) -> Kept:
    """Play episodes again; return their columns, and which aren't as recorded, bool (n,)."""
    lengths = rows["length"].astype(np.int64)
    made = replay(Episodes.to_repeat(lengths, pulls, "recorded"), task, seeds)
    wrong = (made.episodes["length"] != lengths) | (digests(made) != rows["digest"]).any(axis=1)
    return {**made._replace(steps=made.steps.only("bead")).columns(), "wrong": wrong}


def states_digests(config: EvaluateConfig) -> dict[str, str]:
    """The digests of the sets of states, by their names; own files have one name."""
    named = [name for _, _, name in common.Mark.fields(EvaluateConfig, config, "states")]
    return {
        str(name) if is_bundled(name) else "own": common.sha256(resolve_states(name))
        for name in named
    }


def _digest(attributes: dict[str, Any], rows: Sequence[Table], pulls: Sequence[Table]) -> str:
    text = json.dumps(attributes, sort_keys=True) + Table.digest(*rows) + Table.digest(*pulls)
    return hashlib.sha256(text.encode()).hexdigest()
