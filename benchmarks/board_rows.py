"""The rows of the board: what an entry scored, or why it has no place there.

What others wrote is text, never a key or markup; policies of the package are played again; and what
was counted before stands in a ledger, by the digest of the entry.
"""

import hashlib
import html
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import one_line, sha256
from knotgym.control import PolicyConfig
from knotgym.datasets import Episodes
from knotgym.generate import PROTOCOLS, read_entry

LONGEST = 40  # characters of a learner's name
SHARED = 0.25  # of the episodes of a cell that two entries may have in common
# policies of the package that are played again, and whether they see nothing of the goal but its
# code, so that they stand in every protocol's table
BUILT_IN = {"random": True, "scripted": True, "expert": True, "matching": False}
UNLEARNED = ("random", "random macro-actions", "scripted", "matching")
# The expert searches for minutes: its pulls are known by their digests.
SEARCHED = {
    "b4854e2ddeb85f387422bce3af30b60fd210c2c36628804060f272dd0ece6fc3",  # tie 2, 256 episodes
    "f593b9a13b573ef1f8e4d37c4d7ae57cc93a36121d560033435a837123d7dd9e",  # tie 3
    "6ef78a7e2d5f3993957c8f56e9b418fe73037a0f9dbe7b352e1e2e02131921f2",  # convert 2
    "32bc2fab621cbf3645f5b0614dace2949e12ecdc2b125e58e2f4da7331ccf5b5",  # convert 3
    "05a09d55f7eb034d4e81bf570899c5e86f48d742f8523cbb977ca3db081c0df7",  # unknot 2
}
Ints = NDArray[np.int64]


class Refused(Exception):
    """An entry that has no place on the board, in one line."""


class Row(NamedTuple):
    """What an entry scored in one cell.

    Attributes:
        source: name of its file, without the seed and the suffix.
        learner: how it is called, escaped; never a key without `source`.
        tier: of the sets that it says it learned from.
        protocols: in whose tables it stands.
        engine, task, nx, action: of its episodes; the policy acts in `action`.
        seed: of the training, as claimed.
        start, goal, success: of each episode, int64.
    """

    source: str
    learner: str
    tier: str
    protocols: tuple[str, ...]
    engine: str
    task: str
    nx: int
    action: str
    seed: str
    start: Ints
    goal: Ints
    success: Ints

    @property
    def cell(self) -> tuple[str, str, int]:
        """The cell, but for the protocol."""
        return self.engine, self.task, self.nx

    @property
    def who(self) -> tuple[str, ...]:
        """Whose row it is, in any cell; several seeds of one are averaged."""
        family = re.sub(r"^[a-z]+-nx\d(-\d)?-", "", self.source)
        return family, self.learner, self.tier, self.action

    @property
    def rate(self) -> float:
        return float(self.success.mean())


def text(said: object) -> str:
    """What somebody wrote, as text of a Markdown table: one line, no markup."""
    line = html.escape(one_line(str(said))[:LONGEST], quote=False)
    return re.sub(r"([\\`*_{}\[\]()#+!|~$^:@])", r"\\\1", line)


def rows_of(path: Path, ledger: dict[str, Any], replay: bool) -> Iterator[tuple[Row, list[bytes]]]:
    """Yield the rows of an entry, and the digests of each one's episodes.

    Args:
        path: of the entry.
        ledger: what was counted before; what is counted now is added.
        replay: whether to play the pulls again although the ledger has them.

    Raises:
        Refused: it has no protocol, other rules than its own, or doesn't replay.
    """
    entry = read_entry(path)
    if entry is None:
        raise Refused("isn't an entry")
    config, digest = entry.config, sha256(path)
    if config.protocol not in PROTOCOLS:
        unlike = ", ".join(config.differences("code")) or "all of its settings, but isn't named"
        raise Refused(f"names no protocol; --protocol code has {unlike}")
    known = ledger["entries"].get(path.name, {})
    if known.get("sha256") != digest or replay:
        counted = []
        for result, faults in entry.recounted():
            if faults:
                raise Refused(faults[0])
            counted.append("".join(map(str, result.outcomes["success"])))
            cell = ledger["episodes"].setdefault(f"{result.task} {result.nx}", [[], []])
            for own, name in zip(cell, ("start", "goal"), strict=True):
                own[:] = max(own, [*result.outcomes[name]], key=len)
        if known.get("sha256") == digest and known["success"] != counted:
            raise Refused("doesn't score what the ledger says")
        ledger["entries"][path.name] = known = {"sha256": digest, "success": counted}
        for policy, played in zip((one for one, _ in config.setups()), entry.setups, strict=True):
            _require_own(policy, played)
    digests = [[bytes(one) for one in played.episodes["digest"]] for played in entry.setups]
    setups = zip(config.setups(), entry.claimed, known["success"], strict=True)
    for number, ((policy, task), claimed, success) in enumerate(setups):
        training, name = claimed.get("training"), policy.policy
        if not isinstance(training, dict):
            raise Refused("claims a training that isn't an object")
        seen = str(claimed.get("observation"))
        if name not in BUILT_IN and not config.shows(config.protocol, seen):
            shown = one_line(seen)
            raise Refused(f"observes {shown}, which protocol {config.protocol} doesn't show")
        built_in = name in BUILT_IN
        action = task.action if built_in else training.get("action", claimed.get("action"))
        (nx,), (named,), count = task.crossings, task.tasks, config.episodes
        starts, goals = (own[:count] for own in ledger["episodes"][f"{named} {nx}"])
        row = Row(
            re.sub(r"-seed\d+$", "", path.stem),
            name + " macro-actions" * (action == "macro")
            if built_in
            else _claimed(training.get("learner", name)),
            _tier(training.get("data")),
            tuple(PROTOCOLS) if BUILT_IN.get(name) else (config.protocol,),
            *(task.engine, named, nx, text(action), text(training.get("seed", ""))),
            *(np.array([*map(int, one)]) for one in (starts, goals, success)),
        )
        yield row, digests[number]


def _claimed(learner: object) -> str:
    """How a policy that isn't the package's own is called."""
    return text(learner) + " (claimed)" * (learner in (*UNLEARNED, *BUILT_IN))


def _tier(data: object) -> str:
    """The policies and sizes of the suite's tiers that a training says it read."""
    joined = " ".join(data) if isinstance(data, dict) else ""
    names = re.findall(r"/([a-z]+)-[-a-z]*?(\d+[kM])(?:-seed\d+)?-v0", joined)
    return ", ".join(sorted({f"{policy} {size}" for policy, size in names}))


def _require_own(policy: PolicyConfig, played: Episodes) -> None:
    """Refuse pulls that go by the name of a policy of the package and aren't its own.

    What doesn't search was played again when the entry was recounted.
    """
    name = policy.policy
    if name in BUILT_IN and policy != PolicyConfig(policy=name):
        raise Refused(f"plays {name} with other settings than its own")
    if name in BUILT_IN and policy.plans:
        pulls = played.pulls()
        columns = played.episodes["length"].astype(np.int64), pulls["bead"], pulls["force"]
        digest = hashlib.sha256(b"".join(one.tobytes() for one in columns)).hexdigest()
        if digest not in SEARCHED:
            raise Refused(f"isn't a known run of {name}: its digest is {digest}")


def require_apart(rows: Sequence[tuple[Row, list[bytes]]], first: int) -> None:
    """Refuse rows from the `first` on that share episodes with others, or aren't other seeds."""
    for k, (row, digests) in enumerate(rows[first:], first):
        for other, earlier in rows[:k]:
            where = f"{row.learner}, {row.task} nx {row.nx}"
            if row.cell != other.cell:
                continue
            if len({*digests} & {*earlier}) > SHARED * min(len(digests), len(earlier)):
                raise Refused(
                    f"two entries of {where}, hold the same episodes: {other.source}, {row.source}"
                )
            if row.who == other.who and row.seed == other.seed:
                raise Refused(f"two entries of {where}, are of one seed: {other.source}")
            if row.who == other.who and len(row.success) != len(other.success):
                raise Refused(
                    f"two entries of {where}, have other numbers of episodes: {row.source}"
                )
