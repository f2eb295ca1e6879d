"""How a command ends: one line on standard error and its status, whatever happens."""

import importlib.util
import os
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Capture, Patch

from knotgym.cli import program as cli
from knotgym.common import Failed, InvalidFile, MissingExtra

from ..fresh_interpreter import python
from ..small_job import knotgym

ROOT = Path(__file__).parents[2]


def interrupted_in_compiled_code() -> Exception:
    """What numba makes of Ctrl-C."""
    error = SystemError("a function returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InvalidFile("a.h5 is\ncorrupted"), 2, "a.h5 is corrupted"),
        (MissingExtra("torch", "pip install x"), 2, "this needs torch, which isn't installed"),
        (Failed("3 of 4 codes were made"), 1, "3 of 4 codes were made"),
        (BrokenProcessPool(), 1, "a worker died or memory ran out"),
        (OSError(36, "long", "a"), 2, "File name too long a"),
        (KeyboardInterrupt(), 130, "interrupted before all output was written\n"),
        (interrupted_in_compiled_code(), 130, "interrupted before all output was written\n"),
    ],
)
def test_an_end_is_one_line(
    error: BaseException, status: int, line: str, monkeypatch: Patch, capfd: Capture
) -> None:
    def ended(*_: Any) -> None:
        raise error

    monkeypatch.setattr("knotgym.cli.inspection.print_summary", ended)
    assert knotgym("dataset", "show", "x") == status
    said = capfd.readouterr().err
    assert said.startswith(f"knotgym: {line}") and said.count("\n") == 1


@pytest.mark.parametrize("command", ["evaluate", "collect"])
def test_learners_without_torch_name_the_extra(
    command: str, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda *_: None)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert knotgym(command, "--policy", "pretrained", "--out", tmp_path / "made") == 2
    said = capfd.readouterr().err
    assert "the learner pretrained needs torch" in said and said.count("\n") == 1


def test_a_fault_of_ours_is_not_called_a_user_s_mistake(monkeypatch: Patch, capfd: Capture) -> None:
    monkeypatch.setattr("knotgym.cli.inspection.print_summary", lambda *_: 1 / 0)
    assert knotgym("dataset", "show", "x") == 1
    said = capfd.readouterr().err
    assert said.startswith("Traceback") and "ZeroDivisionError" in said
    assert said.splitlines()[-1].startswith("knotgym: this is a bug in knotgym: please report it")


def test_an_interrupted_run_names_resume_and_its_folder(monkeypatch: Patch, capfd: Capture) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("knotgym.generate.evaluate", stopped)
    assert knotgym("evaluate") == 130
    said = capfd.readouterr().err
    assert ".NAME.partial" in said and "--resume to go on, or with --restart" in said


def test_the_alias_of_generate_is_generate(monkeypatch: Patch, capfd: Capture) -> None:
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["knotgym-generate", "--help"])
    with pytest.raises(SystemExit):
        cli.main_generate()
    assert "Usage: knotgym generate [OPTIONS]" in capfd.readouterr().out


@pytest.mark.skipif(not (ROOT / "datasets").is_symlink(), reason="a checkout without links")
@pytest.mark.parametrize("name", ["datasets", "generate", "loaders"])
def test_a_link_is_not_imported_by_its_bare_name(name: str) -> None:
    run = python("-c", f"import {name}", cwd=ROOT)
    assert run.returncode == 1
    assert f"import knotgym.{name}" in run.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "before, named, said",
    [
        ("os.rmdir(os.getcwd())", {}, "the current folder is gone: change to another"),
        ("pass", {"NUMBA_DISABLE_JIT": "1"}, "NUMBA_DISABLE_JIT is set, and kernels must be"),
    ],
)
def test_a_place_in_which_nothing_can_run_is_one_line(
    before: str, named: dict[str, str], said: str, tmp_path: Path
) -> None:
    script = f"import os\n{before}\nfrom knotgym.cli import program\n"
    script += "program.main(['dataset', 'show', 'readable'])"
    run = python("-c", script, cwd=tmp_path, env={**os.environ, **named, "PYTHONPATH": str(ROOT)})
    assert run.returncode == 2 and run.stderr.startswith(f"knotgym: {said}")
    assert run.stderr.count("\n") == 1
