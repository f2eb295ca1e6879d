"""Cards of learners, which can be read without torch."""

import hashlib
import json
from pathlib import Path
from typing import Any

from knotgym.common import InvalidFile, atomic_write, read_json

FORMAT, FORMAT_VERSION = "knotgym-policy", 3
CARD, WEIGHTS = "policy.json", "weights.safetensors"
PRETRAINED, ROPE_READER = "pretrained", "rope-reader"


def write_card(folder: Path, facts: dict[str, Any]) -> None:
    """Write `policy.json` of a learner's folder, with its format and digest."""
    card = {"format": FORMAT, "format_version": FORMAT_VERSION, **facts}
    with atomic_write(folder / CARD) as part:
        part.write_text(_card_text(card), encoding="utf-8")


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
    if (folder / CARD).read_bytes() != _card_text(card).encode():
        raise InvalidFile(f"{folder / CARD} doesn't match its own digest: it was changed")
    return card


def _card_text(card: dict[str, Any]) -> str:
    """Return a learner's card as its file has it; `digest` is the SHA-256 of all else."""
    fields = {name: value for name, value in card.items() if name != "digest"}
    digest = hashlib.sha256(json.dumps(fields).encode()).hexdigest()
    return json.dumps({**fields, "digest": digest}, indent=1) + "\n"
