"""A command that is typed in somebody else's folder runs no code that lies there."""

import os
from pathlib import Path

import pytest

from .fresh_interpreter import python
from .small_job import SECONDS

PLANTED = (
    *("knotgym", "h5py", "numpy", "mujoco", "numba", "cv2", "minari", "gymnasium", "cyclopts"),
    "rich",
    *("pickle", "json", "threading", "signal", "selectors", "runpy", "tempfile", "random"),
    *("torch", "safetensors", "yaml", "openai", "distributed", "datasets", "pyarrow", "av"),
    *("sitecustomize", "usercustomize", "mine_too"),
)
COMMANDS = {
    "help": "--help",
    "collect": "collect --policy random --task unknot --nx 1 --episodes 9 --set task.horizon=2"
    " --out out --workers 2 --quiet",
    "evaluate": "evaluate --policy random --task unknot --nx 1 --episodes 9 --set task.horizon=2"
    " --workers 2 --quiet",
    "own policy": "evaluate --policy mine:act --task unknot --nx 1 --episodes 9"
    " --set task.horizon=2 --workers 2 --quiet",
    "verify": "dataset verify states.h5",
    "show": "dataset show states.h5",
    "page": "dataset page states.h5 --out page.html",
    "prompt": "prompt --mode open --show",
}
DEFAULT = ("help", "verify")  # of these, the others are thorough


@pytest.fixture
def planted(tmp_path: Path, states_path: str) -> Path:
    """A folder with a state file, a policy, and modules that leave a mark when they are run."""
    folder = tmp_path / "downloaded"
    folder.mkdir()
    mark = f"open({str(tmp_path / 'mark')!r}, 'a').write(__name__ + '\\n')\n"
    for name in PLANTED:
        (folder / f"{name}.py").write_text(mark)
    for name in ("knotgym", "multiprocessing", "concurrent"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(mark)
    (folder / "states.h5").write_bytes(Path(states_path).read_bytes())
    (folder / "beside.py").write_text("PULL = [0, 0, 0, 0, 0, 0]\n")
    (folder / "mine.py").write_text(
        "from beside import PULL\n\n\ndef act(observation):\n    return PULL\n"
    )
    # what an installer writes as the command; its folder, not the current one, is on the path
    command = tmp_path / "bin" / "knotgym"
    command.parent.mkdir()
    command.write_text(
        "import sys\nfrom knotgym.cli.program import main\n\n"
        "if __name__ == '__main__':\n    sys.exit(main())\n"
    )
    return folder


@pytest.mark.parametrize(
    "typed",
    [
        pytest.param(words, marks=() if name in DEFAULT else pytest.mark.thorough, id=name)
        for name, words in COMMANDS.items()
    ],
)
def test_no_command_imports_from_the_current_folder(typed: str, planted: Path) -> None:
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONSAFEPATH"}
    # machine code is kept as ever, or each command would compile
    environment.setdefault("XDG_CACHE_HOME", str(Path.home() / ".cache"))
    environment["HOME"] = str(planted.parent)
    words = planted.parent / "bin" / "knotgym", *typed.split()
    ended = python(*words, cwd=planted, env=environment, timeout=SECONDS)
    # the test's state file lacks columns, which is what `verify` says by its status
    assert ended.returncode == (1 if "verify" in typed else 0), ended.stderr
    mark = planted.parent / "mark"
    assert not mark.exists(), mark.read_text()
