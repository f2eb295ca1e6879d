"""`knotgym read`: rows of photos as JSON and CSV, overlays, files that can't be read."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from knotgym.learn import read_photo
from knotgym.photos import photograph
from knotgym.states import read_states, shipped
from knotgym.topology import label

from ..small_job import knotgym

pytestmark = pytest.mark.clients


def test_photos_are_read_into_json_and_csv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    states, photos = read_states(shipped("bench"), images=False), tmp_path / "photos"
    photos.mkdir()
    points = states.points[states.rows(2, "test")[1]]
    shot = photograph(points, 256, np.random.default_rng(1), tilt=0)
    assert shot is not None
    Image.fromarray(shot.image).save(photos / "a.png")
    wire = np.full((200, 300, 3), 30, np.uint8)
    cv2.line(wire, (40, 60), (250, 130), (220, 220, 220), 8, cv2.LINE_AA)
    Image.fromarray(wire).save(photos / "b.jpg")
    (photos / "c.png").write_bytes(b"none")
    (photos / "notes.txt").write_text("no picture")
    json_file, seen = tmp_path / "codes.json", tmp_path / "seen"
    assert knotgym("read", photos, "--out", json_file, "--overlay", seen) == 0
    rows = json.loads(json_file.read_text())
    assert [Path(row["file"]).name for row in rows] == ["a.png", "b.jpg", "c.png"]
    assert [set(row) for row in rows] == [{"file", "ropes", "crossings", "closed", "reason"}] * 3
    rope = {"closed", "crossings", "gauss_code", "confidence", "knot"}
    assert [set(one) for row in rows for one in row["ropes"]] == [rope] * 2
    assert rows[0]["closed"] and rows[0]["reason"] is None
    assert rows[0]["crossings"] == label(points).nx and rows[0]["ropes"][0]["knot"] == "0_1"
    assert not rows[1]["closed"] and rows[1]["reason"].startswith("two loose ends at (")
    assert rows[2]["ropes"] == [] and "isn't a picture" in rows[2]["reason"]
    assert np.asarray(Image.open(seen / "b.png")).shape == wire.shape
    assert "a.png: closed rope, 2 crossings, 0_1:" in capsys.readouterr().out
    assert read_photo(photos / "b.jpg").row == {
        name: rows[1][name] for name in rows[1] if name != "file"
    }

    whole = (photos / "a.png").read_bytes()
    for more in ((), ("--overwrite",)):  # the overlay of a.png would be a.png
        assert knotgym("read", photos, "--overlay", photos, *more) == 2
    assert (photos / "a.png").read_bytes() == whole and knotgym(
        "read", photos, "--overlay", seen
    ) == 2
    assert knotgym("read", photos / "b.jpg", "--out", json_file) == 2  # it exists
    assert knotgym("read", photos / "b.jpg", photos / "c.png", "--out", tmp_path / "codes.csv") == 0
    with (tmp_path / "codes.csv").open(newline="") as file:
        first, last = csv.DictReader(file)
    assert (first["rope"], first["closed"], first["gauss_code"]) == ("1", "False", "")
    assert last["rope"] == "" and "isn't a picture" in last["reason"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("missing.jpg",), "no photo missing.jpg"),
        ((".", "--out", "codes.txt"), "no pictures in"),
        ((__file__, "--out", "codes.txt"), "--out must end in .json or .csv"),
    ],
)
def test_mistakes_are_told_in_a_line(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert knotgym("read", *words) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1 and not any(tmp_path.iterdir())
