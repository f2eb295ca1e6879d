"""Checkpoint folders of the learner; reading one never runs code from it.

policy.json             format, version, training data and configuration, checksum of the weights
weights.safetensors     reader/*    float16, the networks' weights
                        places      float32 (n, 3), start positions of the training episodes, metres
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

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.configuration import read_json
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import require_regular
from knotgym.learn.reader import Reader

FORMAT, FORMAT_VERSION = "knotgym-policy", 1
CARD, WEIGHTS = "policy.json", "weights.safetensors"
PRETRAINED, PRETRAINED_CLONE = "pretrained", "pretrained-clone"
SHIPPED = (PRETRAINED, PRETRAINED_CLONE)  # names of the checkpoints that ship with the package


class Learned(NamedTuple):
    """A trained learner.

    Attributes:
        reader: network from pictures to vertices.
        starts: float32 (n, 3), middles of ropes at the start of training episodes, metres.
    """

    reader: Reader
    starts: NDArray[np.float32]


def save_policy(folder: Path, learned: Learned, made: dict[str, Any]) -> None:
    """Write a checkpoint folder; `made` adds to its card how it was trained."""
    tensors = {
        f"reader/{name}": own.detach().to(torch.float16).contiguous()
        for name, own in learned.reader.state_dict().items()
    }
    tensors["places"] = torch.from_numpy(learned.starts)
    write_checkpoint(folder, tensors, made)


def write_checkpoint(folder: Path, tensors: dict[str, Tensor], made: dict[str, Any]) -> None:
    """Write weights and a card with their checksum; `made` adds to the card."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / WEIGHTS) as part:
        part.write_bytes(save(tensors))
    card = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "weights_sha256": sha256(folder / WEIGHTS),
        **made,
    }
    with atomic_write(folder / CARD) as part:
        part.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def policy_folder(name: str) -> Path:
    """Return the folder of a checkpoint: a path, or the name of one that ships."""
    if name in SHIPPED:
        return Path(str(files("knotgym.learn") / "data" / name))
    return Path(name)


def load_policy(name: str) -> Learned:
    """Load a checkpoint: a path, or PRETRAINED for the one that ships.

    Raises:
        InvalidFile: it is missing, of another version, changed or truncated.
    """
    folder = policy_folder(name)
    tensors = read_weights(folder)
    try:
        reader = Reader()
        reader.load_state_dict(
            {
                key.removeprefix("reader/"): own.float()
                for key, own in tensors.items()
                if key.startswith("reader/")
            }
        )
        starts = tensors["places"].numpy()
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise InvalidFile(
            f"{folder / WEIGHTS} isn't a learner: {' '.join(str(error).split())[:200]}"
        ) from error
    if starts.ndim != 2 or starts.shape[1:] != (3,) or starts.dtype != np.float32:
        raise InvalidFile(
            f"{folder / WEIGHTS}: places is {starts.dtype} {starts.shape}, should be float32 (n, 3)"
        )
    kinds = {own.dtype for key, own in tensors.items() if key.startswith("reader/")}
    if kinds != {torch.float16}:
        found = ", ".join(sorted(map(str, kinds)))
        raise InvalidFile(f"{folder / WEIGHTS}: the reader is {found}, should be float16")
    for name, values in {"places": tensors["places"], **reader.state_dict()}.items():
        if not torch.isfinite(values).all():
            raise InvalidFile(f"{folder / WEIGHTS}: {name} has numbers that aren't finite")
    return Learned(reader.eval(), starts)


def read_weights(folder: Path) -> dict[str, Tensor]:
    """Read the weights of a checkpoint folder; raise InvalidFile as in `load_policy`."""
    card = read_card(folder)
    try:
        require_regular(folder / WEIGHTS, "weights", InvalidFile)
        content = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise InvalidFile(f"{folder} has no {WEIGHTS} beside its {CARD}") from error
    if sha256(folder / WEIGHTS) != card.get("weights_sha256"):
        raise InvalidFile(
            f"{folder / WEIGHTS} doesn't match the checksum in {CARD}: it was changed or truncated"
        )
    try:
        return load(content)
    except (SafetensorError, ValueError) as error:
        raise InvalidFile(
            f"{folder / WEIGHTS} isn't a learner: {' '.join(str(error).split())[:200]}"
        ) from error


def read_card(folder: Path) -> dict[str, Any]:
    """Read a checkpoint's card, `policy.json`.

    Raises:
        InvalidFile: as in `load_policy`.
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
