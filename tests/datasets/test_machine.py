"""Verification tells another machine's rounding from data that are wrong."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from knotgym.control import verification
from knotgym.datasets.machine import machine, others

REPLAYED = "states.h5 row 0: replay of its start and actions does not end in qpos bit for bit"
CHANGED = "states.h5 is not the file the manifest lists (SHA-256 differs)"


def made_on(folder: Path, *machines: Any) -> Path:
    (folder / "manifest.json").write_text(json.dumps({"machines": machines}), encoding="utf-8")
    return folder


def found(folder: Path, monkeypatch: pytest.MonkeyPatch, *faults: str) -> list[str]:
    def told(folder: Path, *count: object) -> Iterator[str]:
        yield from faults

    monkeypatch.setattr(verification, "folder_faults", told)
    return list(verification.faults(folder))


def test_a_machine_says_what_can_change_a_bit() -> None:
    here = machine()
    assert here.keys() == {"system", "processor", "instructions", "blas", "libc"}
    assert here["processor"] and all(text.isprintable() for text in here.values())


def test_replays_that_end_elsewhere_on_another_machine_are_told_to_be_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_on(tmp_path, {**machine(), "instructions": "NEON"})
    fault, told = found(tmp_path, monkeypatch, REPLAYED)
    assert fault == REPLAYED and "generated on another machine, instructions NEON (here " in told


def test_on_the_same_machine_a_replay_that_ends_elsewhere_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_on(tmp_path, machine())
    assert found(tmp_path, monkeypatch, REPLAYED) == [REPLAYED]


def test_what_was_changed_is_wrong_on_any_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_on(tmp_path, {**machine(), "blas": "another 1.0"})
    assert found(tmp_path, monkeypatch, CHANGED, REPLAYED) == [CHANGED, REPLAYED]


@pytest.mark.parametrize(
    "said", ["x", [], {"machines": 3}, {"machines": ["x", 1]}, {"machines": None}]
)
def test_machines_that_are_none_are_passed_over(said: Any, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps(said), encoding="utf-8")
    assert others(tmp_path) == ""


def test_machines_that_differ_are_named_once_and_send_nothing_to_the_terminal(
    tmp_path: Path,
) -> None:
    one = {**machine(), "libc": "\x1b[2J"}
    told = others(made_on(tmp_path, one, one, machine()))
    assert told.startswith("libc \\x1b[2J (here ") and told.count("here") == 1


def test_a_run_names_its_machine(curated: Path) -> None:
    said = json.loads((curated / "manifest.json").read_text(encoding="utf-8"))
    assert said["machines"] == [machine()]
