"""Folders to upload: their contents, and that other libraries can read them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from knotgym.common.errors import InvalidInput
from knotgym.datasets.cards.citation import citation_file
from knotgym.datasets.exports.huggingface_export import ToUpload, to_huggingface
from knotgym.generate.episodes.suite_scores import CELL, LINE, score_tables
from knotgym.states.state_file import read_states

from ..small_job import knotgym

needs_arrow = pytest.mark.skipif(find_spec("pyarrow") is None, reason="pyarrow isn't installed")


@pytest.fixture(scope="module")
def huggingface(curated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small run exported for Hugging Face."""
    out = tmp_path_factory.mktemp("upload") / "nx0-1"
    given = ("dataset", "export", curated, "--to", "huggingface", "--out", out, "--quiet")
    assert knotgym(*given) == 0
    return out


@pytest.fixture(scope="module")
def minari_root(curated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its trajectories exported for Minari."""
    out = tmp_path_factory.mktemp("upload") / "root"
    assert knotgym("dataset", "export", curated, "--to", "minari", "--out", out, "--quiet") == 0
    return out


def asked(script: str, folder: Path, **variables: str) -> str:
    """Run a script that doesn't import knotgym in a folder; return what it prints."""
    known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    run = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env={**known, **variables},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@needs_arrow
def test_tables_hold_every_number_of_the_states(curated: Path, huggingface: Path) -> None:
    import pyarrow.parquet as parquet

    states = read_states(curated / "states.h5")
    rows = parquet.read_table(huggingface / "data/states/test-00000-of-00001.parquet").to_pylist()
    chosen = states.taken(np.flatnonzero(states.split == "test"))
    assert np.array_equal([row["points"] for row in rows], chosen.points.reshape(len(rows), -1))
    assert [row["gauss_code"] for row in rows] == chosen.gauss_code.tolist()


@needs_arrow
def test_the_folder_has_card_citation_gallery_and_croissant(huggingface: Path) -> None:
    assert {"README.md", "CITATION.cff", "gallery.png", "croissant.json", "data"} == {
        path.name for path in huggingface.iterdir()
    }
    card = (huggingface / "README.md").read_text(encoding="utf-8")
    assert "license: cc-by-4.0" in card and "| `goal_gauss_code` |" in card
    said = json.loads((huggingface / "croissant.json").read_text(encoding="utf-8"))
    assert said["license"].endswith("by/4.0/") and said["rai:personalSensitiveInformation"]


HOSTILE = (
    '<img src=x onerror=y>"\n---\n# [a](javascript:b) ![c](http://d) `e` | www.f @g $h$ *i* \ud800'
)


def harmless(text: str) -> bool:
    """Check that no Markdown in HOSTILE survives in a text."""
    meant = (
        "<img",
        "\n---\n# [",
        "[a](",
        "![c]",
        "http://d",
        " `e`",
        " | www",
        "www.f",
        "@g",
        " *i*",
    )
    return "onerror" in text and not [one for one in meant if one in text]


@needs_arrow
def test_cards_show_a_hostile_name_as_text(curated: Path, tmp_path: Path) -> None:
    to_huggingface(ToUpload(HOSTILE, states=curated / "states.h5"), tmp_path / "hub")
    card = (tmp_path / "hub" / "README.md").read_text(encoding="utf-8")
    head, body = card.removeprefix("---\n").split("\n---\n", 1)
    (name,) = [line for line in head.splitlines() if line.startswith("pretty_name: ")]
    assert json.loads(name.partition(": ")[2]).startswith("<img")  # one YAML string in quotes
    assert harmless(body)
    (title,) = [one for one in citation_file(HOSTILE).splitlines() if one.startswith("title: ")]
    assert json.loads(title.partition(": ")[2]).startswith("knotgym: <img")


@needs_arrow
def test_a_shard_s_name_writes_no_yaml(tmp_path: Path) -> None:
    (tmp_path / "train\n  path: x-0.parquet").write_bytes(b"")
    with pytest.raises(InvalidInput, match="must begin with a split"):
        to_huggingface(ToUpload("pictures", pictures=tmp_path), tmp_path / "hub")


def test_tables_of_scores_show_a_hostile_policy_as_text() -> None:
    row = {**dict.fromkeys((*LINE, *CELL), HOSTILE), "split": "test", "task": "tie", "nx": 2}
    score = {"success_rate": 0.5, "interval": [0.4, 0.6], "episodes": 2, "training": {}}
    assert harmless("\n".join(score_tables([{**row, **score}])))


@needs_arrow
@pytest.mark.parametrize("form", ["huggingface", "minari"])
def test_what_is_there_is_left_alone(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], form: str
) -> None:
    assert knotgym("dataset", "export", curated, "--to", form, "--out", tmp_path) == 2
    assert "exists already" in capfd.readouterr().err and not list(tmp_path.iterdir())


def test_minaris_folder_is_a_repository_of_the_same_bytes(curated: Path, minari_root: Path) -> None:
    (repository,) = minari_root.iterdir()
    assert {"README.md", "CITATION.cff", "gallery.png"} < {one.name for one in repository.iterdir()}
    listed = json.loads((repository / "namespace_metadata.json").read_text())["datasets"]
    assert len(listed) == 4
    for name in listed:
        for file in (curated / "minari" / name / "data").iterdir():
            assert (minari_root / name / "data" / file.name).read_bytes() == file.read_bytes()


def test_states_of_a_run_are_on_the_disk_once(curated: Path) -> None:
    carried = list(curated.glob("minari/**/states.h5"))
    assert len(carried) == 4
    assert {file.stat().st_ino for file in carried} == {(curated / "states.h5").stat().st_ino}


@pytest.mark.clients
def test_minari_reads_the_folder_and_never_imports_us(minari_root: Path, tmp_path: Path) -> None:
    script = (
        "import sys, minari\n"
        "one = minari.load_dataset('knotgym/tie-nx1/demonstrations-v0')\n"
        "print(one.total_episodes, next(iter(one)).actions.shape[1], 'knotgym' in sys.modules)"
    )
    assert asked(script, tmp_path, MINARI_DATASETS_PATH=str(minari_root)) == "2 6 False\n"


@pytest.mark.clients
@needs_arrow
def test_datasets_reads_the_folder(huggingface: Path, tmp_path: Path) -> None:
    if find_spec("dill") is None:  # the bare name "datasets" finds our link here
        pytest.skip("Hugging Face's datasets isn't installed")
    script = (
        "import sys; from datasets import load_dataset\n"
        "for name in ('states', 'steps'):\n"
        "    one = load_dataset(sys.argv[1] if sys.argv[1:] else FOLDER, name)\n"
        "    print(name, sorted(one), one['train'].num_rows)\n"
        "    row = one['train'][0]; print(len(row['points']))"
    ).replace("sys.argv[1] if sys.argv[1:] else FOLDER", repr(str(huggingface)))
    told = asked(script, tmp_path, HF_HOME=str(tmp_path / "hf"), HF_HUB_OFFLINE="1").split("\n")
    assert told[0] == "states ['test', 'train'] 4" and told[1] == told[3] == "300"


@pytest.mark.clients
@needs_arrow
def test_croissant_is_valid_and_a_record_comes_back(huggingface: Path, tmp_path: Path) -> None:
    if find_spec("mlcroissant") is None:
        pytest.skip("mlcroissant isn't installed")
    script = (
        "import mlcroissant\n"
        f"one = mlcroissant.Dataset(jsonld={str(huggingface / 'croissant.json')!r})\n"
        "print(len(one.metadata.ctx.issues.errors))\n"
        "row = next(iter(one.records('states/train')))\n"
        "print(len(row['states/train/points']), row['states/train/nx'])"
    )
    assert asked(script, tmp_path).split()[:2] == ["0", "300"]
