"""Pictures: what `knotgym images` writes, that it is true, that `verify` finds what is not, and how
it is read. Interrupted, divided and merged runs are in tests/runs/test_runner.py.
"""

import importlib.metadata
import importlib.util
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Capture, Patch

from knotgym.common import Failed, InvalidFile, InvalidInput
from knotgym.datasets import PictureRow, decode, parquet, read_rows, read_table, shards
from knotgym.generate import faults as dataset_faults
from knotgym.generate.generate_config import ImagesConfig
from knotgym.generate.image_recipe import make_images
from knotgym.loaders import images as load
from knotgym.quality import Limits, grade_of, measure
from knotgym.rendering import AppearanceConfig
from knotgym.rope import Rope
from knotgym.runs import RunOptions
from knotgym.states import IMAGE_SPLITS, NEAR, Spectra
from knotgym.topology import GaussCode, Symmetry, canonical, label

from ..small_job import knotgym

ROOT = Path(__file__).parents[2]

NOTHING = Limits(margin=1e6)
CONFIG = ImagesConfig(
    nx=(0, 1, 2),
    count=6,
    test_share=0.4,
    engine="chain",
    pulls=4,
    rows_per_file=3,
    appearance=AppearanceConfig(vary=("all",), sizes=(64, 128)),
)


def made(out: Path, config: ImagesConfig = CONFIG, **options: Any) -> Path:
    return make_images(config, out, RunOptions(**{"workers": 1, "quiet": True, **options}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("images") / "table")


@pytest.fixture(scope="module")
def rows(folder: Path) -> list[dict[str, Any]]:
    rows = list(read_rows(folder))
    assert rows
    return rows


def test_pictures_are_as_many_as_asked_for_show_their_codes_and_differ(
    folder: Path, rows: list[dict[str, Any]]
) -> None:
    assert [sum(row["nx"] == nx for row in rows) for nx in CONFIG.nx] == [2, 2, 2]
    assert {row["nx"] for row in rows if row["split"] == "test-nx"} == {2}  # there alone
    assert {row["nx"] for row in rows if row["split"] in ("train", "test")} == {0, 1}
    points = np.reshape([row["points"] for row in rows], (CONFIG.count, -1, 3))
    for k, row in enumerate(rows):
        assert label(points[k]).chiral == row["gauss_code_chiral"]
    apart = Spectra.of(points).turned_distances(Spectra.of(points))
    assert apart[np.triu_indices(len(points), 1)].min() >= NEAR
    assert list(dataset_faults(folder)) == []


def test_split_leaks_are_found(folder: Path, rows: list[dict[str, Any]], tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    test, train = shards(copy, "test")[0], next(row for row in rows if row["split"] == "train")
    test.write_bytes(parquet([{**row, "split": "test"} for row in [*read_rows(test), train]]))
    found = "\n".join(dataset_faults(copy))
    for word in ("SHA-256 differs", "near-duplicates", "come from one rope", "the same number"):
        assert word in found


@pytest.mark.parametrize(
    "symmetry", [Symmetry(turn=1.0), Symmetry(reflect=True, turn=1.0, reverse=True, base_shift=37)]
)
def test_a_near_duplicate_in_another_split_is_found(
    rows: list[dict[str, Any]], tmp_path: Path, symmetry: Symmetry
) -> None:
    """The planted row is true in every other way: a training row's rope moved by a symmetry and
    shaken, with labels and a picture of its own, of another rope.
    """
    train = next(row for row in rows if row["split"] == "train" and row["nx"] == 1)
    points = symmetry.vertices(np.array(train["points"]).reshape(-1, 3))
    points = points + (0.1, 0, 0) + np.random.default_rng(0).normal(0, 0.001, points.shape)
    planted = PictureRow(points, "test", {**train["source"], "rope": 10**6, "row": 10**6})
    file = tmp_path / "data.parquet"
    file.write_bytes(parquet(PictureRow.drawn([planted], AppearanceConfig())))
    file.write_bytes(parquet([train, *read_rows(file)]))
    [fault] = dataset_faults(tmp_path / "data.parquet")
    assert "(train)" in fault and "1000000 (test)" in fault and "are near-duplicates" in fault


def test_a_missing_file_and_a_missing_split_are_found(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "copy")
    shards(tmp_path / "copy", "test")[0].unlink()
    found = list(dataset_faults(tmp_path / "copy"))
    assert "data/test-00000-of-00001.parquet is missing" in found
    with pytest.raises(InvalidFile, match="no split"):
        read_table(folder, "validation")


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (("show",), 0, "accepted"),
        (("verify",), 0, "no faults"),
        (("gallery", "--out", "g.png"), 0, "pictures"),
        (("page", "--out", "made.html"), 0, "made.html: "),
        (("export", "--to", "huggingface", "--out", "hub"), 2, "is ready to upload as it is"),
    ],
)
def test_commands_on_datasets_know_a_folder_of_pictures(
    words: tuple[str, ...],
    status: int,
    said: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: Patch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    assert knotgym("dataset", words[0], folder, *words[1:]) == status
    told = "".join(capsys.readouterr())
    assert said in told
    assert all(len(line) <= 80 or str(folder) in line for line in told.splitlines())


def test_all_frames_of_a_rope_and_all_of_a_held_out_code_are_in_one_split(tmp_path: Path) -> None:
    config = ImagesConfig(
        nx=(2, 3), test_nx=None, count=40, code_share=0.25, engine="chain", pulls=8
    )
    splits, shown = dict[int, list[str]](), dict[str, set[str]]()
    for row in read_rows(made(tmp_path / "table", config)):
        splits.setdefault(row["source"]["rope"], []).append(row["split"])
        shown.setdefault(row["split"], set()).add(row["gauss_code"])
    assert all(len(set(own)) == 1 for own in splits.values())
    assert any(len(own) > 1 for own in splits.values())
    assert set(shown) == {"train", "test", "test-code"}
    assert not shown["test-code"] & (shown["train"] | shown["test"])


@pytest.mark.parametrize(
    "appearance", [AppearanceConfig(name="line"), AppearanceConfig(vary=("colours",))]
)
def test_unmarked_pictures_hold_out_diagrams(appearance: AppearanceConfig, tmp_path: Path) -> None:
    config = ImagesConfig(
        nx=(3,), test_nx=None, count=24, code_share=0.25, engine="chain", appearance=appearance
    )
    folder = made(tmp_path / "table", config)
    shown: dict[str, set[GaussCode]] = {}
    for row in read_rows(folder):
        code = canonical(GaussCode.parse(row["gauss_code"]), Symmetry.DIAGRAM)
        shown.setdefault(row["split"], set()).add(code)
    assert shown["test-code"] and not shown["test-code"] & (shown["train"] | shown["test"])
    assert "up to base, direction" in (folder / "README.md").read_text()
    # the same pictures, held out by a code with a base, are a fault
    table = read_table(folder)
    splits = np.array(table["split"].to_pylist())
    splits[: len(splits) // 2] = "test-code"
    spoilt = table.set_column(table.column_names.index("split"), "split", [splits])
    (tmp_path / "spoilt.parquet").write_bytes(parquet(spoilt))
    assert any("another base" in fault for fault in dataset_faults(tmp_path / "spoilt.parquet"))


def test_codes_are_balanced(tmp_path: Path) -> None:
    config = ImagesConfig(nx=(1,), count=20, test_share=0, code_share=0, engine="chain")
    codes = [row["gauss_code"] for row in read_rows(made(tmp_path / "table", config))]
    assert [codes.count(code) for code in set(codes)] == [10, 10]


def test_ropes_start_from_an_included_set_by_its_name(tmp_path: Path) -> None:
    config = ImagesConfig(nx=(1,), count=2, test_share=0, code_share=0, engine="chain")
    options = RunOptions(workers=1, quiet=True)
    assert list(read_rows(make_images(config, tmp_path / "table", options, states="bench")))


def test_states_that_give_no_more_pictures_end_it(tmp_path: Path, monkeypatch: Patch) -> None:
    config = ImagesConfig(nx=(1,), count=4, pulls=2, idle=2, engine="chain", limits=NOTHING)
    with pytest.raises(Failed, match=r"0 of 4 pictures found, then none in 2 waves of ropes"):
        made(tmp_path / "table", config)


def test_a_grade_is_that_of_the_worst_measure(rope: Rope) -> None:
    limits, quality = Limits(), measure(rope.loop())
    bounds = ((1.5, "easy"), (1.49, "medium"), (1, "medium"), (0.99, "hard"), (0.5, "hard"))
    for factor, name in (*bounds, (0.49, "extreme")):
        worse = type(quality)(
            **{**vars(quality), "crossing_angle": factor * (limits.crossing_angle or 0)}
        )
        assert grade_of(worse.ease()) == name


def test_a_checkouts_own_folder_is_not_mistaken_for_hugging_faces_library(
    folder: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    (tmp_path / "datasets.py").write_text("def load_dataset(*_, **__): return 'theirs'\n")
    shutil.copytree(folder, tmp_path / "a::b")
    monkeypatch.setattr(sys, "path", [str(ROOT), str(tmp_path)])
    monkeypatch.delitem(sys.modules, "datasets", raising=False)
    assert load(folder, kind="huggingface") == "theirs"
    with pytest.raises(InvalidInput, match="takes '::' for a chain of paths, got .*a::b"):
        load(tmp_path / "a::b", kind="huggingface")
    del sys.modules["datasets"]
    assert sys.path == [str(ROOT), str(tmp_path)]


@pytest.mark.clients
def test_torch_reads_pictures_and_padded_labels(folder: Path, rows: list[dict[str, Any]]) -> None:
    data_of = pytest.importorskip("torch.utils.data")

    assert load(folder, "train").max_nx == load(folder, "test-nx").max_nx == 2
    data = load(folder, max_nx=4)
    assert len(data) == len(rows)
    for item, row in zip(data, rows, strict=True):
        assert np.array_equal(np.moveaxis(item["image"].numpy(), 0, -1), decode(row["image"]))
        visits = [visit for visit in item["visits"].tolist() if visit]
        assert str(GaussCode(tuple(visits))) == row["gauss_code"] and item["nx"] == row["nx"]
        assert (item["visits"].shape, item["crossings"].shape) == ((8,), (4, 4))
    small = [k for k, item in enumerate(data) if item["image"].shape[-1] == 64]
    batches = data_of.DataLoader(data_of.Subset(data, small), 4, num_workers=2)
    assert sum(len(batch["image"]) for batch in batches) == len(small)
    with pytest.raises(InvalidFile, match="max_nx must be at least"):
        load(folder, max_nx=1)


@pytest.fixture
def hugging_face(tmp_path: Path, monkeypatch: Patch) -> Any:
    """Hugging Face's library, with a cache that goes away; not the checkout's folder of that name,
    which `python -m pytest` would find first.
    """
    pytest.importorskip("dill")  # it needs it
    elsewhere = [place for place in sys.path if Path(place).resolve() != ROOT]
    monkeypatch.setattr(sys, "path", elsewhere)
    library = importlib.import_module("datasets")
    monkeypatch.setattr(library.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    return library


@pytest.mark.clients
@pytest.mark.parametrize("way", ["our loader", "the card", "one split"])
def test_hugging_face_reads_every_column_of_every_split(
    way: str, folder: Path, rows: list[dict[str, Any]], hugging_face: Any, tmp_path: Path
) -> None:
    splits = ["train"] if way == "one split" else IMAGE_SPLITS
    wanted = {name: [row for row in rows if row["split"] == name] for name in splits}
    if way == "the card":
        found = hugging_face.load_dataset(str(folder))
    elif way == "our loader":
        shutil.copytree(folder, tmp_path / "run[12]")  # a pattern of its library's, of run1, too
        (tmp_path / "run1").mkdir()
        found = load(tmp_path / "run[12]", kind="huggingface")
    else:
        found = {"train": load(folder, "train", "huggingface")}
    assert set(found) == {name.replace("-", "_") for name, own in wanted.items() if own}
    for name in found:
        own = wanted[name.replace("_", "-")]
        assert set(found[name].features) == {*own[0]}
        assert isinstance(found[name].features["image"], hugging_face.Image)
        for seen, row in zip(found[name], own, strict=True):
            assert np.array_equal(np.asarray(seen.pop("image")), decode(row["image"]))
            assert seen == {column: value for column, value in row.items() if column != "image"}


@pytest.mark.clients
def test_croissant_of_pictures_is_valid_and_a_picture_comes_back(folder: Path) -> None:
    croissant = pytest.importorskip("mlcroissant")
    one = croissant.Dataset(jsonld=str(folder / "croissant.json"))
    assert not one.metadata.ctx.issues.errors
    where = next(record.name for record in one.metadata.record_sets)
    row = next(iter(one.records(where)))
    assert row[f"{where}/image"].size in ((64, 64), (128, 128))


@pytest.mark.thorough
def test_photos_of_a_run_are_as_their_rows_say(tmp_path: Path) -> None:
    look = AppearanceConfig(name="photo")
    config = ImagesConfig(nx=(1, 2), count=4, engine="chain", appearance=look)
    assert [*dataset_faults(made(tmp_path / "photos", config))] == []
