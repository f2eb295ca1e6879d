"""Learners as policies: a folder that `knotgym train` wrote, or one that ships.

`knotgym.control.policies` finds this module through the entry point `learner`. It must stay light:
torch is imported when a policy is made, not when a name is checked.
"""

from pathlib import Path
from typing import Any

from knotgym.common import MissingExtra
from knotgym.control import PassValues, Policy, PolicyConfig, PolicyFamily
from knotgym.learn.card import CARD, CLONE, POLICIES, WEIGHTS, policy_folder, read_card


def _matches(name: str) -> bool:
    return name in POLICIES or (name != "" and Path(name).is_dir())


def _make(config: PolicyConfig) -> Policy:
    if _is_clone(config.policy):
        from knotgym.learn.clone_policy import load_clone

        return load_clone(policy_folder(config.policy))
    from knotgym.learn.agent import PicturePolicy

    return PicturePolicy(config.policy)


def _files(name: str) -> dict[str, Path]:
    is_clone = _is_clone(name)
    splits = ("train", "train-code") if is_clone else ("train",)
    tables = [PassValues.table(split, every_code=is_clone) for split in splits]
    counted = {path.name: path for path in tables if path.is_file()}
    return counted | {file: policy_folder(name) / file for file in (CARD, WEIGHTS)}


def _is_clone(name: str) -> bool:
    return _card(name).get("learner") == CLONE


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
