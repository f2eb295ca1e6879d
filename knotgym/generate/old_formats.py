"""Formats that earlier versions wrote: one function each reads entries and recordings of a suite.

Both hold pulls and digests of states, but no starts and no outcomes, which follow by playing.
"""

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from knotgym import common
from knotgym.common import Column, InvalidFile, KnotgymError, Schema, Table
from knotgym.datasets import PULLS, Episodes
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.rope import FORCE_BINS

OLD_ENTRY, OLD_RECORDINGS = "knotgym-entry", "knotgym-recordings"
_UNIT = f"max_force / {FORCE_BINS}"
_DIGEST = Column("digest", "uint8", (8,), unknown=0)


def old_entry(path: Path) -> tuple[Episodes, dict[str, Any]]:
    """Read an entry of the old format; return its episodes, and its attributes as they are now."""
    length = Column("length", "uint32", (), "pulls", least=1)
    bead, force = PULLS.only("bead", "force").columns
    bins = Column("bins", "int8", (3,), _UNIT, optional=True)
    schemas = (
        Schema("episodes", (length, _DIGEST)),
        Schema("steps", (bead, force._replace(optional=True), bins)),
    )
    (rows, pulls), said = common.read_tables(path, *schemas, format=OLD_ENTRY)
    whole = said.pop("digest", None)
    text = json.dumps(said, sort_keys=True) + rows.digest() + pulls.digest()
    if whole != hashlib.sha256(text.encode()).hexdigest():
        raise InvalidFile(f"{path}: its columns and attributes don't match its digest")
    if ("bins" in pulls) == ("force" in pulls):
        raise InvalidFile(f"{path} needs one column of forces: 'force' or 'bins'")
    forces = pulls["force"] if "force" in pulls else Episodes.unbinned(pulls["bins"])
    made = _episodes(path, rows, {"bead": pulls["bead"], "force": forces}, "recorded")
    with InvalidFile.instead(
        f"{path} has no valid configuration", *(KnotgymError, LookupError, TypeError, ValueError)
    ):
        config = common.from_json(EvaluateConfig, said["config"])
    tasks = [common.as_json(task) for _, task in config.setups()]
    setup = (np.arange(rows.rows) // config.episodes).astype(np.int16)
    return made.of_setup(setup), {**said, "claims": said.get("claimed"), "tasks": tasks}


def _episodes(path: Path, rows: Table, pulls: dict[str, Any], policy: str) -> Episodes:
    lengths = rows["length"].astype(np.int64)
    if lengths.sum() != len(pulls["bead"]):
        raise InvalidFile(f"{path}: its episodes don't fit its pulls")
    made = Episodes.to_repeat(lengths, pulls, policy)
    own = {**made.episodes, _DIGEST.name: rows[_DIGEST.name]}
    return made._replace(episodes=Table(made.episodes.schema.extended(_DIGEST), own))


@lru_cache(maxsize=2)
def old_recordings(path: Path) -> dict[str, tuple[dict[str, Any], Episodes]]:
    """Read a file of recordings: id of the dataset -> settings of its policy, and its episodes."""
    pulls = tuple(
        column._replace(
            dtype={"uint16": "uint8", "float32": "int8"}.get(column.dtype, column.dtype)
        )
        for column in PULLS.columns
        if column.name != "expert_action"
    )
    length = Column("length", "uint16", (), "pulls", least=1)
    force = pulls[1]._replace(unit=_UNIT)
    schemas = (
        Schema("episodes", (length, _DIGEST)),
        Schema("steps", (pulls[0], force, *pulls[2:])),
    )
    (rows, steps), said = common.read_tables(path, *schemas, format=OLD_RECORDINGS)
    bins = {"force": Episodes.unbinned(steps["force"])}
    known = {c.name: steps[c.name].astype(c.dtype) for c in PULLS.columns if c.name in steps}
    made = _episodes(path, rows, {**known, **bins}, "recorded")
    found, first = dict[str, tuple[dict[str, Any], Episodes]](), 0
    with InvalidFile.instead(f"{path}: its list of sets is damaged", LookupError, TypeError):
        for name, one in said["sets"].items():
            some = made.select(np.arange(first, first := first + one["episodes"]))
            policy = one["config"]["policy"]
            acted = np.full(some.episodes.rows, policy["policy"])
            found[name] = policy, some._replace(episodes=some.episodes.replaced(policy=acted))
    return found
