"""Every command's output against what exists: nothing is lost without a word that asks for it.

| exists                  | no word         | --overwrite                | --resume    | --restart |
| file                    | refused         | a file replaces it         |             |           |
| folder                  | refused         | a folder replaces it       | if the same |           |
| link                    | refused         | the link goes, not its end |             |           |
| an interrupted run      | refused         | refused                    | goes on     | goes      |
| a link for staging      | refused         | refused                    | refused     | refused   |
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from knotgym.loaders.frame_cache import CachedFrames, FrameCache

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidFile, InvalidInput, Occupied
from knotgym.datasets.exports.minari_export import to_minari
from knotgym.runs.staging import staging_folder

from ..small_job import knotgym

ID = "knotgym/tie-nx2/random-v0"


class Command(NamedTuple):
    """A command, and what it writes.

    Attributes:
        words: with {out}, {states}, {episodes} and {none}, a file of no settings.
        output: below the folder named `out`; a name with a suffix is a file.
        stages: whether it can be interrupted and resumed.
        library: that it needs.
    """

    words: str
    output: str
    stages: bool = False
    library: str = "numpy"


COMMANDS = {
    "generate": Command("generate --nx 0 --count 1 --workers 1 --out {out}/a", "a", True),
    "walk": Command(
        "generate --nx 0 --source random-walk --out {out}/a --settings {none}", "a", True
    ),
    "draw": Command("generate --nx 0 --source drawing --out {out}/a --settings {none}", "a", True),
    "images": Command("images --nx 0 --count 1 --out {out}/a", "a", True, "pyarrow"),
    "collect": Command(f"collect --policy random --id {ID} --out {{out}}", ID, True),
    "suite": Command("suite --task tie --nx 2 --policies random --out {out}", ID, True),
    "train": Command("train --data {episodes} --out {out}/a", "a", True, "torch"),
    "prompt": Command("prompt --model x --out {out}/a", "a", True, "openai"),
    "evaluate": Command("evaluate --episodes 1 --out {out}/a.json", "a.json", True),
    "video": Command("evaluate --episodes 1 --video {out}/a.gif", "a.gif"),
    "gallery": Command("dataset gallery {states} --out {out}/a.png", "a.png"),
    "page": Command("dataset page {states} --out {out}/a.html", "a.html"),
    "replay": Command("dataset replay {episodes} --out {out}/a.gif", "a.gif"),
    "merge": Command("dataset merge {states} --out {out}/a.h5", "a.h5"),
    "merge --id": Command(f"dataset merge {{episodes}} --id {ID} --out {{out}}", ID),
    "compact": Command("dataset export {episodes} --out {out}/a.h5", "a.h5"),
    "minari": Command("dataset export {episodes} --to minari --out {out}/a", "a"),
    "lerobot": Command("dataset export {episodes} --to lerobot --out {out}/a", "a"),
    "huggingface": Command("dataset export {episodes} --to huggingface --out {out}/a", "a"),
    "ogbench": Command(
        "dataset export {episodes} --to ogbench --out {out}/a", "a/tie-nx2-random-v0-train.npz"
    ),
}
STAGED = [name for name, command in COMMANDS.items() if command.stages]


@pytest.fixture(scope="session")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of a step each."""
    root = tmp_path_factory.mktemp("two")
    words = "collect --policy random --episodes 2 --horizon 1 --observation state --workers 1"
    assert knotgym(*words.split(), "--id", ID, "--out", root, "--quiet") == 0
    return root / ID


Type = Callable[..., int]


@pytest.fixture
def typed(tmp_path: Path, states_path: str, episodes: Path) -> Type:
    """Type a command by its name in COMMANDS, with more words; its exit status."""

    def type_it(name: str, *more: str) -> int:
        pytest.importorskip(COMMANDS[name].library)
        (tmp_path / "none.json").write_text("{}")
        places = {
            "out": tmp_path / "out",
            "states": states_path,
            "episodes": episodes,
            "none": tmp_path / "none.json",
        }
        words = [word.format(**places) for word in COMMANDS[name].words.split()]
        return knotgym(*words, "--quiet", *more)

    return type_it


def output_of(name: str, tmp_path: Path) -> Path:
    """Where a command writes; the folder for it is there."""
    path = tmp_path / "out" / COMMANDS[name].output
    path.parent.mkdir(parents=True)
    return path


def exists(kind: str, path: Path, tmp_path: Path) -> None:
    """Put a file, a folder or a link of the user's at a path."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("mine")
    if kind == "file":
        path.write_text("mine")
    elif kind == "folder":
        path.mkdir()
        (path / "file").write_text("mine")
    else:
        path.symlink_to(tmp_path / "mine" / ("file" if kind == "link to file" else ""))


def everything(folder: Path) -> dict[str, str]:
    """All below a folder: texts of files, ends of links."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.name not in ("lock", "none.json"):
            whole = f"-> {os.readlink(path)}" if path.is_symlink() else ""
            text = path.read_text() if path.is_file() else ""
            found[str(path.relative_to(folder))] = whole or text
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_what_exists_is_refused_in_one_line_and_stays(
    name: str, typed: Type, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = output_of(name, tmp_path)
    for kind in ("file", "folder", "link to file", "link to folder"):
        exists(kind, path, tmp_path)
        before = everything(tmp_path)
        capfd.readouterr()
        assert typed(name) == 2, kind
        (line,) = capfd.readouterr().err.splitlines()
        assert f"{path.name} exists already" in line and "--overwrite" in line
        other_kind = "folder" if path.suffix else "file"
        if kind.endswith(other_kind):  # a file never replaces a folder, nor a folder a file
            assert typed(name, "--overwrite") == 2, kind
            assert f"never replaces a {other_kind}" in capfd.readouterr().err
        assert everything(tmp_path) == before
        shutil.rmtree(tmp_path / "mine")
        shutil.rmtree(path) if kind == "folder" else path.unlink()


@pytest.mark.parametrize("name", STAGED)
def test_an_interrupted_run_goes_only_by_a_word_and_no_link_for_it_is_followed(
    name: str, typed: Type, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    staged = staging_folder(output_of(name, tmp_path))
    exists("folder", staged, tmp_path)
    for more in ((), ("--overwrite",)):
        before = everything(tmp_path)
        assert typed(name, *more) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "interrupted run" in line and "--resume" in line and "--restart" in line
        assert everything(tmp_path) == before
    shutil.rmtree(staged)
    staged.symlink_to(tmp_path / "mine")
    before = everything(tmp_path)
    for more in ((), ("--resume",), ("--restart",), ("--overwrite",)):
        assert typed(name, *more) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "is a link, and is never followed" in line
        assert everything(tmp_path) == before


def test_a_link_inside_a_staging_folder_is_refused_too(
    typed: Type, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    staged = staging_folder(output_of("evaluate", tmp_path))
    exists("folder", staged, tmp_path)
    (staged / "played.json").symlink_to(tmp_path / "mine" / "file")
    assert typed("evaluate", "--resume") == 2
    assert "is a link, and is never followed" in capfd.readouterr().err


def test_a_folder_of_another_user_is_refused(
    typed: Type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    exists("folder", staging_folder(output_of("evaluate", tmp_path)), tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert typed("evaluate", "--restart") == 2
    assert "belongs to another user" in capfd.readouterr().err


@pytest.mark.parametrize("kind", ["file", "link to file"])
def test_overwrite_replaces_a_file_and_never_what_a_link_points_to(
    kind: str, typed: Type, tmp_path: Path
) -> None:
    path = output_of("gallery", tmp_path)
    exists(kind, path, tmp_path)
    assert typed("gallery", "--overwrite") == 0
    assert path.read_bytes().startswith(b"\x89PNG") and not path.is_symlink()
    assert (tmp_path / "mine" / "file").read_text() == "mine"


def test_overwrite_and_restart_make_a_dataset_anew(typed: Type, tmp_path: Path) -> None:
    path, small = output_of("collect", tmp_path), ("--episodes", "1", "--set", "task.horizon=1")
    exists("folder", path, tmp_path)
    (staging_folder(path)).mkdir()
    (staging_folder(path) / "kept").write_text("")
    assert typed("collect", *small, "--workers", "1", "--overwrite", "--restart") == 0
    assert [one.name for one in path.parent.iterdir()] == [path.name]
    assert [one.name for one in path.iterdir()] == ["data"]


def test_what_another_process_writes_meanwhile_stays(tmp_path: Path) -> None:
    for name in ("a file", "a folder"):
        with pytest.raises(Occupied), atomic_write(tmp_path / name, overwrite=False) as part:
            part.mkdir() if name == "a folder" else part.write_text("new")
            exists(name.removeprefix("a "), tmp_path / name, tmp_path)
            shutil.rmtree(tmp_path / "mine")
    assert everything(tmp_path) == {"a file": "mine", "a folder": "", "a folder/file": "mine"}


@pytest.mark.parametrize("name", ["a file", "a folder"])
def test_the_old_one_goes_only_when_the_new_one_is_whole(name: str, tmp_path: Path) -> None:
    exists(name.removeprefix("a "), tmp_path / name, tmp_path)
    before = everything(tmp_path)
    with pytest.raises(RuntimeError), atomic_write(tmp_path / name) as part:
        part.mkdir() if name == "a folder" else part.write_text("new")
        raise RuntimeError
    assert everything(tmp_path) == before
    wrong = tmp_path / name
    with pytest.raises(Occupied, match="never replaces"), atomic_write(wrong) as part:
        part.write_text("new") if name == "a folder" else part.mkdir()
    assert everything(tmp_path) == before


def test_an_export_copies_a_datasets_own_files_and_no_links(
    episodes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(episodes, tmp_path / "copy")
    data, secret = tmp_path / "copy" / "data", tmp_path / "secret.txt"
    secret.write_text("secret")
    (data / "notes.json").symlink_to(secret)
    (data / "notes.txt").write_text("private")
    to_minari([tmp_path / "copy"], tmp_path / "upload")
    assert {path.name for path in (tmp_path / "upload" / ID / "data").iterdir()} == {
        "main_data.hdf5",
        "metadata.json",
        "collection.json",
    }
    (data / "main_data.hdf5").rename(tmp_path / "elsewhere.hdf5")
    (data / "main_data.hdf5").symlink_to(tmp_path / "elsewhere.hdf5")
    with pytest.raises(InvalidFile):
        to_minari([tmp_path / "copy"], tmp_path / "b")
    for form in ("compact", "minari", "lerobot", "ogbench", "huggingface"):
        assert knotgym("dataset", "export", data.parent, "--to", form, "--out", tmp_path / "b") == 2
        assert "only a dataset's own files are copied" in capfd.readouterr().err
    assert knotgym("dataset", "merge", data.parent, "--out", tmp_path / "b.h5") == 2
    assert not (tmp_path / "b").exists() and not (tmp_path / "b.h5").exists()


def test_a_cache_of_frames_follows_no_link(episodes: Path, tmp_path: Path) -> None:
    from knotgym.datasets.episode_reader import EpisodeReader

    (tmp_path / "mine").mkdir()
    (tmp_path / "cache").symlink_to(tmp_path / "mine")
    with pytest.raises(InvalidInput, match="is a link"):
        CachedFrames(EpisodeReader(episodes), None, FrameCache(tmp_path / "cache"))
    assert not any((tmp_path / "mine").iterdir())
