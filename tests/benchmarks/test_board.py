"""A stranger's policy is entered by the lines of docs/board.md alone; forgeries change nothing."""

import hashlib
import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Capture, Patch

from knotgym.common import Column, Schema, Table, as_json, sha256, write_tables
from knotgym.control import PolicyConfig
from knotgym.envs import TaskConfig
from knotgym.generate import EvaluateConfig
from knotgym.rope import RopeConfig
from knotgym.states import resolve_states

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
    assert "farthest bead" in said and "256 episodes" in said and "no faults" in said
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


COUNT = 256
# the format of entries that an earlier version wrote, which needs no starts
ROWS = Schema("episodes", (Column("length", "uint32"), Column("digest", "uint8", (8,))))
PULLED = Schema("steps", (Column("bead", "uint16"), Column("bins", "int8", (3,))))
Said = dict[str, Any]


def synthetic(folder: Path, name: str, change: Callable[[Said], object], first: int = 0) -> None:
    """Write an entry of one pull an episode, changed, and what the ledger says that it scored."""
    task = TaskConfig(task="tie", states="bench", engine="chain", observation="marked")
    own = PolicyConfig(policy="mine:act")
    config = EvaluateConfig(policies=(own,), task=task, episodes=COUNT, protocol="code")
    training = {"learner": name, "data": {"a/tie-nx2/noisy-chain-bench-100k-v0": "0"}, "seed": 0}
    said: Said = {
        "config": as_json(config),
        "states": {"bench": sha256(resolve_states("bench"))},
        "rope": RopeConfig().fingerprint,
        "claimed": [{"action": "pull", "observation": "marked", "training": training}],
    }
    change(said)
    rows = said.pop("rows", COUNT)
    numbers = np.arange(first, first + rows, dtype=np.uint64).astype(">u8").view(np.uint8)
    lengths = np.ones(rows, np.uint32)
    table = Table(ROWS, {"length": lengths, "digest": numbers.reshape(-1, 8)})
    forces = np.zeros((rows, 3), np.int8)
    pulls = Table(PULLED, {"bead": np.zeros(rows, np.uint16), "bins": forces})
    whole = json.dumps(said, sort_keys=True) + table.digest() + pulls.digest()
    said["digest"] = hashlib.sha256(whole.encode()).hexdigest()
    path = folder / "benchmarks" / "entries" / f"{name}.h5"
    write_tables(path, [table, pulls], said, format="knotgym-entry", version=1, pack=True)
    place = folder / "benchmarks" / "ledger.json"
    ledger = json.loads(place.read_text())
    ledger["entries"][path.name] = {"sha256": sha256(path), "success": ["10" * (COUNT // 2)]}
    place.write_text(json.dumps(ledger))


def _set(*place: str | int, **values: Any) -> Callable[[Said], object]:
    """Change values at a place in what an entry says."""

    def change(said: Any) -> None:
        for name in place:
            said = said[name]
        said.update(values)

    return change


BOMB = [as_json(PolicyConfig(policy=f"a{k}:b")) for k in range(3000)]
MARKUP = "a | **100** |\n| b | 1 |<script>x</script> **DiscreteBC** [x](y) `a`"
# what a forgery is, how it is made, and what refuses it; None: it stands as text, in its own row
FORGERIES: dict[str, tuple[Callable[[Said], object], str | None]] = {
    "horizon": (_set("config", "task", horizon=2000), "protocol code has task.horizon "),
    "rope": (_set("config", "task", rope={"max_force": 0.4}), "protocol code has task.rope "),
    "split": (_set("config", splits=["train"]), "protocol code has split "),
    "subset": (
        lambda said: (_set("config", episodes=240)(said), said.update({"rows": 240})),
        "at least 256 episodes, got 240",
    ),
    "no protocol": (_set("config", protocol="", seed=9), "names no protocol; .*seed 0, got 9"),
    "sees the goal": (_set("claimed", 0, observation="state"), "observes state"),
    "list of trainings": (_set("claimed", 0, training=[1]), "isn't an object"),
    "random's name": (_set("config", "policies", 0, policy="random"), "random|ends otherwise"),
    "expert's name": (_set("config", "policies", 0, policy="expert"), "known run|ends otherwise"),
    "bomb of setups": (_set("config", policies=BOMB, tasks=["tie"] * 3000), "at most 4096 setups"),
    "bomb of episodes": (_set("config", episodes=10**9), "asks for"),
    "15 of 16 episodes": (lambda said: None, "hold the same episodes"),
    "markup": (_set("claimed", 0, "training", learner=MARKUP), None),
    "list of learners": (_set("claimed", 0, "training", learner=["a"]), None),
    "list of data": (_set("claimed", 0, "training", data=["a"]), None),
}


@pytest.fixture
def board(tmp_path: Path) -> Path:
    """A folder with one honest entry, its ledger and the pages."""
    (tmp_path / "benchmarks" / "entries").mkdir(parents=True)
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "README.md", tmp_path)
    rows = {"tie 2": [[0] * COUNT, [*range(COUNT)]]}
    (tmp_path / "benchmarks" / "ledger.json").write_text(
        json.dumps({"episodes": rows, "entries": {}})
    )
    synthetic(tmp_path, "DiscreteBC", lambda said: None)
    return tmp_path


def made(board: Path) -> list[str]:
    """The tables of the board and README, made again."""
    run_script(
        ROOT / "benchmarks/results.py", "--root", board, "--entries", board / "benchmarks/entries"
    )
    pages = (board / "docs/benchmark.md").read_text() + (board / "README.md").read_text()
    return [line for line in pages.splitlines() if line.startswith("|")]


@pytest.mark.thorough
@pytest.mark.parametrize("kind", FORGERIES)
def test_a_forgery_is_refused_by_name_or_changes_no_other_row(kind: str, board: Path) -> None:
    pytest.importorskip("scipy")
    before, (change, said) = made(board), FORGERIES[kind]
    first = COUNT // 16 if kind == "15 of 16 episodes" else COUNT
    synthetic(board, "forged", change, first)
    if "name" in kind:  # such a policy is played again, whatever the ledger says
        place = board / "benchmarks" / "ledger.json"
        ledger = json.loads(place.read_text())
        del ledger["entries"]["forged.h5"]
        place.write_text(json.dumps(ledger))
    if said is not None:
        with pytest.raises(SystemExit, match=f"^forged.h5 .*(?:{said})"):
            made(board)
        return
    after = made(board)
    assert [line for line in after if line not in before] != []
    assert [line for line in before if line not in after and "**50.0**" in line] == []
    new = "\n".join(line for line in after if line not in before)
    assert len([line for line in after if "**50.0**" in line]) == 2
    assert not re.search(r"<script|\*\*DiscreteBC|(?<!\\)\[x|(?<!\\)`a", new)
