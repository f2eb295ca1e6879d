"""Digests of the files that episodes depend on; results and datasets hold them.

Only runs with equal digests are resumed or pooled.
"""

from collections.abc import Iterable
from itertools import chain
from typing import Any

from knotgym.common import sha256
from knotgym.control import PolicyConfig, policy_digests
from knotgym.envs import SHIPPED, TaskConfig, task_sides
from knotgym.states import shipped, ships, states_file


def sources(policies: Iterable[PolicyConfig], tasks: Iterable[TaskConfig]) -> dict[str, Any]:
    """Return the SHA-256 of the files that policies and tasks read.

    Returns:
        `states`: "own" or "shipped" -> digest of the state file;
        `policies`: name -> file -> digest, see `policy_digests`.
    """
    files = {}
    for task in tasks:
        for side in chain.from_iterable(task_sides(task)):
            # a state file without plain loops borrows the included ones
            borrowed = side.origin == SHIPPED and not ships(task.states)
            files[side.origin] = shipped() if borrowed else states_file(task.states)
    return {
        "states": {origin: sha256(path) for origin, path in sorted(files.items())},
        "policies": {one.policy: policy_digests(one) for one in policies},
    }
