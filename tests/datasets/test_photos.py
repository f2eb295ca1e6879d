"""Photos as rows of a perception table: what is written is read back, and verified."""

import base64
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_pictures import picture_rows

from knotgym.common import InvalidFile, Occupied
from knotgym.control import replay
from knotgym.datasets.exports import export
from knotgym.datasets.image_table import PictureRow, parquet, read_rows, read_table
from knotgym.datasets.located import Located
from knotgym.datasets.page import _page_data, _page_html
from knotgym.datasets.png import decode
from knotgym.datasets.row_verification import _picture_faults
from knotgym.rendering import AppearanceConfig, Drawer
from knotgym.states import read_states, shipped


@pytest.fixture(scope="module")
def rows(folder: Path) -> list[dict[str, Any]]:
    """Rows of three photos, the first of a plain loop, written and read again."""
    config = AppearanceConfig(name="photo", sizes=(128,), marked=1.0)
    ropes = enumerate(read_states(shipped(), images=False).points[[0, 70, 120]])
    seen = [Drawer.of("photo").seen(one, config, np.random.default_rng(k)) for k, one in ropes]
    made = picture_rows([points for points, _ in seen], cameras=[camera for _, camera in seen])
    path = folder / "data/train-00000-of-00001.parquet"
    path.parent.mkdir()
    path.write_bytes(parquet(PictureRow.drawn(made, config)))
    return list(read_rows(path))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the rows."""
    return tmp_path_factory.mktemp("photos")


def test_a_photo_and_its_answers_are_taken_again_from_its_row(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        drawer = Drawer.of(row["appearance"]["name"])
        again = drawer.drawn(np.reshape(row["points"], (-1, 3)), drawer.read(row))
        assert np.array_equal(decode(row["image"]), again.image)
        assert np.array_equal(decode(row["strands"])[..., 0], again.columns["strands"])
        assert [*_picture_faults(dict(row))] == []
        assert 0 < row["photo"]["tilt"] <= 25 and row["photo"]["marked"]


def test_a_table_of_cut_ropes_is_read_verified_and_exported(tmp_path: Path) -> None:
    config = AppearanceConfig(name="photo", look="phone", ropes=(1, 2, 3), sizes=(128,))
    states = read_states(shipped("bench"), images=False)
    ropes = states.points[states.rows(3, "test")[:6]]
    path = tmp_path / "test.parquet"
    path.write_bytes(parquet(PictureRow.drawn(picture_rows(ropes, "test"), config)))
    held = list(read_rows(path))
    assert len({row["ropes_code"].count(";") for row in held}) > 1
    for row in held:
        assert [*_picture_faults(dict(row))] == [] and row["phone"]["look"] == "phone"
    assert [*_picture_faults(held[0] | {"ropes_code": "1+,1-,2+,2-"})] != []
    export(str(path), tmp_path / "coco", "coco", replay)


def test_boxes_hold_their_strands(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        strands = decode(row["strands"])[..., 0]
        for box in row["boxes"]:
            inside = np.zeros_like(strands, dtype=bool)
            inside[box["y"] : box["y"] + box["height"], box["x"] : box["x"] + box["width"]] = True
            assert not (strands == box["strand"])[~inside].any()
            assert (strands == box["strand"])[inside].any()


@pytest.mark.parametrize(
    ("column", "change", "said"),
    [
        ("line", lambda rows: [0.0, *rows[0]["line"][1:]], "line"),
        ("strands", lambda rows: rows[1]["strands"], "strands"),
        ("canonical_code", lambda rows: "1+,1-,2+,2-,3+,3-,4+,4-", "canonical_code"),
        ("photo", lambda rows: rows[0]["photo"] | {"order": 99.0}, "photo"),
        ("photo", lambda rows: rows[0]["photo"] | {"clutter": 10**9}, "photo.clutter is 10000000"),
    ],
)
def test_a_spoilt_answer_is_found(
    rows: list[dict[str, Any]], column: str, change: Callable[[Any], Any], said: str
) -> None:
    faults = _picture_faults(rows[0] | {column: change(rows)})
    assert any(fault.startswith(said) for fault in faults)


def test_a_page_has_the_labels_of_each_photo(folder: Path, rows: list[dict[str, Any]]) -> None:
    data = _page_data("photos", Located(folder, pictures=folder))
    assert data["called"] == "pictures" and data["says"] == "3 pictures"
    for shown, row in zip(data["states"], rows, strict=True):
        assert len(shown["at"]) == len(shown["x"]) == row["nx"]
        line = np.reshape(row["line"], (-1, 3))[:, :2]
        assert np.allclose(np.reshape(shown["line"], (-1, 2)), line, rtol=1e-3, atol=0.1)
        for (x, y), (over, _, _) in zip(shown["at"], shown["x"], strict=True):
            before, part = line[int(over)], over % 1  # the line passes each crossing
            here = before + part * (line[(int(over) + 1) % len(line)] - before)
            assert np.hypot(*(here - (x, y))) < 2
        assert base64.b64decode(shown["masks"].partition(",")[2]) == row["strands"]
    assert "drawPicture" in _page_html(data)


def test_coco_has_a_mask_for_each_strand_and_keypoints_for_each_crossing(
    folder: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    export(str(folder), tmp_path / "coco", "coco", replay)
    found = json.loads((tmp_path / "coco/train.json").read_text(encoding="utf-8"))
    assert [one["gauss_code_chiral"] for one in found["images"]] == [
        row["gauss_code_chiral"] for row in rows
    ]
    for number, row in enumerate(rows):
        own = [one for one in found["annotations"] if one["image_id"] == number]
        kinds = [one["category_id"] for one in own]
        assert [kinds.count(k) for k in (1, 2, 3)] == [1, len(row["boxes"]), row["nx"]]
        strands = decode(row["strands"])[..., 0]
        for one in own[: len(row["boxes"]) + 1]:
            right = strands == one["edge"] if "edge" in one else strands > 0
            assert one["area"] == right.sum() and one["num_keypoints"] == 0
        assert all(len(one["keypoints"]) == 3 * 17 for one in own)


def test_a_webdataset_holds_pictures_strands_and_the_rest(
    folder: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    export(str(folder), tmp_path / "tars", "webdataset", replay)
    held = dict[str, bytes]()
    for number in range(len(rows)):  # so few rows have a file each, for as many workers
        with tarfile.open(tmp_path / f"tars/train-{number:06d}.tar") as tar:
            held |= {one.name: tar.extractfile(one).read() for one in tar}  # type: ignore[union-attr]
    assert b"Infinity" not in b"".join(held.values())
    for number, row in enumerate(rows):
        assert held[f"{number:06d}.png"] == row["image"]
        assert held[f"{number:06d}.strands.png"] == row["strands"]
        assert json.loads(held[f"{number:06d}.json"])["boxes"] == row["boxes"]


@pytest.mark.parametrize("form", ["coco", "webdataset"])
def test_an_export_is_known_again_and_replaced(form: str, folder: Path, tmp_path: Path) -> None:
    for overwrite in (False, True):
        export(str(folder), tmp_path / "out", form, replay, overwrite=overwrite)
    (tmp_path / "out/mine.tar").touch()
    with pytest.raises(Occupied, match="no manifest.json in it lists mine.tar"):
        export(str(folder), tmp_path / "out", form, replay, overwrite=True)


@pytest.mark.parametrize("place", ["crossings", "line", "photo"])
def test_numbers_that_are_not_finite_are_refused(
    place: str, folder: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    table = read_table(folder)
    held = table.to_pylist()
    part, name = {
        "crossings": (held[-1]["crossings"][0], "x"),
        "line": (held[-1]["line"], 1),
        "photo": (held[-1]["photo"], "right"),
    }[place]
    part[name] = float("nan")
    (tmp_path / "test.parquet").write_bytes(parquet(type(table).from_pylist(held, table.schema)))
    with pytest.raises(InvalidFile, match=f"column {place} holds numbers that aren't finite"):
        export(str(tmp_path / "test.parquet"), tmp_path / "out", "coco", replay)


@pytest.mark.clients
def test_webdataset_reads_exports(folder: Path, rows: list[dict[str, Any]], tmp_path: Path) -> None:
    tars = pytest.importorskip("webdataset")
    export(str(folder), tmp_path / "tars", "webdataset", replay)
    shards = tars.WebDataset(str(tmp_path / "tars/train-{000000..000002}.tar"), shardshuffle=False)
    for row, sample in zip(rows, shards.decode("rgb8"), strict=True):
        assert np.array_equal(sample["png"], decode(row["image"]))
        assert sample["json"]["gauss_code"] == row["gauss_code"]


@pytest.mark.clients
def test_pycocotools_reads_what_is_exported_and_scores_the_truth_perfect(
    folder: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    tools, scoring = (pytest.importorskip(f"pycocotools.{one}") for one in ("coco", "cocoeval"))
    export(str(folder), tmp_path / "coco", "coco", replay)
    coco = tools.COCO(str(tmp_path / "coco/train.json"))
    for number, row in enumerate(rows):
        strands = decode(row["strands"])[..., 0]
        for one in coco.loadAnns(coco.getAnnIds(imgIds=number, catIds=[1, 2])):
            right = strands == one["edge"] if "edge" in one else strands > 0
            assert np.array_equal(coco.annToMask(one), right)
        crossings = coco.loadAnns(coco.getAnnIds(imgIds=number, catIds=3))
        assert len(crossings) == row["nx"] and all(coco.annToMask(one).any() for one in crossings)
    for kind, given in (("bbox", "bbox"), ("segm", "segmentation"), ("keypoints", "keypoints")):
        kept = ("image_id", "category_id", given)
        assert coco.dataset["info"] and coco.dataset["licenses"][0]["id"] == 1  # loadRes takes them
        assert {one["supercategory"] for one in coco.dataset["categories"]} == {"rope"}
        found = [{"score": 1.0} | {name: one[name] for name in kept} for one in coco.anns.values()]
        score = scoring.COCOeval(coco, coco.loadRes(found), kind)
        for step in (score.evaluate, score.accumulate, score.summarize):
            step()
        assert score.stats[0] == pytest.approx(1.0)
