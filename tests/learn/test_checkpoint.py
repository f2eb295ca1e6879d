"""Checkpoints are read whole or refused in one line, and nothing in them is run."""

import os
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from knotgym.common import InvalidFile, sha256
from knotgym.control import PolicyConfig, make_policy
from knotgym.learn import clone_network
from knotgym.learn.checkpoint import load_reader
from knotgym.learn.clone_policy import load_clone
from knotgym.learn.learners import policy_folder

from .conftest import CLONE, put_card, train, weights

pytestmark = pytest.mark.clients


def put_weights(folder: Path, name: str, change: Callable[[Any], Any]) -> None:
    """Change a tensor, and put the new checksum on the card."""
    path = folder / "weights.safetensors"
    tensors = load_file(path)
    save_file({**tensors, name: change(tensors[name])}, path)
    put_card(folder, weights_sha256=sha256(path))


def put_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def change_a_byte(new: str, folder: Path) -> None:
    path = folder / "policy.json"
    path.write_text(path.read_text().replace('"parameters": ', new))


HARMS: list[tuple[str, Callable[[Path], Any]]] = [
    *((f"version {x!r}", partial(put_card, format_version=x)) for x in (99, 2.0, "\x1b[2J")),
    ("isn't of format knotgym-policy", partial(put_card, format="other")),
    ("doesn't match its own digest", partial(change_a_byte, '"parameters": 1')),
    ("no learner at", lambda folder: (folder / "policy.json").unlink()),
    ("no learner at", lambda folder: put_pipe(folder / "policy.json")),  # not waited for
    ("isn't a regular file", lambda folder: put_pipe(folder / "weights.safetensors")),
    (
        "changed or truncated",
        lambda folder: (folder / "weights.safetensors").write_bytes(weights(folder)[:-100]),
    ),
    ("aren't finite", lambda folder: put_weights(folder, "places", lambda own: own * np.nan)),
    ("is float64 (3, 3), ", lambda folder: put_weights(folder, "places", lambda own: own.double())),
]


@pytest.mark.parametrize(("says", "harm"), HARMS)
def test_a_harmed_checkpoint_is_refused(
    learner: Path, tmp_path: Path, says: str, harm: Callable[[Path], Any]
) -> None:
    harm(shutil.copytree(learner, tmp_path / "copy"))
    with pytest.raises(InvalidFile, match=re.escape(says)) as refused:
        load_reader(str(tmp_path / "copy"))
    assert str(refused.value).isprintable()


def test_a_clone_is_as_large_as_its_weights_say(clone: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(clone, tmp_path / "copy")
    put_card(copy, config={"width": 10**9, "layers": 10**9, "guided": False})
    assert len(load_clone(copy).network.norm.weight) == 16
    signatures: list[Any] = [[], [1.0], "x", None, [[1.0]], [float("nan")] * 36, {}]
    for signature in signatures:
        put_card(copy, signature=signature)
        with pytest.raises(InvalidFile, match="another network|this version's clone"):
            load_clone(copy)
    put_weights(copy, "codes.2.weight", lambda own: own[:8])
    with pytest.raises(InvalidFile, match="isn't of this version's clone"):
        load_clone(copy)


@pytest.mark.parametrize("change", ["another layer", "fewer heads", "another scale of inputs"])
def test_a_network_that_was_changed_refuses_the_weights_of_before(
    clone: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    begin, forward = clone_network.CloneNetwork.__init__, clone_network.CloneNetwork.forward

    def with_layer(own: Any, width: int, layers: int) -> None:
        begin(own, width, layers)
        own.more = nn.Linear(1, 1)

    def scaled(own: Any, states: clone_network.Inputs) -> clone_network.MarkedInputs:
        beads: Tensor = states.beads * 1.5
        return forward(own, states._replace(beads=beads))

    if change == "another scale of inputs":
        monkeypatch.setattr(clone_network.CloneNetwork, "forward", scaled)
    elif change == "fewer heads":
        monkeypatch.setattr(clone_network, "HEADS", 2)
    else:
        monkeypatch.setattr(clone_network.CloneNetwork, "__init__", with_layer)
    with pytest.raises(InvalidFile, match="another network|missing") as refused:
        load_clone(clone)
    assert str(refused.value).count("\n") == 0
    load_clone(train([data], tmp_path / "anew", CLONE))  # right, once it is trained again


def test_a_reader_of_ropes_is_no_policy() -> None:
    with pytest.raises(InvalidFile, match="is of 'rope-reader'; a policy is of pictures or clone"):
        make_policy(PolicyConfig(policy=str(policy_folder("rope-reader"))))
