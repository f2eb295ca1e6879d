"""Every line of the README, run in order as it stands by a newcomer: a fresh copy of the checkout,
a fresh virtual environment and home folder, no display. `pytest -m slow tests/test_readme.py`.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TESTS = ".venv/bin/pip install '.[test]' && .venv/bin/pytest"  # a step of .ci/run by itself


def steps(text: str) -> list[tuple[str, str]]:
    """The commands and Python blocks of a page, in order, as ("sh" or "python", lines)."""
    found = re.findall(r"^```python\n(.*?)^```$|^ {4}(\S[^\n]*)$", text, re.M | re.S)
    return [("python", block) if block else ("sh", line) for block, line in found]


def test_commands_and_blocks_are_found_in_order() -> None:
    page = "One.\n\n    first a\n    second b\n\n```python\nif x:\n    y\n```\n\n    third\n"
    assert steps(page) == [
        ("sh", "first a"),
        ("sh", "second b"),
        ("python", "if x:\n    y\n"),
        ("sh", "third"),
    ]


def test_ci_runs_the_command_of_the_tests() -> None:
    assert ("sh", TESTS) in steps((ROOT / "README.md").read_text(encoding="utf-8"))
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "'.[test]' && pytest" in script and "tests/test_readme.py" in script


@pytest.mark.slow
def test_every_line_runs_as_it_stands(tmp_path: Path) -> None:
    checkout, home = tmp_path / "knotgym", tmp_path / "home"
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", ROOT, checkout], check=True)
    home.mkdir()
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "PYTHONPATH", "MINARI_DATASETS_PATH", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    settings = Path.home() / ".config" / "pip" / "pip.conf"  # where this machine gets packages
    if settings.is_file():
        environment.setdefault("PIP_CONFIG_FILE", str(settings))
    environment["HOME"] = str(home)
    for kind, text in steps((checkout / "README.md").read_text(encoding="utf-8")):
        if text == TESTS:
            continue
        words = ["bash", "-euo", "pipefail", "-c", text]
        if kind == "python":
            words = [".venv/bin/python", "-c", text]
        ended = subprocess.run(
            words, cwd=checkout, env=environment, capture_output=True, text=True, timeout=1800
        )
        assert ended.returncode == 0, f"{text}\n{ended.stdout[-1000:]}\n{ended.stderr[-2000:]}"
        assert "Traceback" not in ended.stderr, text
    assert (checkout / "knotgym-data/nx3/states.h5").is_file()
    assert (checkout / "clone" / "policy.json").is_file()
