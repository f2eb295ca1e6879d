"""Every benchmark runs, in the smallest size that it can have; none is asked how fast it was."""

import csv
import importlib.util
import json
import math
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock
from xml.etree import ElementTree

import numpy as np
import pytest

from knotgym.common.atomic_files import sha256
from knotgym.generate.states.archive import Archive
from knotgym.states.state_file import read_states, shipped, write_states

from ..scripts import ROOT, run_script
from ..small_job import knotgym

FOLDER = ROOT / "benchmarks"
MODULES = {
    "checkpoint_readers",
    "damaged_files",
    "damaged_hdf5",
    "damaged_json",
    "file_readers",
    "picture_check",
    "pulled",
    "rope_states",
    "told",
}  # what the scripts share
SCRIPTS = sorted(path for path in FOLDER.glob("*.py") if path.stem not in MODULES)
EXTRAS = ("torch", "torch.utils", "torch.utils.data", "warp", "mujoco_warp")

with_torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch isn't installed"
)


def numbers(value: Any) -> Iterator[float]:
    """Every number in a JSON value, at any depth."""
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from numbers(inner)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def figures(name: str, folder: Path, *words: object) -> dict[str, Any]:
    """What a benchmark writes to --out; every number in it is finite."""
    out = folder / f"{name}.json"
    run_script(FOLDER / f"{name}.py", *words, "--out", out)
    written: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    assert list(numbers(written)) and all(map(math.isfinite, numbers(written)))
    return written


def test_there_are_benchmarks() -> None:
    assert len(SCRIPTS) >= 17 and all((FOLDER / f"{name}.py").is_file() for name in MODULES)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_every_benchmark_says_how_to_use_it(
    script: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for extra in EXTRAS:  # these take seconds to import, and need not be installed
        monkeypatch.setitem(sys.modules, extra, mock.MagicMock())
    with pytest.raises(SystemExit) as ended:
        run_script(script, "--help")
    assert ended.value.code == 0 and f"usage: {script.name}" in capsys.readouterr().out
    assert f"\n    python benchmarks/{script.name}" in script.read_text(encoding="utf-8")


def test_sentences_are_drawn_by_a_seed(capsys: pytest.CaptureFixture[str]) -> None:
    few = ("--seed", 1, "--docstrings", 2, "--errors", 2, "--helps", 1, "--pages", 1)
    drawn = []
    for _ in range(2):
        run_script(FOLDER / "sentences.py", *few)
        drawn.append(capsys.readouterr().out)
    assert drawn[0] == drawn[1]
    assert [line.split(",")[0] for line in drawn[0].splitlines() if line.startswith("== ")] == [
        "== docstrings",
        "== errors",
        "== helps",
        "== pages",
    ]


@pytest.mark.slow  # tests/topology/test_reference_labeller.py is its fast twin
def test_both_labellers_agree_on_fourier_curves(tmp_path: Path) -> None:
    written = figures("codes", tmp_path, "--curves", 16, "--ropes", 0)
    curves = written["results"]["Fourier curves"]
    assert curves["agreed"] == curves["curves"] == 16 and curves["disagreements"] == []


@pytest.mark.slow
def test_the_expert_benchmark_plays_and_goes_on_after_what_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--random-episodes", 2, "--tasks", "tie", "--nx", 2, "--workers", 1, "--episodes")
    assert figures("expert", tmp_path, *words, 0)["tie-nx2 random"]["result"]["episodes"] == 2
    assert "tie-nx2 random: " in capsys.readouterr().out
    figures("expert", tmp_path, *words, 0)
    assert "tie-nx2 random: " not in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["knot", "walks", "recorded", "pictures"])
def test_the_same_small_run_has_the_same_digests(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words, before = ("--kinds", kind, "--out"), tmp_path / "before.json"
    run_script(FOLDER / "golden.py", *words, before)
    with pytest.raises(SystemExit) as ended:
        run_script(FOLDER / "golden.py", *words, tmp_path / "after.json", "--compare", before)
    assert ended.value.code == 0 and "nothing differs" in capsys.readouterr().out


@pytest.mark.slow
def test_every_variant_of_the_model_is_stepped_and_ours_is_where_ours_is(tmp_path: Path) -> None:
    models = figures("physics", tmp_path, "--starts", 1, "--repeats", 1)["models"]
    assert len(models) == 11
    assert models["ours: rooted in the middle"]["apart_mm"] == [0, 0]


def test_pictures_of_every_size_and_camera_are_drawn(tmp_path: Path) -> None:
    rows = figures("picture", tmp_path, "--frames", 1, "--renderers", "opencv")["rows"]
    assert len(rows) == 8 and all(row["opencv_ms"] > 0 for row in rows)


def test_the_published_environment_steps_beside_ours(tmp_path: Path) -> None:
    words = ("--steps", 1, "--repeats", 1, "--modes", "state")
    sides = figures("published", tmp_path, *words)["modes"]["state"]
    assert sides.keys() == {"published", "ours, 24 steps", "ours, 20 steps"}


@pytest.mark.parametrize("engine", ["mujoco", "chain"])
def test_hard_play_is_looked_at_and_goes_on_after_what_is_done(engine: str, tmp_path: Path) -> None:
    words = ("--engine", engine, "--ropes", 2, "--length", 1, "--actions")
    played = [figures("long_play", tmp_path, *words, count) for count in (6, 12)]
    assert [one["way"] for one in played[1]["slices"]] == [
        *("random", "one bead", "neighbours", "through", "tow", "across")
    ]
    assert played[1]["slices"][:3] == played[0]["slices"]
    assert not any(one["breaks"] for one in played[1]["slices"])


def test_evaluations_make_the_table_of_learners(tmp_path: Path) -> None:
    page, out = tmp_path / "page.md", tmp_path / "table.csv"
    words = ("evaluate", "--task", "tie", "--horizon", 1, "--workers", 1, "--quiet")

    def measured(name: str, *more: object) -> Path:
        assert knotgym(*words, *more, "--out", tmp_path / name) == 0
        return tmp_path / name

    def made(*files: Path) -> list[dict[str, str]]:
        run_script(FOLDER / "results.py", *files, "--page", page, "--out", out)
        with out.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    one = measured("one.json", "--episodes", 2)
    (row,) = made(one)
    assert (row["policy"], row["task"], row["nx"], row["episodes"]) == ("random", "tie", "2", "2")
    assert row["states_sha256"] == sha256(shipped()) and row["code_sha256"] and row["commit"]
    assert 0 == float(row["low"]) < float(row["high"]) and int(row["starts"]) <= 2
    assert row["settings"] == "horizon=1"
    assert row["command"] == (
        "knotgym evaluate --policy random --task tie --nx 2 --split test --episodes 2 --seed 0"
        " --horizon 1"
    )
    before = page.read_text()
    assert "| random | horizon=1 |" in before and "of 2)" in before
    made()
    assert page.read_text() == before  # from the table alone
    (row,) = made(measured("more.json", "--episodes", 3))  # instead of the earlier measurement
    assert row["episodes"] == "3"
    (row,) = made(one, measured("other.json", "--episodes", 2, "--seed", 1))
    assert row["episodes"] == "4" and row["seeds"] == "[0, 1]"
    with pytest.raises(SystemExit, match="repeats episodes of random, readable, test, tie, 2"):
        made(one, one)
    told = json.loads(one.read_text())
    told["digests"]["versions"]["code"] = "0" * 64
    one.write_text(json.dumps(told))
    with pytest.raises(SystemExit, match="measured with code 00000000, and this checkout has"):
        made(one)


def test_cells_of_the_benchmark_are_measured_into_its_table(tmp_path: Path) -> None:
    ran: list[list[str]] = []
    words = ("--only", "expert", "--episodes", "expert=2", "--out", tmp_path)
    with mock.patch("subprocess.run", lambda told, check: ran.append(told)):
        run_script(FOLDER / "measure.py", *words)
    assert len(ran) == 10 and {"--resume", "expert", "2"} <= set(ran[0])
    assert ran[-1][1].endswith("results.py")


def test_trainings_make_a_picture(tmp_path: Path) -> None:
    task = {"task": "tie", "nx": 2, "observation": "state", "states": None}
    counts = {"episodes": 4, "successes": 1, "mean_return": -2.5, "mean_length": 50.0}
    rows = [{"steps": 8 * k, **counts, "seconds": k, "cpu_seconds": k} for k in (1, 2, 3)]
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "ppo.json").write_text(json.dumps({"task": task}))
        written = {"resumed_at": [], "rows": rows}
        (tmp_path / name / "curve.json").write_text(json.dumps(written))
    words = (tmp_path / "one", tmp_path / "other", "--window", 16, "--out", tmp_path / "curves")
    run_script(FOLDER / "training_curves.py", *words)
    ElementTree.fromstring((tmp_path / "curves.svg").read_text())
    one, other = json.loads((tmp_path / "curves.json").read_text())
    assert one == other and one["steps_per_second"] == 8
    assert [(row["steps"], row["episodes"]) for row in one["rows"]] == [(16, 8), (24, 4)]
    with pytest.raises(SystemExit, match="isn't a training"):
        run_script(FOLDER / "training_curves.py", tmp_path, "--out", tmp_path / "curves")


def test_a_collection_is_timed(tmp_path: Path) -> None:
    words = ("--jobs", "state", "--workers", 1, "--repeats", 1, "--episodes", 1)
    assert figures("scaling", tmp_path, *words)["seconds"]["state"]["1"] > 0


def test_raw_mujoco_ends_where_the_environment_does(tmp_path: Path) -> None:
    modes = figures(
        "step", tmp_path, "--steps", 2, "--repeats", 1, "--vector-steps", 1, "--ropes", 2
    )["modes"]
    assert modes.keys() == {"state", "pixels", "both"}
    assert all(mode["raw_share"] > 0 for mode in modes.values())


def test_every_function_with_a_stopwatch_is_there() -> None:
    stages = runpy.run_path(str(FOLDER / "stages.py"))
    for stage, names in stages["WATCHED"].items():
        assert stage in stages["STAGES"] and names
        for name in names:
            holder, function = stages["holder_of"](name)
            assert callable(getattr(holder, function)), name


def test_fixed_actions_tow_with_and_without_a_bound(tmp_path: Path) -> None:
    sizes = ("--episodes", 1, "--directions", 1, "--nx", 2, "--limits", 0.001)
    (setup,) = figures("towing", tmp_path, *sizes).values()
    assert setup["constant"] == 0 and setup["untied"].keys() == {
        "constant",
        "base (-1, -1, -1)",
        "origin (-1, -1, -1)",
    }


@pytest.mark.slow
def test_an_archive_tells_how_far_it_reaches(searched: Archive, tmp_path: Path) -> None:
    searched.save(tmp_path / "archive.h5")
    reached = figures("ways", tmp_path, tmp_path / "archive.h5", "--most-nx", 1)["nx"]
    assert reached["0"]["led_to"] == 1 and 0 < reached["1"]["led_to"] <= reached["1"]["there_are"]


@pytest.mark.slow
def test_the_transitions_of_an_archive_make_a_table(searched: Archive, tmp_path: Path) -> None:
    searched.save(tmp_path / "archive.h5")
    words = ("--seeds", "--rounds", "--archive", tmp_path / "archive.h5", "--workers", 1)
    run_script(FOLDER / "transitions.py", *words, "--out", tmp_path / "transitions.h5")
    assert (tmp_path / "transitions.h5").stat().st_size > 0


# Seconds each, for the ropes they look at have to be tangled first, or processes have to start.


@pytest.mark.slow
def test_a_collection_that_is_killed_ends_with_the_same_bytes(tmp_path: Path) -> None:
    told = figures("kills", tmp_path, "--kinds", "collect", "--kills", 1)["collect"]
    assert told["kills"] == told["finished"] == 1 and told["faults"] == []


@pytest.mark.slow
def test_changed_bytes_of_every_column_are_told(tmp_path: Path) -> None:
    path = tmp_path / "states.h5"
    write_states(path, read_states(shipped()).taken(np.array([1])))
    told = figures("byte_classes", tmp_path, "--states", path, "--count", 1)["states"]
    assert told.keys() >= {"qpos", "points", "image", "source/seed", "the library's own"}
    assert told["points"]["caught"] == 1


@pytest.mark.slow
def test_a_page_of_borderline_pictures_is_drawn(tmp_path: Path) -> None:
    run_script(FOLDER / "borderline.py", "--states", 40, "--out", tmp_path / "borderline.png")
    assert (tmp_path / "borderline.png").stat().st_size > 1000


@pytest.mark.slow
def test_both_labellers_agree_on_tangled_ropes(tmp_path: Path) -> None:
    ropes = figures("codes", tmp_path, "--curves", 1, "--ropes", 40)["results"]["rope states"]
    assert ropes["agreed"] == ropes["curves"] == 40


@pytest.mark.slow
def test_the_strand_on_top_is_the_one_labelled_over(tmp_path: Path) -> None:
    for shown in figures("truth", tmp_path, "--states", 20)["crossings"].values():
        assert shown["over"] > 0 and "under" not in shown


@pytest.mark.slow
def test_a_collection_is_timed_and_its_files_are_those_of_one_worker(tmp_path: Path) -> None:
    words = ("--jobs", "state", "pixels", "--workers", 1, 2, "--repeats", 1, "--episodes", 2)
    assert figures("scaling", tmp_path, *words)["seconds"].keys() == {"state", "pixels"}


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="pyarrow isn't installed")
def test_every_stage_of_a_collection_and_of_pictures_has_its_share(tmp_path: Path) -> None:
    words = ("--jobs", "state", "pixels", "images", "--workers", 1, "--clock", "cpu")
    sizes = ("--episodes", 1, "--pictures", 4)
    shares = figures("stages", tmp_path, *words, *sizes)["shares"]
    assert shares.keys() == {"state", "pixels", "images"}
    assert all(0 < share["mj_step"] < 1 for share in shares.values())
    assert shares["images"]["picture"] > 0 and shares["images"]["quality"] > 0


@pytest.mark.slow
def test_a_search_of_one_round_makes_a_table_of_transitions(tmp_path: Path) -> None:
    words = ("--seeds", 0, "--rounds", 1, "--workers", 1, "--out", tmp_path / "transitions.h5")
    run_script(FOLDER / "transitions.py", *words)
    assert (tmp_path / "transitions.h5").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs /proc")
def test_memory_is_measured_at_every_stage(tmp_path: Path) -> None:
    stages = figures("memory", tmp_path, "--frames", 5100)["stages"]
    assert len(stages) == 7 and all(stage["peak_mb"] > 0 for stage in stages.values())


@pytest.mark.slow
@with_torch
def test_frames_are_read_at_random(tmp_path: Path) -> None:
    words = ("--frames", 5000, "--reads", 20, "--workers", 0)
    reading = figures("loaders", tmp_path, *words)["reading"]
    assert reading.keys() == {"pixels", "pixels drawn when read", "state"}


@pytest.mark.slow
def test_random_batches_are_timed_by_every_way(tmp_path: Path) -> None:
    rates = figures("batches", tmp_path, "--frames", 100, "--seconds", 0.01)["batches"]
    assert {"dataset, read", "dataset, drawn", "memory map", "cache"} <= rates.keys()
    assert all(one["batches"] >= 1 for one in rates.values())


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("mujoco_warp") is None, reason="mujoco-warp isn't installed"
)
def test_the_gpu_port_takes_the_rope_with_another_solver(tmp_path: Path) -> None:
    assert figures("gpu_port", tmp_path)["warp over CPU, ours, farthest bead, m"] < 1e-3


@pytest.mark.gl
def test_pixels_of_the_published_environment_are_timed_beside_ours(tmp_path: Path) -> None:
    words = ("--steps", 1, "--repeats", 1, "--modes", "pixels")
    assert figures("published", tmp_path, *words)["modes"]["pixels"]["published"]["ms"] > 0


@pytest.mark.slow
def test_walks_from_both_starts_are_measured(tmp_path: Path) -> None:
    found = figures("stationary", tmp_path, "--ropes", 2, "--actions", 20, "--every", 20)
    (row,) = found["rows"]
    assert row["coil"]["radius"][0] < row["circle"]["radius"][0]


@pytest.mark.clients
def test_the_adapters_race_their_likes(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    rates = figures("adapters", tmp_path, "--envs", 2, "--steps", 1, "--repeats", 1)
    assert {*rates["steps_a_second"]["state"]} == {"sb3_vec_env", "DummyVecEnv", "SubprocVecEnv"}


@pytest.mark.clients
def test_ppo_collects_rollouts_of_pictures_on_each(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    words = ("--envs", 2, "--rollout", 32, "--repeats", 1, "--image-size", 36)
    found = figures("ppo_rollouts", tmp_path, *words, "--start", "forkserver")
    assert {*found["clock"]} == {*found["CPU"]} >= {"sb3_vec_env", "SubprocVecEnv"}


@pytest.mark.slow
def test_drawings_of_random_codes_and_of_knots_are_counted(tmp_path: Path) -> None:
    page = tmp_path / "page.png"
    few = ("crossings", "--nx", 2, "--codes", 2, "--drawings", 1, "--page", page)
    rows = figures("drawn", tmp_path, *few)["rows"]
    assert len(rows) == 2 and all(row["at_256"] >= row["at_128"] for row in rows.values())
    assert page.exists() == any(row["at_256"] for row in rows.values())
    (tmp_path / "drawn.json").unlink()
    knots = figures("drawn", tmp_path, "knots", "--knots", "3_1", "--drawings", 3)["rows"]
    assert knots["3_1"]["laid"]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("speed", ("--ropes", 4, "--repeats", 1)),
        ("distance", ("--states", 1)),
        ("play", ("--ropes", 2)),
    ],
)
def test_the_chain_engine_is_measured_beside_mujocos(
    command: str, words: tuple[object, ...], tmp_path: Path
) -> None:
    results = figures("chain", tmp_path, command, *words)["results"]
    if command == "distance":
        assert results["apart, mm"]["after 1"] < 1.2 and results["apart, mm"]["after 4"] < 5
