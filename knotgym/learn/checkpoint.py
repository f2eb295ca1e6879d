"""Folders of learners; reading one never runs code from it.

policy.json             format, version, what was trained and how, checksum of the weights, what the
                        network returned for fixed inputs, and a digest of all this
weights.safetensors     the network's weights, float16; a reader's also
                        places    float32 (n, 3), start positions of ropes, metres

A network whose code has changed since may still take the old weights and act otherwise. So a
network says by `signature` what it returns for inputs that are always the same; a folder in which
another signature stands is refused.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from knotgym.common import Array, InvalidFile, atomic_write, one_line, require_regular, sha256
from knotgym.learn.card import CARD, WEIGHTS, read_card, write_card
from knotgym.learn.learners import PICTURES, policy_folder
from knotgym.learn.reader import Reader
from knotgym.photos import inference

# By which numbers of a signature, of order 1 to 20, may be off: a machine's float32 rounding moves
# them by less than 1e-5; two attention heads for four move an untrained clone's by 0.1.
_OFF = 2e-4


class Learned(NamedTuple):
    """A trained learner from pictures.

    Attributes:
        reader: network from pictures to vertices.
        starts: float64 (n, 3), middles of ropes at the start of training episodes, metres.
    """

    reader: Reader
    starts: Array


def save_network(
    folder: Path,
    network: nn.Module,
    learner: str,
    card: dict[str, Any],
    others: dict[str, Tensor] | None = None,
) -> None:
    """Write a learner's folder; the network gets the weights as they are kept, float16.

    Args:
        folder: created where it is missing.
        network: on the CPU; its `signature` returns numbers that depend on all parts of it, for
            inputs made by itself.
        learner: what it is part of: PICTURES, CLONE or ROPE_READER.
        card: how it was trained.
        others: tensors that belong to the learner beside the network's.
    """
    kept = {
        name: tensor.detach().half().contiguous()
        for name, tensor in network.state_dict().items()
        if tensor.is_floating_point()
    }
    network.load_state_dict({name: tensor.float() for name, tensor in kept.items()}, strict=False)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / WEIGHTS) as part:
        part.write_bytes(save({**kept, **(others or {})}))
    facts = {
        "weights_sha256": sha256(folder / WEIGHTS),
        "learner": learner,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "signature": _signature(network),
    }
    write_card(folder, {**facts, **card})


def load_network(
    folder: Path,
    learner: str,
    make: Callable[[dict[str, Tensor]], Any],
    others: tuple[str, ...] = (),
) -> tuple[Any, dict[str, Tensor]]:
    """Load a learner's network, in evaluation mode, and the tensors beside it.

    Args:
        folder: of the learner.
        learner: what it must be.
        make: from the weights to a network of their size.
        others: names of the tensors beside it.

    Raises:
        InvalidFile: the folder is missing, of another version or learner, changed or truncated, or
            this version's network isn't the one that was trained.
    """
    card, path = read_card(folder), folder / WEIGHTS
    if card.get("learner") != learner:
        raise InvalidFile(f"{folder} isn't of learner {learner} but of {card.get('learner')!r}")
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
        for name, tensor in tensors.items():
            if not (tensor.is_floating_point() and torch.isfinite(tensor).all()):
                raise ValueError(f"{name} has numbers that aren't finite")
        beside = {name: tensors.pop(name) for name in others}
        network = make(tensors)
        weights = {name: tensor.float() for name, tensor in tensors.items()}
        missing, unknown = network.load_state_dict(weights, strict=False)
        missing = [name for name in missing if not name.endswith("num_batches_tracked")]
        if missing or unknown:
            raise ValueError(f"missing {missing[:3]}, unknown {unknown[:3]}")
        made, given = _signature(network.eval()), np.array(card.get("signature"), np.float64)
    except (ArithmeticError, LookupError, RuntimeError, SafetensorError, TypeError, ValueError,
            AssertionError) as error:  # fmt: skip
        raise InvalidFile(
            f"{path} isn't of this version's {learner}: {one_line(error)[:200]}"
        ) from error
    alike = given.shape == np.shape(made) and np.allclose(given, made, _OFF, _OFF)
    if not alike:
        raise InvalidFile(
            f"{folder} was trained with another network than that of this version of knotgym, in"
            " which its weights would act otherwise: train again, or use the version on its card"
        )
    return network, beside


def _signature(network: nn.Module) -> list[float]:
    with inference():
        return [float(f"{number:.6g}") for number in network.signature().flatten().tolist()]


def load_reader(name: str) -> Learned:
    """Load a learner from pictures: a path, or PRETRAINED.

    Raises:
        InvalidFile: as in `load_network`.
    """
    folder = policy_folder(name)
    reader, beside = load_network(folder, PICTURES, lambda _: Reader(), ("places",))
    starts = beside["places"].numpy()
    if starts.ndim != 2 or starts.shape[1:] != (3,) or starts.dtype != np.float32:
        said = f"is {starts.dtype} {starts.shape}, should be float32 (n, 3)"
        raise InvalidFile(f"{folder / WEIGHTS}: places {said}")
    if not len(starts):
        raise InvalidFile(f"{folder / WEIGHTS}: places has no positions")
    return Learned(reader, starts.astype(np.float64))
