"""Every line of the README, and of the newcomer's five pages after it, run in order as it stands: a
fresh copy of the checkout, a fresh virtual environment and home folder, no display. It prints the
seconds that each line took. `pytest -m slow -s tests/test_readme.py`. A folder of packages that
KNOTGYM_TORCH names is seen by the fresh environment, so that torch isn't installed again.
"""

import os
import re
import subprocess
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in "index environment data learning commands".split()),
)
TESTS = ".venv/bin/pip install '.[test]' && .venv/bin/pytest"  # a step of .ci/run by itself
UPLOADS = "hf upload "  # needs an account


def steps(text: str) -> list[tuple[str, str]]:
    """The commands and Python blocks of a page, in order, as ("sh" or "python", lines)."""
    found = re.findall(r"^```(\w+)\n(.*?)^```$|^ {4}(\S(?:[^\n]*\\\n)*[^\n]*)$", text, re.M | re.S)
    return [(kind or "sh", block or line) for kind, block, line in found if kind in ("", "python")]


def test_ci_runs_the_command_of_the_tests() -> None:
    assert ("sh", TESTS) in steps((ROOT / "README.md").read_text(encoding="utf-8"))
    script = (ROOT / ".ci" / "steps").read_text(encoding="utf-8")
    assert "'.[test]' && pytest" in script and "tests/test_readme.py" in script


@pytest.mark.slow
@pytest.mark.parametrize("pages", [PAGES[:1], PAGES], ids=["README", "pages"])
def test_every_line_runs_as_it_stands(pages: tuple[str, ...], tmp_path: Path) -> None:
    checkout, home = tmp_path / "knotgym", tmp_path / "home"
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", ROOT, checkout], check=True)
    home.mkdir()
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "PYTHONPATH", "MINARI_DATASETS_PATH", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    settings = Path.home() / ".config" / "pip" / "pip.conf"  # where this machine gets packages
    if settings.is_file():
        environment.setdefault("PIP_CONFIG_FILE", str(settings))
    environment["HOME"] = str(home)
    environment["PATH"] = f"{checkout / '.venv/bin'}{os.pathsep}{environment['PATH']}"
    run = {TESTS.replace(".venv/bin/", "")}
    for page in pages:
        for kind, text in steps((checkout / page).read_text(encoding="utf-8")):
            # a page may repeat a line of an earlier one, whose output is there already
            plain = re.sub(r"\.venv/bin/|\s+#.*", "", text).replace(
                "knotgym-generate", "knotgym generate"
            )
            if plain in run or text.startswith(UPLOADS):
                continue
            run |= {plain, *plain.split(" && ")}
            words = ["bash", "-euo", "pipefail", "-c", text]
            if kind == "python":
                if module := re.match(r"# (\w+\.py)\n", text):
                    (checkout / module[1]).write_text(text, encoding="utf-8")
                words = ["python", "-c", text]
            for site in checkout.glob(".venv/lib/python*/site-packages"):
                (site / "torch.pth").write_text(os.environ.get("KNOTGYM_TORCH", ""))
            began = time.monotonic()
            ended = subprocess.run(
                words, cwd=checkout, env=environment, capture_output=True, text=True, timeout=1800
            )
            print(f"{time.monotonic() - began:6.1f} s  {page}: {text.splitlines()[0]}", flush=True)
            said = f"{page}: {text}\n{ended.stdout[-1000:]}\n{ended.stderr[-2000:]}"
            assert ended.returncode == 0 and "Traceback" not in ended.stderr, said
    unknown = ["git", "status", "--porcelain"]  # git ignores what the lines make
    assert not subprocess.run(unknown, cwd=checkout, capture_output=True, check=True).stdout
    assert len(run) > 5 * len(pages)  # commands and blocks were found
    assert (checkout / "knotgym-data/nx3/states.h5").is_file()
    assert (checkout / "clone" / "policy.json").is_file()
