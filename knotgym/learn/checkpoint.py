"""Checkpoint folders of learners; reading one never runs code from it.

policy.json             format, version, training data and configuration, checksum of the weights
weights.safetensors     a reader's: reader/*  float16, the networks' weights
                                    places    float32 (n, 3), start positions of ropes, metres
                        a clone's:            float16, the network's weights
"""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from knotgym.common import InvalidFile, atomic_write, one_line, read_json, require_regular, sha256
from knotgym.learn.reader import Reader

FORMAT, FORMAT_VERSION = "knotgym-policy", 1
CARD, WEIGHTS = "policy.json", "weights.safetensors"
PRETRAINED, PRETRAINED_CLONE = "pretrained", "pretrained-clone"
ROPE_READER = "rope-reader"
# names of the checkpoints that ship with the package
SHIPPED = (PRETRAINED, PRETRAINED_CLONE, ROPE_READER)


class Learned(NamedTuple):
    """A trained learner from pictures.

    Attributes:
        reader: network from pictures to vertices.
        starts: float32 (n, 3), middles of ropes at the start of training episodes, metres.
    """

    reader: Reader
    starts: NDArray[np.float32]


def policy_folder(name: str) -> Path:
    """Return the folder of a checkpoint: a path, or the name of one that ships."""
    if name in SHIPPED:
        return Path(str(files("knotgym.learn") / "data" / name))
    return Path(name)


def save_reader(folder: Path, learned: Learned, card: dict[str, Any]) -> None:
    """Write a checkpoint folder; `card` adds how it was trained."""
    tensors = {
        f"reader/{name}": own.detach().to(torch.float16).contiguous()
        for name, own in learned.reader.state_dict().items()
    }
    tensors["places"] = torch.from_numpy(learned.starts)
    write_checkpoint(folder, tensors, card)


def load_reader(name: str) -> Learned:
    """Load the checkpoint of a learner from pictures: a path, or PRETRAINED.

    Raises:
        InvalidFile: it is missing, of another version, changed or truncated.
    """
    folder = policy_folder(name)
    tensors = read_weights(folder)
    try:
        starts, reader = tensors.pop("places").numpy(), Reader()
        reader.load_state_dict(
            {name.removeprefix("reader/"): own.float() for name, own in tensors.items()}
        )
        if starts.ndim != 2 or starts.shape[1:] != (3,) or starts.dtype != np.float32:
            raise ValueError(f"places is {starts.dtype} {starts.shape}, should be float32 (n, 3)")
        if not len(starts):
            raise ValueError("places has no positions")
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise InvalidFile(
            f"{folder / WEIGHTS} isn't a learner from pictures: {one_line(error)[:200]}"
        ) from error
    return Learned(reader.eval(), starts)


def write_checkpoint(folder: Path, tensors: dict[str, Tensor], card: dict[str, Any]) -> None:
    """Write weights, and a card with their checksum and what `card` adds."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / WEIGHTS) as part:
        part.write_bytes(save(tensors))
    whole = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "weights_sha256": sha256(folder / WEIGHTS),
        **card,
    }
    with atomic_write(folder / CARD) as part:
        part.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


def read_weights(folder: Path) -> dict[str, Tensor]:
    """Read the weights of a checkpoint folder, all of them finite.

    Raises:
        InvalidFile: as in `load_reader`.
    """
    card, path = read_card(folder), folder / WEIGHTS
    try:
        require_regular(path, "weights", InvalidFile)
        content = path.read_bytes()
    except OSError as error:
        raise InvalidFile(f"{folder} has no {WEIGHTS} beside its {CARD}") from error
    if sha256(path) != card.get("weights_sha256"):
        raise InvalidFile(
            f"{path} doesn't match the checksum in {CARD}: it was changed or truncated"
        )
    try:
        tensors: dict[str, Tensor] = load(content)
    except (SafetensorError, ValueError) as error:
        raise InvalidFile(f"{path} isn't a learner: {one_line(error)[:200]}") from error
    for name, own in tensors.items():
        if not (own.is_floating_point() and torch.isfinite(own).all()):
            raise InvalidFile(f"{path}: {name} has numbers that aren't finite")
    return tensors


def read_card(folder: Path) -> dict[str, Any]:
    """Read a checkpoint's card, `policy.json`.

    Raises:
        InvalidFile: as in `load_reader`.
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
    return card
