"""Digests of what episodes depend on: results and datasets hold them, and nothing is resumed or
counted together unless they are the same.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from knotgym.atomic_files import sha256
from knotgym.configuration import differences
from knotgym.control.policies import PolicyConfig, policy_digests
from knotgym.datasets.states import shipped, ships, states_file
from knotgym.episode_batch import SHIPPED, state_origins
from knotgym.runs.engine import whole_request
from knotgym.runs.run_options import InvalidRun
from knotgym.runs.shards import Shard
from knotgym.tasks import TaskConfig


def sources(policies: Iterable[PolicyConfig], tasks: Iterable[TaskConfig]) -> dict[str, Any]:
    """SHA-256 of the files that policies and tasks read.

    Returns:
        `states`: "own" or "shipped" -> digest of the state file;
        `policies`: name -> file -> digest, see `policy_digests`.

    Raises:
        InvalidPolicy, InvalidSetting, OSError: a file isn't there.
    """
    files = {}
    for task in tasks:
        for origin in state_origins(task).values():
            lent = origin == SHIPPED and not ships(task.states)  # plain loops, to a file without
            files[origin] = shipped() if lent else states_file(task.states)
    return {
        "states": {origin: sha256(path) for origin, path in sorted(files.items())},
        "policies": {one.policy: policy_digests(one) for one in policies},
    }


def digests(source: dict[str, Any]) -> dict[str, Any]:
    """What a result or a dataset holds: `sources`, with the `versions` of all code and the
    fingerprint of the `rope`.
    """
    whole = whole_request({"source": source}, Shard())
    told = {**source, "versions": whole["versions"], "rope": whole["rope"]}
    # in one order, so that a run and its merged shards are the same bytes
    ordered: dict[str, Any] = json.loads(json.dumps(told, sort_keys=True))
    return ordered


def require_unchanged(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse episodes whose policy or states changed while they were played.

    Raises:
        InvalidRun: so it is.
    """
    if before != now:
        told = "; ".join(differences(before, now))
        raise InvalidRun(f"files changed while episodes were played, begin again: {told}")
