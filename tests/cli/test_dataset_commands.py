"""`knotgym dataset ...` on a tiny collection and on a set of states that ships."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Capture, Patch
from synthetic_episodes import TINY

from knotgym.common import Counts
from knotgym.datasets import merge
from knotgym.runs import Progress
from knotgym.states import shipped

from ..conftest import trefoil
from ..small_job import knotgym

ID = "knotgym/tie-nx2/both-v0"
STATES = shipped("hard-unknots")


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with six short episodes."""
    root = tmp_path_factory.mktemp("root")
    merge([str(one) for one in TINY.values()], root, ID)
    return root


@pytest.fixture(autouse=True)
def minari_root(collected: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(collected))


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize(
    ("command", "source", "said"),
    [
        ("show", ID, ID),
        ("show", STATES, "8 states"),
        ("show", "{root}/" + ID, "episodes"),
        ("verify", ID, "6 episodes, 102 steps replayed, 3 checksums: no faults\n"),
        ("verify", STATES, "8 Gauss codes: no faults\n"),
    ],
)
def test_show_and_verify_take_an_id_or_a_path_and_say_what_they_found(
    command: str, source: str, said: str, collected: Path, capfd: Capture
) -> None:
    assert knotgym("dataset", command, str(source).format(root=collected)) == 0
    assert said in capfd.readouterr().out


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize(
    ("words", "stages"),
    [
        (("verify", ID), ("episodes played again", "codes read again", "comparing Minari's form")),
        (("merge", *TINY.values(), "--id", "a/b-v0", "--out"), ("writing Minari's form",)),
        (("export", ID, "--to", "ogbench", "--out"), ("drawing episodes",)),
        (("export", ID, "--to", "minari", "--out"), ("copying datasets",)),
        (("page", ID, "--out"), ("episodes of the page",)),
        (("page", STATES, "--out"), ("shapes of the page",)),
        (("import", "curve.csv", "--out"), ("relaxing curves",)),
    ],
)
def test_what_takes_long_with_much_data_counts_what_is_done(
    words: tuple[str | Path, ...], stages: tuple[str, ...], tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savetxt("curve.csv", trefoil(), delimiter=",")
    told: dict[str, list[tuple[float, int]]] = {}

    def hear(_: Any, stage: str, done: Counts.Done = 0, total: int = 0, **more: Any) -> None:
        if total:
            told.setdefault(stage, []).append((done() if callable(done) else done, total))

    monkeypatch.setattr(Progress, "stage", hear)
    ends = {"page": "a.html", "import": "a.h5"}
    out = [next((end for name, end in ends.items() if name in words), "out")]
    assert knotgym("dataset", *words, *(out if "--out" in words else [])) == 0
    for stage in stages:
        assert all(0 <= done <= total for done, total in told[stage])
        assert len(told[stage]) > 1 or told[stage][0][0] == 0


def test_without_out_they_stand_beside_what_they_show(tmp_path: Path) -> None:
    copy = shutil.copy(STATES, tmp_path)
    assert knotgym("dataset", "gallery", copy, "--quiet") == 0
    assert (tmp_path / "gallery.png").is_file()


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ("select {states} --where nx>10 --out {new}/a.h5", "a.h5: 2 of 8 rows"),
        ("split {states} --parts a=0.5,b=0.5 --out {new}/a.h5", "of 8 rows"),
        ("delete {states} --rows 0,2-3 --out {new}/a.h5", "a.h5: 5 of 8 rows"),
        ("merge {states} --out {new}/a.h5", "a.h5: 8 states"),
        ("select {id} --where length>2 --sample 2 --out {new}/a.h5", "2 of 6 rows"),
        ("merge {id} --id a/b-v0 --out {new}", "a/b-v0: 6 episodes"),
        ("gallery {id} --out {new}/a.png", "a.png: "),
        ("replay {states} --out {new}/a.gif", "a.gif: bit for bit the same, "),
        ("replay {id} --out {new}/a.gif", "a.gif: bit for bit the same, "),
        ("export {id} --out {new}/a.h5", "a.h5: 6 episodes"),
        ("export {id} --to ogbench --out {new}/a", "a: 6 episodes for ogbench"),
        ("export {id} --to minari --out {new}/a", "a: a Minari root with 1 datasets"),
    ],
)
def test_datasets_are_cut_and_joined(words: str, made: str, tmp_path: Path, capfd: Capture) -> None:
    typed = words.format(states=STATES, id=ID, new=tmp_path).split()
    assert knotgym("dataset", *typed) == 0
    assert made in capfd.readouterr().out and any(tmp_path.iterdir())
    assert knotgym("dataset", *typed) == 2  # what is there stays
    assert "--overwrite" in capfd.readouterr().err
