"""Checkpoints are read whole or refused in one line, and nothing in them is run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from knotgym.common import sha256

from .conftest import CLONE as CONFIG
from .conftest import put_card, train

pytestmark = pytest.mark.clients
pytest.importorskip("torch")
pytest.importorskip("safetensors")


def changed(learner: Path, tmp_path: Path, **card: object) -> Path:
    """Copy a checkpoint folder and change fields of its card, and its digest."""
    copy = tmp_path / "copy"
    shutil.copytree(learner, copy)
    put_card(copy, **card)
    return copy


def refusal(folder: Path) -> str:
    from knotgym.common import InvalidFile
    from knotgym.learn.checkpoint import load_reader

    with pytest.raises(InvalidFile) as raised:
        load_reader(str(folder))
    return str(raised.value)


@pytest.mark.parametrize(
    ("card", "says"),
    [
        *(({"format_version": one}, f"format version {one!r}") for one in (99, 2.0, "\x1b[2J")),
        ({"format": "other"}, "isn't of format knotgym-policy"),
    ],
)
def test_cards_of_other_formats_are_refused(
    learner: Path, tmp_path: Path, card: dict[str, object], says: str
) -> None:
    said = refusal(changed(learner, tmp_path, **card))
    assert says in said and said.isprintable()


@pytest.mark.parametrize(
    ("old", "new"), [('"parameters": ', '"parameters": 1'), ('"parameters": ', '"parameters":\t')]
)
def test_a_card_of_which_a_byte_was_changed_is_refused(
    learner: Path, tmp_path: Path, old: str, new: str
) -> None:
    path = changed(learner, tmp_path) / "policy.json"
    path.write_text(path.read_text().replace(old, new))
    assert "doesn't match its own digest" in refusal(path.parent)


def test_missing_weights_and_weights_cut_short_are_refused(learner: Path, tmp_path: Path) -> None:
    assert "no learner at" in refusal(tmp_path)
    path = changed(learner, tmp_path) / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    assert "changed or truncated" in refusal(path.parent)


def forged(learner: Path, tmp_path: Path, name: str, change: Callable[[Any], Any]) -> Path:
    """Copy a checkpoint, change a tensor, and put the new checksum on its card."""
    from safetensors.torch import load_file, save_file

    copy = changed(learner, tmp_path)
    path = copy / "weights.safetensors"
    tensors = load_file(path)
    save_file({**tensors, name: change(tensors[name])}, path)
    put_card(copy, weights_sha256=sha256(path))
    return copy


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda tensor: tensor * float("nan"), "places has numbers that aren't finite"),
        (lambda tensor: tensor.double(), "places is float64 (3, 3), should be float32"),
    ],
)
def test_other_weights_are_refused(
    learner: Path, tmp_path: Path, change: Callable[[Any], Any], says: str
) -> None:
    assert says in refusal(forged(learner, tmp_path, "places", change))


def test_a_pipe_is_not_waited_for(learner: Path, tmp_path: Path) -> None:
    for name in ("weights.safetensors", "policy.json"):
        folder = tmp_path / name
        folder.mkdir()
        copy = changed(learner, folder)
        (copy / name).unlink()
        os.mkfifo(copy / name)
        assert refusal(copy).isprintable()


def test_a_clone_is_as_large_as_its_weights_whatever_its_card_says(
    clone: Path, tmp_path: Path
) -> None:
    from knotgym.common import InvalidFile
    from knotgym.learn.clone_policy import load_clone

    huge = changed(clone, tmp_path, config={"width": 10**9, "layers": 10**9, "guided": False})
    assert len(load_clone(huge).network.norm.weight) == 16
    with pytest.raises(InvalidFile, match="isn't of this version's clone"):
        load_clone(forged(clone, tmp_path / "forged", "codes.2.weight", lambda own: own[:8]))


@pytest.mark.parametrize("change", ["another layer", "fewer heads", "another scale of inputs"])
def test_a_network_that_was_changed_refuses_the_weights_of_before(
    clone: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    from torch import Tensor, nn

    from knotgym.common import InvalidFile
    from knotgym.learn import clone_network
    from knotgym.learn.clone_policy import load_clone

    begin, forward = clone_network.CloneNetwork.__init__, clone_network.CloneNetwork.forward

    def with_layer(own: Any, width: int, layers: int) -> None:
        begin(own, width, layers)
        own.more = nn.Linear(1, 1)

    def with_heads(own: Any, width: int, layers: int) -> None:
        begin(own, width, layers, heads=2)

    def scaled(own: Any, states: clone_network.Inputs) -> clone_network.MarkedInputs:
        beads: Tensor = states.beads * 1.5
        return forward(own, states._replace(beads=beads))

    if change == "another scale of inputs":
        monkeypatch.setattr(clone_network.CloneNetwork, "forward", scaled)
    else:
        wanted = with_layer if change == "another layer" else with_heads
        monkeypatch.setattr(clone_network.CloneNetwork, "__init__", wanted)
    with pytest.raises(InvalidFile, match="another network|missing") as refused:
        load_clone(clone)
    assert str(refused.value).count("\n") == 0
    load_clone(train([data], tmp_path / "anew", CONFIG))  # right, once it is trained again


@pytest.mark.parametrize("signature", [[], [1.0], "x", None, [[1.0]], [float("nan")] * 36, {}])
def test_a_forged_signature_is_refused(clone: Path, tmp_path: Path, signature: Any) -> None:
    from knotgym.common import InvalidFile
    from knotgym.learn.clone_policy import load_clone

    with pytest.raises(InvalidFile, match="another network|this version's clone"):
        load_clone(changed(clone, tmp_path, signature=signature))


def test_a_reader_of_ropes_is_no_policy(tmp_path: Path) -> None:
    from knotgym.control import PolicyConfig, make_policy
    from knotgym.learn.card import policy_folder

    with pytest.raises(Exception, match="isn't of learner pictures but of 'rope-reader'"):
        make_policy(PolicyConfig(policy=str(policy_folder("rope-reader"))))
