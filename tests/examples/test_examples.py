"""Every example runs at its smallest size; how well it learns is not tested."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pytest_types import Capture, Patch
from synthetic_pictures import picture_rows

from knotgym.datasets import PictureRow, parquet, read_rows
from knotgym.generate import ImagesConfig, make_images
from knotgym.rendering import AppearanceConfig
from knotgym.runs import RunOptions
from knotgym.states import read_states, shipped
from knotgym.topology import parse_codes

from ..scripts import ROOT, run_script

FOLDER = ROOT / "examples"


@pytest.mark.parametrize(
    ("words", "tasks", "said"),
    [
        ("32 generate --nx 4", (7, 1, 32), "generate --nx 4 --set run.shard=7/32"),
        ("32 generate --nx 4", (7, 7, 7), "generate --nx 4 --set run.shard=7/32"),  # alone
        ("32 generate --nx 4", (31, 0, 31), "tasks are numbered from 1 to 32, got 0 to 31"),
        ("generate --nx 4", (7, 1, 32), "the first argument is the number of shards"),
    ],
)
def test_a_task_of_an_array_is_one_shard_of_a_fixed_number(
    words: str, tasks: tuple[int, int, int], said: str, tmp_path: Path
) -> None:
    (tmp_path / "knotgym").write_text("#!/bin/bash\necho $*\n")
    (tmp_path / "knotgym").chmod(0o700)
    numbers = zip(("ID", "MIN", "MAX"), map(str, tasks), strict=True)
    given = {f"SLURM_ARRAY_TASK_{name}": number for name, number in numbers}
    # what the scheduler shows of this submission doesn't count
    given |= {"SLURM_ARRAY_TASK_COUNT": "1", "SLURM_CPUS_PER_TASK": "4"}
    path = f"{tmp_path}:{os.environ['PATH']}"
    command = ["bash", str(FOLDER / "slurm/array.sh"), *words.split()]
    run = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **given, "PATH": path}
    )
    assert said in run.stdout + run.stderr and run.returncode == 2 * ("run.shard" not in said)


@pytest.mark.clients
def test_the_notebook_makes_a_clone_that_beats_random(tmp_path: Path, monkeypatch: Patch) -> None:
    nbclient = pytest.importorskip("nbclient")
    for library in ("ipykernel", "torch"):
        pytest.importorskip(library)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    book = pytest.importorskip("nbformat").read(FOLDER / "quickstart.ipynb", as_version=4)
    place = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(book, timeout=1800, resources=place).execute()  # asserts it
    assert (tmp_path / "clone.gif").is_file()


def test_line_drawings_are_transcribed_to_pd_codes(tmp_path: Path, capsys: Capture) -> None:
    states = read_states(shipped(), images=False)
    chosen = [int(np.flatnonzero(states.nx == nx)[0]) for nx in (0, 1, 3, 4)]
    look = AppearanceConfig(name="line", vary=("turn",))
    rows = picture_rows(states.points[chosen], "test")
    (tmp_path / "table.parquet").write_bytes(parquet(PictureRow.drawn(rows, look)))
    answers = tmp_path / "answers.jsonl"
    script = FOLDER / "perception" / "transcribe.py"
    run_script(script, tmp_path / "table.parquet", "--out", answers)
    shown = capsys.readouterr().out.splitlines()
    assert shown[-1].split() == ["all", "4", "100.0", "%", "100.0", "%"]
    stored = read_rows(tmp_path / "table.parquet")
    for line, row in zip(answers.read_text().splitlines(), stored, strict=True):
        own = json.loads(line)
        assert own["pd_code"] == row["pd_code"] and own["right"]
        assert next(parse_codes([own["answer"]])).nx == row["nx"]


@pytest.mark.clients
def test_photos_are_read_and_a_reader_is_trained_on_them(tmp_path: Path, capsys: Capture) -> None:
    pytest.importorskip("torch")
    look = AppearanceConfig(name="photo")
    config = ImagesConfig(nx=(1, 2), count=8, test_nx=None, engine="chain", appearance=look)
    folder = make_images(config, tmp_path / "photos", RunOptions(workers=1, quiet=True))
    script = FOLDER / "perception" / "photos.py"
    for minutes in (0.03, 0.06):  # goes on from what it left
        own = "--minutes", minutes, "--batch", 2, "--states", "readable", "--out", tmp_path / "own"
        run_script(script, "train", *own)
    run_script(script, "read", folder, "--count", 2, "--views", 1, "--weights", tmp_path / "own")
    capsys.readouterr()
    run_script(script, "read", folder, "--page", tmp_path / "misread.png")
    [total] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("all")]
    assert total.split()[1] == "8" and float(total.split()[2]) > 70
