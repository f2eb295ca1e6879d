"""Weights of the network that reads photos of rope: a folder as of other learners.

After a change run `pytest tests/learn/test_checkpoint.py`.
"""

from pathlib import Path
from typing import Any

from knotgym.learn.card import ROPE_READER, policy_folder
from knotgym.learn.checkpoint import load_network, save_network
from knotgym.photos import RopeReader, StrandNetwork


def load_rope_reader(name: str = ROPE_READER) -> RopeReader:
    """Load the weights of a reader of ropes: a folder, or ROPE_READER, which ships.

    Raises:
        InvalidFile: as in `load_network`.
    """
    return RopeReader(load_network(policy_folder(name), ROPE_READER, lambda _: StrandNetwork())[0])


def save_rope_reader(network: StrandNetwork, folder: Path, card: dict[str, Any]) -> None:
    """Write a folder that `load_rope_reader` reads; `card` adds how it was trained."""
    save_network(folder, network, ROPE_READER, card)
