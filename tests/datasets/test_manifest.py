"""Manifests: nothing elsewhere is looked at for them, and every oddity is named."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Capture, Patch

import knotgym
from knotgym.common import InvalidFile, read_json
from knotgym.datasets import manifest as manifests
from knotgym.datasets import state_card
from knotgym.datasets.episode_verification import ReplayFault
from knotgym.datasets.manifest import listed_faults, machine, read_manifest
from knotgym.datasets.state_card import write_gallery
from knotgym.generate import faults as dataset_faults
from knotgym.states import States

from ..small_job import knotgym as typed

SOUND: dict[str, Any] = {
    "config": {"seed": 0},
    "files": {"states.h5": "0" * 64},
    "report": {
        "attempts": 3,
        "existing_codes": {"1": 4, "5": None},
        "rejected": {"1": {"margin": 2}},
    },
}

ODD: tuple[Any, ...] = ("", [], 3, None)


def written(folder: Path, **changes: Any) -> Path:
    (folder / "manifest.json").write_text(json.dumps({**SOUND, **changes}), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        *(({"files": {name: "0"}}, "is not a file") for name in ("../x", "/etc/x", "", "\x1b[2J")),
        *(({name: value}, name) for name in ("files", "config") for value in ODD),
        *(({"report": {"attempts": value}}, "report.attempts") for value in ("3", True)),
        ({"report": {"existing_codes": [4]}}, "report.existing_codes"),
        *(
            ({"report": {"rejected": {"1": value}}}, "report.rejected")
            for value in (2, {"\x1b[2J": 2})
        ),
    ],
)
def test_what_no_run_writes_isn_t_shown(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    manifest, (fault,) = read_manifest(written(tmp_path, **changes))
    assert said in fault and fault.isprintable() and manifest == {}


@pytest.mark.parametrize("content", [b"[" * 200_000, b"9" * 10_000, b"\xff\xfe", b"", b"{"])
def test_what_is_no_json_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "manifest.json"
    path.write_bytes(content)
    with pytest.raises(InvalidFile, match=r"isn't valid JSON") as raised:
        read_json(path)
    assert str(raised.value).isprintable()
    assert len(read_manifest(tmp_path)[1]) == 1


def test_a_pipe_and_what_is_too_large_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "large").write_bytes(b" " * 101)
    for name in ("pipe", "link"):
        with pytest.raises(InvalidFile, match="a regular file"):
            read_json(tmp_path / name)
    with pytest.raises(InvalidFile, match="more than 100 bytes"):
        read_json(tmp_path / "large", most=100)


def test_a_data_file_that_is_not_listed_is_a_fault(tmp_path: Path) -> None:
    manifest, faults = read_manifest(written(tmp_path, files={}))
    assert not faults and manifest["report"].items() >= SOUND["report"].items()
    (tmp_path / "minari").mkdir()
    for name in ("states.h5", "minari/metadata.json"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "notes.txt").write_text("mine")
    assert list(listed_faults(tmp_path, manifest)) == [
        "minari/metadata.json is not in the manifest",
        "states.h5 is not in the manifest",
    ]


def test_a_run_names_its_machine(curated: Path) -> None:
    here = machine()
    assert here.keys() == {"system", "processor", "instructions", "blas", "libc"}
    assert json.loads((curated / "manifest.json").read_text())["machines"] == [here]


@pytest.mark.parametrize(
    "faults", [[ReplayFault("row 0 ends in another qpos")], ["SHA-256 differs bit for bit"]]
)
def test_only_replays_that_differ_may_be_another_machines_rounding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faults: list[str]
) -> None:
    written(tmp_path)
    monkeypatch.setattr(
        "knotgym.datasets.row_verification._folder_faults", lambda *given: iter(faults)
    )
    told = list(dataset_faults(tmp_path))[1:]
    assert len(told) == isinstance(faults[0], ReplayFault)
    assert all("other machines" in o for o in told)


def test_a_file_of_a_states_folder_and_a_field_of_its_manifest(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    """Known as ours by the manifest that lists it; a file of the user's is never replaced."""
    folder, words = tmp_path / "set", "--nx 0 --count 1 --no-demonstrations --workers 1 --quiet"
    assert typed("generate", *words.split(), "--out", folder) == 0  # of before the change
    manifest, faults = read_manifest(folder)
    assert "spent" not in manifest["report"] and faults == []

    def gallery(path: Path, states: States) -> None:
        write_gallery(path, states)
        path.with_name("notes.txt").write_text("how the rope lies")

    class Report(manifests._Report):
        spent: int = 0

    class Manifest(manifests._Manifest):
        report: Report = Report()

    finish = state_card.finish
    monkeypatch.setattr(state_card, "write_gallery", gallery)
    monkeypatch.setattr(manifests, "_Manifest", Manifest)
    monkeypatch.setattr(
        "knotgym.generate.state_recipe.finish",
        lambda place, report, *given: finish(place, {**report, "spent": 7}, *given),
    )
    assert read_manifest(folder)[0]["report"]["spent"] == 0 and knotgym.verify(folder) == []
    again = ("generate", *words.split(), "--out", folder, "--overwrite")
    for _ in range(2):  # what it replaces has the file, too
        assert typed(*again) == 0 and (folder / "notes.txt").is_file()
    assert read_manifest(folder)[0]["report"]["spent"] == 7 and knotgym.verify(folder) == []
    (folder / "mine.txt").touch()
    assert typed(*again) == 2 and "lists mine.txt;" in capsys.readouterr().err
    (folder / "notes.txt").unlink()
    assert any("notes.txt is missing" in fault for fault in knotgym.verify(folder))
