"""Learners as policies: a folder that `knotgym train` wrote, or one that ships, and its card.

`knotgym.control.policies` finds this module through the entry point `learner`. It must stay light:
torch is imported when a policy is made, not when a name is checked.
"""

import hashlib
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from knotgym.common import InvalidFile, MissingExtra, atomic_write, read_json
from knotgym.control import PassValues, Policy, PolicyConfig, PolicyFamily

FORMAT, FORMAT_VERSION = "knotgym-policy", 3
CARD, WEIGHTS = "policy.json", "weights.safetensors"
PRETRAINED, ROPE_READER = "pretrained", "rope-reader"
# names of the folders that ship with the package
_POLICIES = (PRETRAINED, "pretrained-clone")
_SHIPPED = (*_POLICIES, ROPE_READER)
PICTURES, CLONE = "pictures", "clone"  # learners, beside ROPE_READER


def policy_folder(name: str) -> Path:
    """Return the folder of a learner: a path, or the name of one that ships."""
    if name in _SHIPPED:
        return Path(str(files("knotgym.learn") / "data" / name))
    return Path(name)


def write_card(folder: Path, facts: dict[str, Any]) -> None:
    """Write `policy.json` of a learner's folder, with its format and digest."""
    card = {"format": FORMAT, "format_version": FORMAT_VERSION, **facts}
    card["digest"] = _card_digest(card)
    with atomic_write(folder / CARD) as part:
        part.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def read_card(folder: Path) -> dict[str, Any]:
    """Read `policy.json` of a learner's folder.

    Raises:
        InvalidFile: it is missing, changed, or of another version.
    """
    try:
        card = read_json(folder / CARD)
    except (OSError, ValueError) as error:
        raise InvalidFile(
            f"no learner at {folder}: it needs a readable {CARD}; knotgym train makes one"
        ) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise InvalidFile(f"{folder / CARD} isn't of format {FORMAT}; knotgym train makes one")
    version = card.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        raise InvalidFile(
            f"{folder / CARD} has format version {version!r}; this version of knotgym reads"
            f" {FORMAT_VERSION}: train again"
        )
    if card.get("digest") != _card_digest(card):
        raise InvalidFile(f"{folder / CARD} doesn't match its own digest: it was changed")
    return card


def _card_digest(card: dict[str, Any]) -> str:
    """Return the SHA-256 of a learner's card without its `digest`."""
    fields = {name: value for name, value in card.items() if name != "digest"}
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _matches(name: str) -> bool:
    return name in _POLICIES or (name != "" and Path(name).is_dir())


def _make(config: PolicyConfig) -> Policy:
    if _is_clone(config.policy):
        from knotgym.learn.clone_policy import load_clone

        return load_clone(policy_folder(config.policy))
    from knotgym.learn.agent import load_picture_policy

    return load_picture_policy(config.policy)


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
