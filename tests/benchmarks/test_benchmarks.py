"""Every benchmark runs, in the smallest size that it can have; none is asked how fast it was."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Capture

from knotgym.common import sha256
from knotgym.control import Moves

from ..scripts import ROOT, run_script

FOLDER = ROOT / "benchmarks"
TABLES = ROOT / "knotgym/control/planning/data"
MODULES = {"commands", "picture_check", "rope_states"}  # what the scripts share
SCRIPTS = sorted(path for path in FOLDER.glob("*.py") if path.stem not in MODULES)


def figures(name: str, folder: Path, *words: object) -> dict[str, Any]:
    """What a benchmark writes to --out; every number in it is finite."""
    out = folder / f"{name}.json"
    run_script(FOLDER / f"{name}.py", *words, "--out", out)
    text = out.read_text(encoding="utf-8")
    assert re.search(r"\d", text) and not re.search(r"\b(NaN|Infinity)\b", text)
    written: dict[str, Any] = json.loads(text)
    return written


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_every_benchmark_says_how_to_use_it(script: Path, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as ended:
        run_script(script, "--help")
    assert ended.value.code == 0 and f"usage: {script.name}" in capsys.readouterr().out
    assert f"\n    python benchmarks/{script.name}" in script.read_text(encoding="utf-8")


@pytest.mark.thorough
def test_golden_runs_make_the_arrays_that_they_made(capsys: Capture) -> None:
    with pytest.raises(SystemExit) as ended:
        run_script(FOLDER / "golden.py", "--compare", ROOT / "tests/data/golden.json")
    assert ended.value.code == 0, capsys.readouterr().out


@pytest.mark.slow
def test_the_page_of_the_benchmark_is_made_from_its_entries() -> None:
    pytest.importorskip("scipy")
    run_script(FOLDER / "results.py", "--check")
    assert sum(path.stat().st_size for path in (FOLDER / "entries").iterdir()) < 10_000_000


def test_raw_mujoco_ends_where_the_environment_does(tmp_path: Path) -> None:
    modes = figures(
        "step", tmp_path, "--steps", 2, "--repeats", 1, "--vector-steps", 1, "--ropes", 2
    )["modes"]
    assert modes.keys() == {"state", "pixels", "both"}
    assert all(mode["raw_share"] > 0 for mode in modes.values())


# Seconds each, for the ropes they look at have to be tangled first, or processes have to start.


@pytest.mark.slow
def test_a_collection_that_is_killed_ends_with_the_same_bytes(tmp_path: Path) -> None:
    told = figures("kills", tmp_path, "--kinds", "collect", "--kills", 1)["collect"]
    assert told["kills"] == told["finished"] == 1 and told["faults"] == []


@pytest.mark.slow
def test_commands_at_once_leave_one_output_and_a_changed_byte_is_found(tmp_path: Path) -> None:
    told = figures("together", tmp_path, "--kinds", "select", "--rounds", 1)["select"]
    assert told["rounds"] == 1 and told["faults"] == []
    told = figures("damage", tmp_path, "--kinds", "columns", "--changes", 2)["columns"]
    assert told["bytes"] > 0 and told["faults"] == []


@pytest.mark.slow
def test_the_strand_on_top_is_the_one_labelled_over(tmp_path: Path) -> None:
    for picture, shown in figures("truth", tmp_path, "--states", 20)["crossings"].items():
        # where a pixel is as wide as the rope, one crossing in fifty shows the lower strand
        most = 0.1 * shown["over"] if picture.endswith(" 64") else 0
        assert shown["over"] > 0 and shown.get("under", 0) <= most


def outcomes(moves: Moves) -> dict[Any, dict[Any, int]]:
    """How often each pass at each diagram led to each other diagram."""
    found: dict[Any, dict[Any, int]] = {}
    for before, move, after, seen, _ in moves.rows.tolist():
        key = moves.nodes[before], moves.templates[move]
        found.setdefault(key, {})[moves.nodes[after]] = seen
    return found


@pytest.mark.slow
@pytest.mark.parametrize("table", sorted(path.name for path in TABLES.glob("*.h5")))
def test_a_little_play_makes_a_table_like_the_one_that_ships(table: str, tmp_path: Path) -> None:
    few = ("--episodes", 8, "--rounds", 1, "--pulls", 500, "--most", 10**6, "--least", 1)
    for name in ("one.h5", "two.h5"):
        words = (table, "--first", TABLES / table, "--out", tmp_path / name, *few)
        run_script(FOLDER / "moves.py", *words)
    assert sha256(tmp_path / "one.h5") == sha256(tmp_path / "two.h5")
    made, known = (outcomes(Moves.load(path)) for path in (tmp_path / "one.h5", TABLES / table))
    found = expected = 0.0
    for key in made.keys() & known.keys():
        likeliest = max(known[key], key=lambda after: known[key][after])
        count = sum(seen for after, seen in made[key].items() if after in known[key])
        found += made[key].get(likeliest, 0)
        expected += count * known[key][likeliest] / sum(known[key].values())
    # a few ropes, and images of a pass count several times: 0.79 for passes.h5
    assert expected > 100 and 0.6 < found / expected < 1.4


@pytest.mark.parametrize(
    ("command", "words"), [("speed", ("--ropes", 4, "--repeats", 1)), ("distance", ("--states", 1))]
)
def test_the_chain_is_measured(command: str, words: tuple[object, ...], tmp_path: Path) -> None:
    results = figures("chain", tmp_path, command, *words)["results"]
    if command == "distance":
        assert results["apart, mm"]["after 1"] < 1.2 and results["apart, mm"]["after 4"] < 5


@pytest.mark.slow
def test_labels_are_counted_and_counting_goes_on(tmp_path: Path) -> None:
    for chunks in (1, 2):
        words = ("--chunk", 64, "--frames", 64 * chunks)
        counts = figures("labels", tmp_path, *words)["counts"]
        assert (
            sum(count for way, count in counts.items() if way.endswith("labelled")) == 64 * chunks
        )
        assert not any(count for way, count in counts.items() if way.endswith("wrong"))
