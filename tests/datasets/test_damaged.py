"""Datasets that are damaged, linked or hold infinity: every command answers with one line."""

import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pytest_types import Capture
from synthetic_episodes import TINY
from synthetic_pictures import picture_rows

from knotgym.common import InvalidFile
from knotgym.datasets import columns_of, locate, open_episodes, write_episodes
from knotgym.datasets.image_table import PictureRow, parquet, rows_of
from knotgym.datasets.merging import merge
from knotgym.rendering import AppearanceConfig
from knotgym.states import read_states, shipped

from ..small_job import knotgym

COMMANDS = {
    "show": (),
    "page": ("--out", "new.html"),
    "gallery": ("--out", "new.png"),
    "select": ("--sample", "1", "--out", "new.h5"),
    "split": ("--parts", "a=0.5,b=0.5", "--out", "new.h5"),
    "delete": ("--rows", "0", "--out", "new.h5"),
    "export": ("--to", "webdataset", "--out", "new"),
    "verify": (),
}


def refused(command: str, path: Path, capfd: Capture) -> str:
    """Run a command that must write nothing; return its one line, or what verify prints."""
    before = {*path.parent.iterdir()}
    words = [word.replace("new", str(path.parent / "new")) for word in COMMANDS[command]]
    if path.suffix == ".parquet":
        words = [word.replace("new.h5", "new.parquet") for word in words]
    assert knotgym("dataset", command, path, *words, "--quiet") == 1 + (command != "verify")
    said = capfd.readouterr()
    assert {*path.parent.iterdir()} == before and "Traceback" not in said.out + said.err
    lines = (said.out if command == "verify" else said.err).splitlines()
    assert lines[0].startswith("fault: ") if command == "verify" else len(lines) == 1
    return lines[0]


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """Rows of three pictures."""
    ropes = read_states(shipped(), images=False).points[[20, 70, 120]]
    return [*rows_of(PictureRow.drawn(picture_rows(ropes), AppearanceConfig(sizes=(64,))))]


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize("command", [*COMMANDS])
def test_cut_shards_are_refused(
    command: str, rows: list[dict[str, Any]], tmp_path: Path, capfd: Capture
) -> None:
    whole = parquet(rows)
    (tmp_path / "cut.parquet").write_bytes(whole[: len(whole) // 2])
    assert "isn't a whole Parquet shard" in refused(command, tmp_path / "cut.parquet", capfd)


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize("command", ["page", "split", "verify"])
def test_pictures_that_hold_infinity_are_one_line(
    command: str, rows: list[dict[str, Any]], tmp_path: Path, capfd: Capture
) -> None:
    spoilt = rows[1] | {"points": [float("inf"), *rows[1]["points"][1:]]}
    path = tmp_path / "a.parquet"
    path.write_bytes(parquet([rows[0], spoilt, rows[2]]))
    assert re.search("inf|finite", refused(command, path, capfd))


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize(
    ("command", "column"), [("page", "observation"), ("verify", "force"), ("verify", "reward")]
)
def test_infinity_is_one_line(command: str, column: str, tmp_path: Path, capfd: Capture) -> None:
    dataset = open_episodes(TINY["random"])
    values = np.array(dataset.episodes.steps[column])
    values[1] = np.inf
    steps = dataset.episodes.steps.replaced(**{column: values})
    changed = dataset.episodes._replace(steps=steps)
    write_episodes(tmp_path / "a.h5", [changed], dataset.task, dataset.facts)
    assert "finite" in refused(command, tmp_path / "a.h5", capfd)


@pytest.mark.parametrize("bytes_are_lost", [False, True])
def test_minari_s_damage_is_one_line(bytes_are_lost: bool, tmp_path: Path, capfd: Capture) -> None:
    merge([str(TINY["random"])], tmp_path, "a/b-v0")
    data = tmp_path / "a/b-v0/data"
    main_data = data / "main_data.hdf5"
    if bytes_are_lost:
        whole = bytearray(main_data.read_bytes())
        whole[200 : len(whole) // 2] = bytes(len(whole) // 2 - 200)
        main_data.write_bytes(whole)
    else:
        with h5py.File(main_data, "a") as file:
            del file["episode_1/actions"]
    assert "main_data.hdf5" in refused("verify", data.parent, capfd) or bytes_are_lost
    (data / "episodes.h5").unlink()  # as if Minari had recorded it
    assert knotgym("train", "--data", data.parent, "--out", tmp_path / "out", "--quiet") == 2
    assert len(capfd.readouterr().err.splitlines()) == 1


def test_no_reader_follows_a_link_to_episodes(tmp_path: Path) -> None:

    data = tmp_path / "a/b-v0/data"
    data.mkdir(parents=True)
    (data / "episodes.h5").symlink_to(TINY["random"])
    for read in (columns_of, lambda path: locate(str(path))):
        with pytest.raises(InvalidFile, match="link"):
            read(data.parent)
    shutil.copy(TINY["random"], tmp_path / "own.h5")
    (tmp_path / "mine.h5").symlink_to(tmp_path / "own.h5")  # that the user names
    assert columns_of(tmp_path / "mine.h5").episodes.episodes.rows


def test_a_shard_s_metadata_that_is_no_text_is_one_line(
    rows: list[dict[str, Any]], tmp_path: Path, capfd: Capture
) -> None:
    whole = parquet(rows)
    at = whole.rindex(b'{"')  # of the JSON in the footer
    (tmp_path / "a.parquet").write_bytes(whole[: at + 2] + b"\xa8" + whole[at + 3 :])
    assert "a.parquet" in refused("verify", tmp_path / "a.parquet", capfd)
