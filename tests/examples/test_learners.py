"""Learners and recipes of docs/recipes.md train and are evaluated; needs -m clients."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import TINY

from knotgym.control import PassValues
from knotgym.datasets import MinariMetadata, open_episodes, publish

from ..scripts import ROOT, run_script
from ..small_job import knotgym

FOLDER = ROOT / "examples" / "learners"
PAGE = (ROOT / "docs/recipes.md").read_text(encoding="utf-8")
ID = "knotgym/tie-nx2/varied-bench-v0"
pytestmark = pytest.mark.clients


@pytest.fixture
def room(tmp_path: Path, monkeypatch: Patch) -> Path:
    """Enter a folder whose Minari root has a few of the expert's episodes under the recipes' id."""
    tiny = open_episodes(TINY["expert"])
    metadata = MinariMetadata(dataset_id=ID, algorithm_name="noisy", description="Few.")
    publish([tiny.episodes], tiny.task, metadata, tmp_path / "minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def check_plays(policy: str, monkeypatch: Patch) -> None:
    """Evaluate a policy as the page does, and check that its rate is written."""
    monkeypatch.delitem(sys.modules, policy, raising=False)
    task = ("--task", "tie", "--nx", 2, "--states", "bench", "--engine", "chain")
    words = ("--policy", f"{policy}:act", *task, "--episodes", 2, "--out", "scores.json")
    assert knotgym("evaluate", *words, "--workers", 1, "--quiet") == 0
    assert json.loads(Path("scores.json").read_text())["episodes"] == 2


def recipes() -> dict[str, tuple[str, str]]:
    """Return the two files of each recipe of the page, by library; TorchRL's model is torch's."""
    parts = re.findall(r"```python\n# recipe: (\w+)\.py\n(.*?)```", PAGE, re.S)
    learners = [code for name, code in parts if name == "learn"]
    cloned, torchs, ogbenchs = (code for name, code in parts if name == "model")
    models = {"d3rlpy": cloned, "torch": torchs, "torchrl": torchs, "ogbench": ogbenchs}
    found = {re.findall("d3rlpy|torchrl|ogbench|torch", code)[0]: code for code in learners}
    return {library: (found[library], model) for library, model in models.items()}


@pytest.mark.parametrize("library", ["d3rlpy", "torch", "torchrl", "ogbench"])
def test_recipes_of_the_page_train_and_play(library: str, room: Path, monkeypatch: Patch) -> None:
    pytest.importorskip(library)
    learn, model = recipes()[library]
    for part in (learn, model):
        assert len(part.splitlines()) <= 20  # as the page's title says
    if library == "ogbench":
        monkeypatch.setenv("HOME", str(room))
        folder = room / ".ogbench/data/knotgym"
        assert knotgym("dataset", "export", ID, "--to", "ogbench", "--out", folder) == 0
    few = re.sub(r"\b1[03]00\b", "2", learn)
    assert few != learn
    (room / "model.py").write_text(model)
    monkeypatch.syspath_prepend(room)
    monkeypatch.delitem(sys.modules, "model", raising=False)
    exec(compile(few, "learn.py", "exec"), {})
    check_plays("model", monkeypatch)


@pytest.mark.parametrize("action", ["decision", "macro"])
@pytest.mark.parametrize(
    "learner",
    ["BC", "BC --observation state", "GCBC", "NextBC", "Flow", "IQL", "TD3BC", "GCIVL", "CRL"],
)
def test_a_learner_in_torch_trains_and_plays(
    learner: str, action: str, room: Path, monkeypatch: Patch
) -> None:
    pytest.importorskip("torch")
    out, (name, *more) = room / "in_torch.pt", learner.split()
    words = (name, ID, *more, "--action", action, "--updates", 2, "--width", 8, "--out", out)
    run_script(FOLDER / "offline_torch.py", *words)
    check_plays(out.stem, monkeypatch)


def test_a_graph_of_codes_leads_a_learner(room: Path, monkeypatch: Patch) -> None:
    pytest.importorskip("torch")
    words = ("NextBC", ID, "--action", "macro", "--updates", 2, "--width", 8, "--out", "near.pt")
    run_script(FOLDER / "offline_torch.py", *words)
    monkeypatch.syspath_prepend(FOLDER)
    run_script(FOLDER / "code_graph.py", "near.pt", ID, "--out", "far.json")
    check_plays("far", monkeypatch)
    graph = json.loads(Path("far.json").read_text())
    assert graph[""] and all(count > 0 for count in graph[""].values())


def test_a_cloner_of_pictures_trains_and_plays(room: Path, monkeypatch: Patch) -> None:
    pytest.importorskip("torch")
    run_script(FOLDER / "pictures_torch.py", ID, "--updates", 2, "--out", "seen.pt")
    check_plays("seen", monkeypatch)


def test_values_of_diagrams_need_no_table_that_ships(room: Path, monkeypatch: Patch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("reads a table that ships")

    monkeypatch.setattr(PassValues, "table", refuse)
    run_script(FOLDER / "diagram_values.py", ID, "--out", room / "dv.h5")
    assert str(room) not in (room / "dv.py").read_text()
    check_plays("dv", monkeypatch)


def test_an_onnx_session_and_a_torch_module_act(room: Path) -> None:
    torch, runtime = pytest.importorskip("torch"), pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from knotgym.loaders import as_policy

    network = torch.nn.Sequential(torch.nn.Linear(609, 43), torch.nn.Tanh())
    torch.onnx.export(
        network, (torch.zeros(32, 609),), "model.onnx", input_names=["seen"], dynamo=False
    )
    seen = np.random.default_rng(0).normal(size=(5, 609)).astype(np.float32)
    session = as_policy(runtime.InferenceSession("model.onnx"))
    right = as_policy(network).actions(seen)
    np.testing.assert_allclose(session.actions(seen), right, atol=1e-5)
