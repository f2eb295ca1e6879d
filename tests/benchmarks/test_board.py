"""A stranger's policy is entered by the lines of docs/board.md alone."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from pytest_types import Capture, Patch

from ..scripts import ROOT, run_script
from ..small_job import knotgym

PAGE = re.sub(r" \\\n +", " ", (ROOT / "docs" / "board.md").read_text(encoding="utf-8"))


@pytest.mark.thorough
def test_a_stranger_enters_by_the_page(tmp_path: Path, monkeypatch: Patch, capsys: Capture) -> None:
    (module,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
    assert len(module.splitlines()) <= 40
    lines = re.sub(r"```.*?```", "", PAGE, flags=re.S)
    evaluate, verify, results = re.findall(r"^    (\S.*)$", lines, re.M)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(module)
    (tmp_path / "benchmarks" / "entries").mkdir(parents=True)
    for line in (evaluate, verify):
        assert knotgym(*shlex.split(line)[1:]) == 0
    said = "".join(capsys.readouterr())
    assert "farthest bead" in said and "512 episodes" in said and "no faults" in said
    assert results == "python benchmarks/results.py"
    pytest.importorskip("scipy")
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "README.md", tmp_path)
    entries = tmp_path / "benchmarks" / "entries"
    folders = ("--entries", entries, "--root", tmp_path)
    run_script(ROOT / "benchmarks" / "results.py", *folders)
    assert "| farthest bead | 1 |" in (tmp_path / "docs" / "benchmark.md").read_text()
    run_script(ROOT / "benchmarks" / "results.py", *folders, "--check")
    shutil.copy(entries / "mine.h5", entries / "again.h5")  # no second seed
    with pytest.raises(SystemExit, match="two entries of farthest bead, tie nx 2, hold the same"):
        run_script(ROOT / "benchmarks" / "results.py", *folders)
