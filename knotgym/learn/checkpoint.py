"""A learner's folder: its weights and what made them, read without running anything in it.

policy.json             format, version, what it was trained on and how, checksum of the weights
weights.safetensors     reader/*    float16, the networks' weights
                        rope        float64 (105,), numbers of the rope's model
                        places      float32 (n, 3), metres, where ropes began
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.configuration import read_json
from knotgym.common.errors import KnotgymError
from knotgym.common.hdf5_files import require_regular
from knotgym.learn.reader import Reader
from knotgym.learn.rope_model import FIRST_GUESS

FORMAT, FORMAT_VERSION = "knotgym-policy", 1
CARD, WEIGHTS = "policy.json", "weights.safetensors"
PRETRAINED = "pretrained"  # the name of the folder that ships


class InvalidCheckpoint(KnotgymError, ValueError):
    """A folder that holds no learner this version can read."""


class Learned(NamedTuple):
    """All that was learned.

    Attributes:
        reader: pictures to vertices.
        rope: numbers of the rope's model, as `rope_model.FIRST_GUESS`.
        places: float32 (n, 3), metres, where the middles of ropes were at the start.
    """

    reader: Reader
    rope: NDArray[np.float64]
    places: NDArray[np.float32]


def save_policy(folder: Path, learned: Learned, made: dict[str, Any]) -> None:
    """Write a learner's folder; `made` says how it was made, for the card."""
    tensors = {
        f"reader/{name}": own.detach().to(torch.float16).contiguous()
        for name, own in learned.reader.state_dict().items()
    }
    tensors["rope"] = torch.from_numpy(learned.rope)
    tensors["places"] = torch.from_numpy(learned.places)
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
    """The folder of a learner by its path, or of the one that ships by its name."""
    if name == PRETRAINED:
        return Path(str(files("knotgym.learn") / "data" / PRETRAINED))
    return Path(name)


def load_policy(name: str) -> Learned:
    """Read a learner's folder.

    Raises:
        InvalidCheckpoint: there is none, it is of another version, or was changed or cut short.
    """
    folder = policy_folder(name)
    card = read_card(folder)
    try:
        require_regular(folder / WEIGHTS, "weights", InvalidCheckpoint)
        content = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise InvalidCheckpoint(f"{folder} has no {WEIGHTS} beside its {CARD}") from error
    if sha256(folder / WEIGHTS) != card.get("weights_sha256"):
        raise InvalidCheckpoint(
            f"{folder / WEIGHTS} isn't the file that {CARD} tells the checksum of: it was changed"
            " or cut short"
        )
    try:
        tensors = load(content)
        reader = Reader()
        reader.load_state_dict(
            {
                key.removeprefix("reader/"): own.float()
                for key, own in tensors.items()
                if key.startswith("reader/")
            }
        )
        rope, places = tensors["rope"].numpy(), tensors["places"].numpy()
    except (SafetensorError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise InvalidCheckpoint(
            f"{folder / WEIGHTS} holds no learner: {' '.join(str(error).split())[:200]}"
        ) from error
    if rope.shape != FIRST_GUESS.shape or places.ndim != 2 or places.shape[1:] != (3,):
        raise InvalidCheckpoint(f"{folder / WEIGHTS} holds arrays of another shape")
    if (rope.dtype, places.dtype) != (np.float64, np.float32):
        raise InvalidCheckpoint(
            f"{folder / WEIGHTS}: rope is {rope.dtype} and places {places.dtype}, should be float64"
            " and float32"
        )
    kinds = {own.dtype for key, own in tensors.items() if key.startswith("reader/")}
    if kinds != {torch.float16}:
        told = ", ".join(sorted(map(str, kinds)))
        raise InvalidCheckpoint(f"{folder / WEIGHTS}: the reader is {told}, should be float16")
    own = {"rope": torch.from_numpy(rope), "places": torch.from_numpy(places)}
    for name, values in {**own, **reader.state_dict()}.items():
        if not torch.isfinite(values).all():
            raise InvalidCheckpoint(f"{folder / WEIGHTS}: {name} has numbers that aren't finite")
    return Learned(reader.eval(), rope, places)


def read_card(folder: Path) -> dict[str, Any]:
    """What a learner's folder says of itself.

    Raises:
        InvalidCheckpoint: as `load_policy`.
    """
    try:
        card = read_json(folder / CARD)
    except (OSError, ValueError) as error:
        raise InvalidCheckpoint(
            f"no learner at {folder}: it needs a {CARD} that can be read; knotgym train makes one"
        ) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise InvalidCheckpoint(f"{folder / CARD} is no {FORMAT}; knotgym train makes one")
    version = card.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        raise InvalidCheckpoint(
            f"{folder / CARD} has format version {version!r}; this version of knotgym reads"
            f" {FORMAT_VERSION}: train again"
        )
    return card
