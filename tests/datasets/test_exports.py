"""Tests of exports: what other libraries read, and that a stranger's text stays text."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import TASK, TINY, episodes, written

from knotgym.common import InvalidFile, InvalidInput
from knotgym.control import replay
from knotgym.datasets import open_episodes, write_episodes
from knotgym.datasets.card_texts import citation_file
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.exports import EXPORTS, Export, export, export_help
from knotgym.datasets.exports.huggingface_export import to_huggingface
from knotgym.datasets.located import Located
from knotgym.datasets.merging import merge
from knotgym.datasets.subsets import delete
from knotgym.generate import verify
from knotgym.states import read_states

from ..fresh_interpreter import python
from ..small_job import knotgym

EXPERT = str(TINY["expert"])
ID = "knotgym/tie-nx2/tiny-v0"
clients = pytest.mark.clients


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with one dataset; only ever read."""
    out = tmp_path_factory.mktemp("root")
    merge([EXPERT], out, ID)
    return out


@pytest.fixture(scope="module")
def huggingface(states_path: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """States and episodes exported for Hugging Face."""
    out = tmp_path_factory.mktemp("upload") / "hub"
    out.mkdir()
    located = Located(Path("tiny"), Path(states_path), tuple(TINY.values()))
    to_huggingface(located, out, replay)
    return out


def output_of(script: str, folder: Path, **variables: str) -> str:
    """Run a script that doesn't import knotgym in a folder; return what it prints."""
    known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    run = python("-c", script, cwd=folder, env={**known, **variables})
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.parametrize("form", ["compact", "columns"])
def test_a_recording_is_the_columns_again(form: str, tmp_path: Path) -> None:
    export(EXPERT, tmp_path / "r.h5", "recording", replay)
    assert open_episodes(tmp_path / "r.h5").episodes.is_recording
    export(str(tmp_path / "r.h5"), tmp_path / "c.h5", form, replay)
    one, other = (open_episodes(path).episodes for path in (EXPERT, tmp_path / "c.h5"))
    assert one.differences(other) == []
    is_mapped = not other.steps["observation"].flags.owndata
    assert is_mapped == (form == "columns")


@pytest.mark.parametrize("form", ["compact", "columns", "recording", "minari", "huggingface"])
def test_two_datasets_are_not_one_file(form: str, tmp_path: Path) -> None:
    for name, part in (("alice", "0"), ("bob", "1-2")):
        delete(EXPERT, part, tmp_path / f"{name}.h5")
        merge([str(tmp_path / f"{name}.h5")], tmp_path / "in" / name, f"{name}/tie-nx2/x-v0")
    if EXPORTS[form].output == "file":
        export(str(tmp_path / "in"), tmp_path / "out", form, replay)
        made = {file.name: open_episodes(file) for file in (tmp_path / "out").glob("*.h5")}
        rows = {name: one.episodes.episodes.rows for name, one in made.items()}
        assert rows == {"alice-tie-nx2-x-v0.h5": 2, "bob-tie-nx2-x-v0.h5": 1}
        return
    shutil.copytree(tmp_path / "in" / "bob", tmp_path / "in" / "again")
    with pytest.raises(InvalidInput, match="two datasets have the id bob/tie-nx2/x-v0"):
        export(str(tmp_path / "in"), tmp_path / "out", form, replay)


@pytest.mark.parametrize("of", ["digest", "expansion"])
def test_a_recording_that_is_not_what_was_written_is_not_expanded(of: str, tmp_path: Path) -> None:
    """`expansion` differs where a machine rounds otherwise: its states would be other ones."""
    recording, out = tmp_path / "r.h5", tmp_path / "c.h5"
    export(EXPERT, recording, "recording", replay)
    with h5py.File(recording, "r+") as file:
        file.attrs[of] = np.array(b"0" * 64, h5py.string_dtype("utf-8", 64))
    with pytest.raises(InvalidFile, match="their digest|its digest|other states here"):
        export(str(recording), out, "columns", replay)
    assert not out.exists() and verify(recording)


def test_ogbench_files_hold_every_state_once(tmp_path: Path) -> None:
    export(EXPERT, tmp_path, "ogbench", replay)
    dataset = open_episodes(EXPERT)
    for look in ("", "visual-"):
        parts = [
            np.load(tmp_path / f"{look}tie-nx2-expert_chain-v0{end}.npz")
            for end in ("-train", "-val")
        ]
        rows = [part["terminals"] for part in parts]
        assert sum(map(len, rows)) == dataset.episodes.steps.rows
        assert [int(one.sum()) for one in rows] == [2, 1]
    np.testing.assert_array_equal(parts[1]["actions"][-1], np.zeros(6))
    first = dataset.episodes.select([0, 1]).steps
    train = np.load(tmp_path / "tie-nx2-expert_chain-v0-train.npz")
    np.testing.assert_array_equal(train["observations"], first["observation"].reshape(-1, 300))
    np.testing.assert_array_equal(train["actions"], first["action"])


def test_a_file_for_stable_worldmodel_has_windows_of_states_and_actions(tmp_path: Path) -> None:
    export(EXPERT, tmp_path / "a.h5", "worldmodel", replay)
    one = open_episodes(EXPERT)
    with h5py.File(tmp_path / "a.h5", swmr=True) as file:  # as its reader opens it
        lengths, offsets = file["ep_len"][:], file["ep_offset"][:]
        assert lengths.tolist() == (one.episodes.episodes["length"] + 1).tolist()
        last = offsets + lengths - 1
        assert np.isnan(file["action"][:][last]).all() and np.isnan(file["reward"][:][last]).all()
        assert (file["pixels"][:] == one.seen("pixels", alone=True)).all()
        assert (file["observation"][:] == one.seen("state", alone=True)).all()
        assert np.isfinite(file["action"][:][np.setdiff1d(np.arange(last[-1]), last)]).all()


def test_ogbench_files_appear_together(tmp_path: Path, monkeypatch: Patch) -> None:
    calls, write = [0, 1], np.savez_compressed
    monkeypatch.setattr(
        np, "savez_compressed", lambda *a, **named: write(*a, **named) if calls.pop() else 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        export(EXPERT, tmp_path, "ogbench", replay)
    assert not list(tmp_path.iterdir())


def test_parquet_tables_hold_every_number(states_path: str, huggingface: Path) -> None:
    import pyarrow.parquet as parquet

    states = read_states(states_path)
    rows = parquet.read_table(huggingface / "data/states/test-00000-of-00001.parquet").to_pylist()
    chosen = states.take(np.flatnonzero(states.split == "test"))
    assert np.array_equal([row["points"] for row in rows], chosen.points.reshape(len(rows), -1))
    assert [row["gauss_code"] for row in rows] == chosen.gauss_code.tolist()
    rows = parquet.read_table(huggingface / "data/steps/train-00000-of-00001.parquet").to_pylist()
    (own, steps) = open_episodes(EXPERT).episodes
    assert len(rows) == steps.rows + open_episodes(TINY["random"]).episodes.steps.rows
    mine = rows[: steps.rows]
    assert np.array_equal([row["action"] for row in mine], steps["action"])
    assert [row["gauss_code"] for row in mine] == gauss_codes(steps["visits"]).tolist()
    assert sum(row["is_last"] for row in mine) == own.rows


def test_the_folder_has_card_citation_gallery_and_croissant(huggingface: Path) -> None:
    assert {"README.md", "CITATION.cff", "gallery.png", "croissant.json", "data"} == {
        path.name for path in huggingface.iterdir()
    }
    card = (huggingface / "README.md").read_text(encoding="utf-8")
    assert "license: cc-by-4.0" in card and "| `goal_gauss_code` |" in card
    described = json.loads((huggingface / "croissant.json").read_text(encoding="utf-8"))
    assert described["license"].endswith("by/4.0/")
    assert described["rai:personalSensitiveInformation"]
    fields = {one["@id"]: one for records in described["recordSet"] for one in records["field"]}
    assert fields["states/train/gauss_code"]["dataType"] == "sc:Text"
    assert fields["states/train/points"]["repeated"]


HOSTILE = (
    '<img src=x onerror=y>"\n---\n# [a](javascript:b) ![c](http://d) `e` | www.f @g $h$ *i* \ud800'
)
MARKUP = ("<img", "\n---\n# [", "[a](", "![c]", "http://d", " `e`", " | www", "www.f", "@g", " *i*")


def test_a_summary_sends_no_command_to_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """JSON has escapes of its own, so that a file without control characters may spell some."""
    facts = {"metadata": {"dataset_id": "a/b-v0", "author": ["Eve\x1b[2J"]}}
    write_episodes(tmp_path / "e.h5", [episodes([2])], TASK, facts)
    assert knotgym("dataset", "show", tmp_path / "e.h5") == 0
    said = capsys.readouterr().out
    assert "Eve" in said and "\x1b" not in said


def test_cards_show_a_hostile_name_as_text(tmp_path: Path) -> None:
    facts = {"metadata": {"dataset_id": HOSTILE}}
    write_episodes(tmp_path / "e.h5", [episodes([2])], TASK, facts)
    export(str(tmp_path / "e.h5"), tmp_path / "hub", "huggingface", replay)
    card = (tmp_path / "hub" / "README.md").read_text(encoding="utf-8")
    head, body = card.removeprefix("---\n").split("\n---\n", 1)
    (name,) = [line for line in head.splitlines() if line.startswith("pretty_name: ")]
    assert json.loads(name.partition(": ")[2]).startswith("<img")  # one YAML string in quotes
    assert "onerror" in body and "\n3 states in episodes of a closed rope (" in body
    assert not [one for one in MARKUP if one in body]
    (title,) = [one for one in citation_file(HOSTILE).splitlines() if one.startswith("title: ")]
    assert json.loads(title.partition(": ")[2]).startswith("knotgym: <img")


def test_minaris_folder_is_a_repository_of_the_same_bytes(root: Path, tmp_path: Path) -> None:
    export(str(root), tmp_path / "up", "minari", replay)
    repository = tmp_path / "up" / "knotgym"
    assert {"README.md", "CITATION.cff", "gallery.png"} < {one.name for one in repository.iterdir()}
    assert "| starts | goals | pairs |" in (repository / "README.md").read_text()
    listed = json.loads((repository / "namespace_metadata.json").read_text())["datasets"]
    assert listed == [ID]
    for file in (root / ID / "data").iterdir():
        assert (tmp_path / "up" / ID / "data" / file.name).read_bytes() == file.read_bytes()
    copy = tmp_path / "root" / ID
    shutil.copytree(root / ID, copy)
    for name in ("main_data.hdf5", "metadata.json"):  # Minari's form, which is written again
        (copy / "data" / name).unlink()
    export(str(copy), tmp_path / "again", "minari", replay)
    assert (tmp_path / "again" / ID / "data/main_data.hdf5").is_file()


def test_what_has_no_place_in_a_form_is_refused(tmp_path: Path, states_path: str) -> None:
    one = str(written(tmp_path / "one.h5", episodes([2])))
    for source, form, says in (
        (one, "ogbench", "at least 2 episodes"),
        (one, "minari", "not a Minari dataset"),
        (states_path, "compact", "contains no episodes"),
        (one, "coco", "contains no pictures"),
        (one, "poem", "formats are compact"),
    ):
        with pytest.raises(InvalidInput, match=says):
            export(source, tmp_path / "out", form, replay)
    assert not (tmp_path / "out").exists()


def lengths(source: Located, target: Path, _: object) -> str:
    """An export of a stranger: the lengths of episodes as text."""
    (path,) = source.episodes
    target.write_text(" ".join(map(str, open_episodes(path).episodes.episodes["length"])))
    return "lengths"


def test_a_new_export_is_one_record(tmp_path: Path, monkeypatch: Patch) -> None:
    name = f"{lengths.__module__}:lengths"
    monkeypatch.setitem(EXPORTS, "lengths", Export("lengths alone", name, output="file"))
    one = written(tmp_path / "one.h5", episodes([2, 3]))
    assert export(str(one), tmp_path / "out.txt", "lengths", replay) == "lengths"
    assert (tmp_path / "out.txt").read_text() == "2 3"
    assert "lengths (lengths alone)" in export_help()
    with pytest.raises(InvalidInput, match=r"formats are .*lengths"):
        export(str(one), tmp_path / "x", "poem", replay)


def test_a_plain_file_never_lands_in_minaris_folder(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.raises(InvalidInput, match="Minari's folder"):
        export(EXPERT, tmp_path / "a.h5", "compact", replay)


@clients
def test_minari_reads_the_folder_and_never_imports_us(root: Path, tmp_path: Path) -> None:
    export(str(root), tmp_path / "up", "minari", replay)
    script = (
        "import sys, minari\n"
        f"one = minari.load_dataset({ID!r})\n"
        "print(one.total_episodes, next(iter(one)).actions.shape[1], 'knotgym' in sys.modules)"
    )
    found = output_of(script, tmp_path, MINARI_DATASETS_PATH=str(tmp_path / "up"))
    assert found == "3 6 False\n"


@clients
def test_datasets_reads_the_folder(huggingface: Path, tmp_path: Path) -> None:
    pytest.importorskip("dill")  # Hugging Face's; the bare name "datasets" finds our link here
    script = (
        "from datasets import load_dataset\n"
        f"one = load_dataset({str(huggingface)!r}, 'steps')\n"
        "print(sorted(one), len(one['train'][0]['points']))"
    )
    found = output_of(script, tmp_path, HF_HOME=str(tmp_path / "hf"), HF_HUB_OFFLINE="1")
    assert found == "['train'] 300\n"


@clients
def test_croissant_is_valid_and_a_record_comes_back(huggingface: Path, tmp_path: Path) -> None:
    pytest.importorskip("mlcroissant")
    script = (
        "import mlcroissant\n"
        f"one = mlcroissant.Dataset(jsonld={str(huggingface / 'croissant.json')!r})\n"
        "print(len(one.metadata.ctx.issues.errors))\n"
        "row = next(iter(one.records('states/train')))\n"
        "print(len(row['states/train/points']))"
    )
    assert output_of(script, tmp_path).split() == ["0", "300"]
