"""The format of entries that earlier versions wrote: pulls and digests of states, but no starts and
no outcomes, which follow by playing. Older recordings are upgraded as they are read.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from knotgym import common
from knotgym.common import Column, InvalidFile, KnotgymError, Schema, Table
from knotgym.datasets import PULLS, Episodes
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.rope import FORCE_BINS

OLD_ENTRY = "knotgym-entry"


def old_entry(path: Path) -> tuple[Episodes, dict[str, Any]]:
    """Read an entry of the old format; return its episodes, and its attributes as they are now."""
    length = Column("length", "uint32", (), "pulls", least=1)
    digest = Column("digest", "uint8", (8,), unknown=0)
    bead, force = PULLS.only("bead", "force").columns
    bins = Column("bins", "int8", (3,), f"max_force / {FORCE_BINS}", optional=True)
    schemas = (
        Schema("episodes", (length, digest)),
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
    lengths = rows["length"].astype(np.int64)
    if lengths.sum() != len(forces):
        raise InvalidFile(f"{path}: its episodes don't fit its pulls")
    made = Episodes.to_repeat(lengths, {"bead": pulls["bead"], "force": forces}, "recorded")
    columns = {**made.episodes, digest.name: rows[digest.name]}
    made = made._replace(episodes=Table(made.episodes.schema.extended(digest), columns))
    raised = KnotgymError, LookupError, TypeError, ValueError
    with InvalidFile.instead(f"{path} has no valid configuration", *raised):
        config = common.from_json(EvaluateConfig, said["config"])
    tasks = [common.as_json(task) for _, task in config.setups()]
    setup = (np.arange(rows.rows) // config.episodes).astype(np.int16)
    return made.of_setup(setup), {**said, "claims": said.get("claimed"), "tasks": tasks}
