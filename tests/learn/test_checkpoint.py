"""Checkpoints are read whole or refused in one line, and nothing in them is run."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.atomic_files import sha256

pytestmark = pytest.mark.clients
pytest.importorskip("torch")
pytest.importorskip("safetensors")


def changed(learner: Path, tmp_path: Path, **card: object) -> Path:
    """Copy a checkpoint folder and change fields of its card."""
    copy = tmp_path / "copy"
    shutil.copytree(learner, copy)
    written = json.loads((copy / "policy.json").read_text())
    (copy / "policy.json").write_text(json.dumps({**written, **card}))
    return copy


def refusal(folder: Path) -> str:
    from knotgym.common.errors import InvalidFile
    from knotgym.learn.checkpoint import load_reader

    with pytest.raises(InvalidFile) as raised:
        load_reader(str(folder))
    return str(raised.value)


def test_a_learner_comes_back_as_it_was_kept(learner: Path) -> None:
    from knotgym.learn.checkpoint import load_reader

    one, other = load_reader(str(learner)), load_reader(str(learner))
    assert np.array_equal(one.starts, other.starts) and one.starts.shape == (3, 3)


def test_another_format_version_is_refused(learner: Path, tmp_path: Path) -> None:
    for k, version in enumerate((99, 2.0, "\x1b[2J")):
        said = refusal(changed(learner, tmp_path / str(k), format_version=version))
        assert f"format version {version!r}" in said and said.isprintable()


def test_another_format_is_refused(learner: Path, tmp_path: Path) -> None:
    assert "isn't of format knotgym-policy" in refusal(changed(learner, tmp_path, format="other"))


def test_weights_cut_short_are_refused(learner: Path, tmp_path: Path) -> None:
    copy = changed(learner, tmp_path)
    path = copy / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    assert "changed or truncated" in refusal(copy)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    assert "no learner at" in refusal(tmp_path)


def forged(learner: Path, tmp_path: Path, name: str, change: Callable[[Any], Any]) -> Path:
    """Copy a checkpoint, change a tensor, and put the new checksum on its card."""
    from safetensors.torch import load_file, save_file

    copy = changed(learner, tmp_path)
    path = copy / "weights.safetensors"
    tensors = load_file(path)
    save_file({**tensors, name: change(tensors[name])}, path)
    card = json.loads((copy / "policy.json").read_text())
    card = {**card, "weights_sha256": sha256(path)}
    (copy / "policy.json").write_text(json.dumps(card))
    return copy


def test_weights_that_are_not_finite_are_refused(learner: Path, tmp_path: Path) -> None:
    def spoilt(tensor: Any) -> Any:
        tensor[0] = float("nan")
        return tensor

    assert "places has numbers that aren't finite" in refusal(
        forged(learner, tmp_path, "places", spoilt)
    )


def test_weights_of_another_type_are_refused(learner: Path, tmp_path: Path) -> None:
    assert "places is float64 (3, 3), should be float32" in refusal(
        forged(learner, tmp_path, "places", lambda tensor: tensor.double())
    )


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
    from knotgym.common.errors import InvalidFile
    from knotgym.learn.clone_policy import load_clone

    huge = changed(clone, tmp_path, config={"width": 10**9, "layers": 10**9, "guided": False})
    assert len(load_clone(huge).network.norm.weight) == 16
    with pytest.raises(InvalidFile, match="don't make a clone"):
        load_clone(forged(clone, tmp_path / "forged", "codes.2.weight", lambda own: own[:8]))
