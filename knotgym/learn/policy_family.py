"""Learners as policies: a folder that `knotgym train` wrote, or one that ships.

`knotgym.control.policies` finds this module through the entry point `learner`. It must stay light:
torch is imported when a policy is made, not when a name is checked.
"""

from pathlib import Path
from typing import Any

from knotgym.common import InvalidFile, MissingExtra
from knotgym.control import PassValues, Policy, PolicyConfig, PolicyFamily
from knotgym.learn.card import CARD, WEIGHTS, read_card
from knotgym.learn.learners import LEARNERS, POLICIES, Learner, policy_folder


def _matches(name: str) -> bool:
    return name in POLICIES or (name != "" and Path(name).is_dir())


def _make(config: PolicyConfig) -> Policy:
    learner = _learner(config.policy)
    return learner.loaded(learner.policy)(config.policy)


def _files(name: str) -> dict[str, Path]:
    learner = _learner(name)
    every_code = learner.every_code
    tables = [PassValues.table(split, every_code=every_code) for split in learner.splits]
    counted = {path.name: path for path in tables if path.is_file()}
    return counted | {file: policy_folder(name) / file for file in (CARD, WEIGHTS)}


def _learner(name: str) -> Learner:
    """Return what learner a folder is of.

    Raises:
        InvalidFile: it is of none of them, or has no card.
    """
    learner = _card(name).get("learner")
    if learner not in LEARNERS:
        raise InvalidFile(f"{name} is of {learner!r}; a policy is of {' or '.join(LEARNERS)}")
    return LEARNERS[learner]


def _card(name: str) -> dict[str, Any]:
    for library in ("torch", "safetensors"):
        MissingExtra.imported(library, "learn", f"the learner {name}")
    return read_card(policy_folder(name))


FAMILY = PolicyFamily(
    form="pretrained, pretrained-clone, a learner's folder",
    matches=_matches,
    make=_make,
    files=_files,
    card=_card,
)
