"""Films are written whole or not at all; the dataset commands show, draw, replay, merge and convert
what is there.
"""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from knotgym.common.errors import InvalidInput
from knotgym.datasets.cards.fact_tables import growth
from knotgym.datasets.cards.state_card import summary
from knotgym.datasets.episode_reader import Chosen, EpisodeReader
from knotgym.datasets.episode_writer import merge_episodes
from knotgym.datasets.gallery import Tile, contact_sheet
from knotgym.datasets.state_verification import state_faults
from knotgym.rendering.video import (
    FRAMES_PER_SECOND,
    OUTCOMES,
    captioned,
    film_frame,
    film_frames,
    write_film,
)
from knotgym.rope.model import Rope
from knotgym.states.state_file import States, read_states, write_states

from ..conftest import curled
from ..small_job import knotgym

FRAMES = [np.full((40, 60, 3), level, dtype=np.uint8) for level in (0, 60, 120, 180, 240)]
WAYS = "minari/knotgym/tie-nx1/demonstrations-v0"
TEST_WAYS = "minari/knotgym/tie-nx1/demonstrations-test-v0"


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    with h5py.File(path, "a") as file:
        yield file


def film_length(path: Path) -> int:
    if path.suffix == ".gif":
        with Image.open(path) as animation:
            return getattr(animation, "n_frames", 1)
    film = cv2.VideoCapture(str(path))
    count = 0
    while film.read()[0]:
        count += 1
    return count


# Films.


@pytest.mark.parametrize("name", ["a.gif", "a.mp4", "a.webm", "A.GIF"])
def test_a_film_has_the_frames_it_was_given(tmp_path: Path, name: str) -> None:
    write_film(tmp_path / name, FRAMES)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    if not name.isupper():
        assert film_length(tmp_path / name) == len(FRAMES)


@pytest.mark.parametrize("name", ["a.gif", "a.mp4", "a.webm"])
def test_a_film_shows_what_it_was_given(tmp_path: Path, name: str) -> None:
    write_film(tmp_path / name, FRAMES)
    film = cv2.VideoCapture(str(tmp_path / name))
    levels = [float(film.read()[1].mean()) for _ in FRAMES]
    assert np.allclose(levels, [0, 60, 120, 180, 240], atol=6)


def test_a_film_runs_as_fast_as_the_rope(tmp_path: Path) -> None:
    write_film(tmp_path / "a.gif", FRAMES)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.info["duration"] == 1000 // FRAMES_PER_SECOND


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "h264"), ("a.webm", "vp9")])
def test_films_are_of_a_kind_that_browsers_play(tmp_path: Path, name: str, codec: str) -> None:
    write_film(tmp_path / name, FRAMES)
    with av.open(str(tmp_path / name)) as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == (codec, "yuv420p")
        assert stream.average_rate == FRAMES_PER_SECOND


def test_a_film_that_needs_pyav_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InvalidInput, match=r"pip install '\.\[video\]'"):
        write_film(tmp_path / "a.mp4", FRAMES)
    write_film(tmp_path / "a.gif", FRAMES)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


def test_a_frame_shows_the_pull_and_says_the_plain_loop() -> None:
    loop = Rope().loop()
    plain = film_frame(loop, loop, "step 0 of 1")
    pulled = film_frame(loop, loop, "step 0 of 1", (0, np.array([0.0, 1.0, 0.0])))
    moved = np.argwhere((pulled != plain).any(axis=2))
    assert moved[:, 1].max() < 384  # on the rope's half
    # upwards, +y: the bead's place is the arrow's lowest point
    assert 60 < np.ptp(moved[:, 0]) < 100 and np.ptp(moved[:, 1]) < 40


def test_a_frame_names_its_halves_and_has_both_codes_in_one_notation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []
    monkeypatch.setattr("cv2.putText", lambda frame, text, *_: said.append(text))
    film_frame(Rope().loop(), Rope().from_curve(curled(1)), "step 0 of 1")
    assert said == ["step 0 of 1", "now   the plain loop", "goal  1+,1-", "now", "goal"]


def test_a_film_says_at_its_end_whether_the_goal_was_reached() -> None:
    loop, pull = Rope().loop(), (0, np.zeros(3))
    for reached, outcome in (([False, True], "reached"), ([False, False], "failed")):
        first, *rest = film_frames([loop, loop], loop, ["0", "1"], [pull], reached)
        assert len(rest) == 1 + FRAMES_PER_SECOND
        assert (rest[-1][4, 4:-4] == OUTCOMES[outcome]).all()
        assert (first[4, 4:-4] != OUTCOMES[outcome]).any()


def test_a_film_keeps_its_scale_while_the_rope_shrinks() -> None:
    loop = Rope().loop()
    frames = film_frames([loop, loop / 2], loop, ["0", "1"], [(0, np.zeros(3))], [False, False])
    wide = [
        np.ptp(np.flatnonzero((frame[40:340, :384].max(axis=2) > 60).any(axis=0)))
        for frame in (frames[0], film_frame(loop / 2, loop, "1"))
    ]
    assert 1.8 < wide[0] / wide[1] < 2.2


@pytest.mark.parametrize("name", ["a.avi", "a", "a.gif.txt"])
def test_another_kind_of_film_is_refused_and_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidInput, match="a video must end in .gif, .mp4 or .webm"):
        write_film(tmp_path / name, FRAMES)
    assert list(tmp_path.iterdir()) == []


def test_captions_stand_below_the_picture() -> None:
    frame = np.arange(30 * 60 * 3).reshape(30, 60, 3).astype(np.uint8)
    out = captioned(frame, ["one", "two"])
    assert np.array_equal(out[:30], frame) and out[30:].any() and out.shape[0] % 2 == 0


@pytest.mark.parametrize("text", ["", "short", "1+c,2-a,3+a," * 30])
def test_captions_of_any_length_fit(text: str) -> None:
    out = captioned(np.zeros((60, 120, 3), dtype=np.uint8), [text])
    assert out.shape[1] == 120 and not out[:, -4:].any()


# Contact sheets.


def test_a_contact_sheet_holds_every_picture_unchanged() -> None:
    images = np.random.default_rng(0).integers(0, 255, (5, 16, 16, 3), dtype=np.uint8)
    sheet = contact_sheet([Tile(image, ("a", "b")) for image in images], columns=2)
    assert sheet.shape == (3 * 58, 2 * 28, 3)
    for k, image in enumerate(images):
        top, left = k // 2 * 58 + 6, k % 2 * 28 + 6
        assert np.array_equal(sheet[top : top + 16, left : left + 16], image)


def test_a_contact_sheet_has_no_empty_column() -> None:
    tile = Tile(np.zeros((16, 16, 3), dtype=np.uint8), ("a",))
    assert contact_sheet([tile] * 3).shape[1] == 3 * 28


def test_a_coloured_tile_is_framed() -> None:
    image = np.zeros((16, 16, 3), dtype=np.uint8)
    sheet = contact_sheet([Tile(image, ("a",), OUTCOMES["failed"])])
    assert (sheet[5, 6:22] == OUTCOMES["failed"]).all()
    assert np.array_equal(sheet[6:22, 6:22], image)


def test_a_caption_too_long_for_its_picture_goes_on_in_the_next_line() -> None:
    image = np.zeros((128, 128, 3), dtype=np.uint8)
    code = ",".join(f"{number}+a" for number in (*range(1, 7), *range(1, 7)))
    short, long = (contact_sheet([Tile(image, (text, "b"))]) for text in ("1+a", code))
    assert long.shape[0] > short.shape[0] and long.shape[1] == short.shape[1]
    assert (long[short.shape[0] - 12 :] != long[-1, 0]).any()


def test_a_gallery_of_episodes_says_of_each_whether_it_reached_its_goal(
    curated: Path, tmp_path: Path
) -> None:
    assert knotgym("dataset", "gallery", curated / WAYS, "--out", tmp_path / "a.png") == 0
    sheet = np.asarray(cv2.imread(str(tmp_path / "a.png")))[..., ::-1]
    assert (sheet[5, 6:198] == OUTCOMES["reached"]).all()


def test_the_gallery_command_draws_the_gallery_again(curated: Path, tmp_path: Path) -> None:
    assert knotgym("dataset", "gallery", curated, "--out", tmp_path / "a.png") == 0
    assert (tmp_path / "a.png").read_bytes() == (curated / "gallery.png").read_bytes()


@pytest.mark.parametrize("name", ["", "states.h5", "minari", WAYS])
def test_gallery_and_page_are_written_into_the_folder_that_is_shown(
    curated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    run = shutil.copytree(curated, tmp_path / "run")
    (run / "gallery.png").unlink()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    folder = run if name == "states.h5" else run / name
    for command, file in (("gallery", "gallery.png"), ("page", "page.html")):
        assert knotgym("dataset", command, run / name) == 0
        assert (folder / file).is_file()
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_the_gallery_command_leaves_a_file_that_is_there_alone(
    curated: Path, tmp_path: Path
) -> None:
    (tmp_path / "a.png").write_text("mine")
    assert knotgym("dataset", "gallery", curated, "--out", tmp_path / "a.png") == 2
    assert (tmp_path / "a.png").read_text() == "mine"


# Show.


def test_show_counts_states_codes_and_rejections(
    curated: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "show", curated) == 0
    told = capfd.readouterr().out
    assert "8 states" in told and "noise_survival" in told and "drawings or walks" in told


def test_show_sums_up_trajectories(curated: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym("dataset", "show", curated / WAYS) == 0
    told = {line.split()[0]: line for line in capfd.readouterr().out.splitlines()}
    assert (
        told["episodes"].split()[1] == "2"
        and told["successes"].split()[1] == "2"
        and "demonstrations" in told["policies"]
    )


def test_show_finds_a_dataset_by_its_id(
    curated: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(curated / "minari"))
    assert knotgym("dataset", "show", "knotgym/tie-nx1/demonstrations-v0") == 0
    assert "knotgym/tie-nx1/demonstrations-v0" in capfd.readouterr().out


def test_growth_is_told_in_a_dozen_rows_the_last_among_them() -> None:
    rows = [{"steps": 100 * k, "known": {"3": k}, "accepted": {"3": k // 2}} for k in range(1, 500)]
    told = growth({"growth": rows})
    assert (
        len(told) <= 12
        and told[0] == rows[0]
        and told[-1] == rows[-1]
        and told == sorted(told, key=lambda one: one["steps"])
    )
    assert growth({"growth": rows[:5]}) == rows[:5] and growth({}) == []


def test_a_summary_counts_what_is_there(curated: Path) -> None:
    states = read_states(curated / "states.h5")
    one = summary(states)["nx"]["1"]
    assert (one["states"], one["codes"], one["train"], one["test"]) == (4, 2, 2, 2)
    assert one["positive_crossings"] + one["negative_crossings"] == 4
    assert one["positive_crossings"] == sum("c" in text for text in states.gauss_code_chiral)
    assert (
        one["actions_to_reach"][0] == states.source["steps"][4:].min()
        and one["actions_to_reach"][2] == states.source["steps"][4:].max()
    )


def test_show_counts_states_whose_way_is_not_known(
    states_path: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "show", states_path) == 0 and "30 states" in capfd.readouterr().out


@pytest.mark.parametrize("command", ["show", "verify", "replay"])
@pytest.mark.parametrize("name", ["absent", "text.h5", "foreign.h5"])
def test_what_is_no_dataset_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], command: str, name: str
) -> None:
    (tmp_path / "text.h5").write_text("not HDF5")
    with opened(tmp_path / "foreign.h5") as file:
        file["x"] = 1.0
    more = ("--out", tmp_path / "a.gif") if command == "replay" else ()
    assert knotgym("dataset", command, tmp_path / name, *more) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("knotgym: ") and name in line and not (tmp_path / "a.gif").exists()


# Replay.


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [pytest.param("states", marks=pytest.mark.slow), "trajectories"],  # below, a state
)
def test_a_replay_is_filmed_from_the_start_to_the_state(
    curated: Path, tmp_path: Path, kind: str
) -> None:
    if kind == "states":
        source, row, steps = curated, 5, read_states(curated / "states.h5").source["steps"][5]
    else:
        source, row, steps = curated / WAYS, 1, len(EpisodeReader(curated / WAYS).episode(1))
    assert knotgym("dataset", "replay", source, "--row", row, "--out", tmp_path / "a.mp4") == 0
    assert film_length(tmp_path / "a.mp4") == steps + 1 + FRAMES_PER_SECOND


@pytest.mark.slow
def test_the_last_frame_shows_the_state_beside_itself(curated: Path, tmp_path: Path) -> None:
    assert knotgym("dataset", "replay", curated, "--row", 5, "--out", tmp_path / "a.mp4") == 0
    film, frames = cv2.VideoCapture(str(tmp_path / "a.mp4")), []
    while (frame := film.read())[0]:
        frames.append(frame[1][40:330, ..., ::-1].astype(float))
    apart = [np.abs(one[:, 10:374] - one[:, 394:758]).mean() for one in (frames[0], frames[-1])]
    assert apart[1] < 3 < apart[0]


@pytest.mark.parametrize("name", ["start_qpos", "actions"])
def test_a_replay_that_ends_elsewhere_is_told_and_not_filmed(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    shutil.copy(curated / "states.h5", tmp_path / "states.h5")
    with opened(tmp_path / "states.h5") as file:
        file["source"][name][(5, 3) if name == "start_qpos" else (5, 0, 3)] += (
            1e-3  # the force, of an action
        )
    assert (
        knotgym(
            "dataset", "replay", tmp_path / "states.h5", "--row", 5, "--out", tmp_path / "a.gif"
        )
        != 0
    )
    (line,) = capfd.readouterr().err.splitlines()
    assert (
        "row 5 of" in line and "ends in another state" in line and not (tmp_path / "a.gif").exists()
    )


def test_states_without_provenance_cannot_be_replayed(
    states_path: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "replay", states_path, "--out", tmp_path / "a.gif") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "has no recorded actions for its states" in line


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("--row 8", "there is no row 8; the dataset has 8 rows, counted from 0"),
        ("--row -1", "greater than or equal to 0"),
        ("--out {}/a.avi", "a video must end in .gif, .mp4 or .webm"),
    ],
)
def test_a_replay_of_what_cannot_be_is_refused(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], options: str, problem: str
) -> None:
    words = ["--out", str(tmp_path / "a.gif"), *options.format(tmp_path).split()]
    assert knotgym("dataset", "replay", curated, *words) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert problem in line and list(tmp_path.iterdir()) == []


# Merge and export.


def cut(states: States, kept: NDArray[np.bool_]) -> States:
    """Some of the rows."""
    columns: dict[str, Any] = {
        name: value[kept] for name, value in vars(states).items() if isinstance(value, np.ndarray)
    }
    for name in ("quality", "source"):
        columns[name] = {key: value[kept] for key, value in getattr(states, name).items()}
    return replace(states, **columns)


def rows(states: States) -> list[bytes]:
    return [qpos.tobytes() for qpos in states.qpos]


def test_merged_states_are_those_of_both_in_order_of_nx(curated: Path, tmp_path: Path) -> None:
    whole = read_states(curated / "states.h5")
    parts = [tmp_path / "odd.h5", tmp_path / "even.h5"]
    for part, first in zip(parts, (1, 0), strict=True):
        write_states(part, cut(whole, np.arange(8) % 2 == first))
    assert knotgym("dataset", "merge", *parts, "--out", tmp_path / "m.h5") == 0
    merged, order = read_states(tmp_path / "m.h5"), [1, 3, 0, 2, 5, 7, 4, 6]
    assert merged.nx.tolist() == [0] * 4 + [1] * 4
    assert rows(merged) == [rows(whole)[row] for row in order]
    assert merged.image is not None and whole.image is not None
    assert np.array_equal(merged.image, whole.image[order])
    assert (
        merged.source.keys() == whole.source.keys()
        and merged.quality.keys() == whole.quality.keys()
    )


@pytest.mark.slow
def test_two_halves_merged_are_the_whole(curated: Path, tmp_path: Path) -> None:
    whole = read_states(curated / "states.h5")
    for nx in (1, 0):
        write_states(tmp_path / f"{nx}.h5", cut(whole, whole.nx == nx))
    assert (
        knotgym(
            "dataset", "merge", tmp_path / "1.h5", tmp_path / "0.h5", "--out", tmp_path / "m.h5"
        )
        == 0
    )
    merged = read_states(tmp_path / "m.h5")
    assert (
        rows(merged) == rows(whole)
        and merged.image is not None
        and whole.image is not None
        and np.array_equal(merged.image, whole.image)
        and list(state_faults(merged)) == []
    )


def test_states_with_other_columns_do_not_go_together(
    curated: Path, states_path: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "merge", curated, states_path, "--out", tmp_path / "m.h5") == 2
    assert (
        "different quality or source columns" in capfd.readouterr().err
        and not (tmp_path / "m.h5").exists()
    )


def test_states_and_trajectories_do_not_go_into_one_file(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "merge", curated, curated / WAYS, "--out", tmp_path / "m.h5") == 2
    assert len(capfd.readouterr().err.splitlines()) == 1 and not (tmp_path / "m.h5").exists()


def test_merged_trajectories_hold_every_episode(curated: Path, tmp_path: Path) -> None:
    parts = [tmp_path / "b.h5", tmp_path / "a.h5"]
    for k, part in enumerate(parts):
        merge_episodes([Chosen(curated / WAYS, [k])], part)
    assert knotgym("dataset", "merge", *parts[::-1], "--out", tmp_path / "m.h5") == 0
    merged, whole = EpisodeReader(tmp_path / "m.h5"), EpisodeReader(curated / WAYS)
    assert [one.digest() for one in merged] == [one.digest() for one in whole][::-1]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ((WAYS, WAYS), "are the same; merge datasets that share no episode"),
        ((WAYS, TEST_WAYS), "files to merge must have one task"),
        (("states.h5", ""), "8 states occur twice"),
    ],
)
def test_a_set_is_not_merged_with_itself_nor_train_with_test(
    curated: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    names: tuple[str, ...],
    said: str,
) -> None:
    sources = [curated / name for name in names]
    assert knotgym("dataset", "merge", *sources, "--out", tmp_path / "m.h5") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert said in line and not (tmp_path / "m.h5").exists()


def test_exported_trajectories_are_the_same_without_pictures(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("dataset", "export", curated / WAYS, "--out", tmp_path / "e.h5") == 0
    compact, whole = EpisodeReader(tmp_path / "e.h5"), EpisodeReader(curated / WAYS)
    assert compact.stored == "none" and [one.digest() for one in compact] == [
        one.digest() for one in whole
    ]
    assert knotgym("dataset", "verify", tmp_path / "e.h5") == 0


@pytest.mark.parametrize("command", ["merge", "export", "replay"])
def test_a_file_that_is_there_is_not_written_over(
    curated: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], command: str
) -> None:
    mine = tmp_path / ("a.gif" if command == "replay" else "a.h5")
    mine.write_text("mine")
    assert knotgym("dataset", command, curated / WAYS, "--out", mine) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert f"{mine} exists already" in line and mine.read_text() == "mine"
