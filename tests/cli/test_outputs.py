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
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from pytest_types import Capture, Patch

from knotgym.common import list_files
from knotgym.runs import RunOptions, staged

from ..small_job import knotgym, staging_of

ID = "knotgym/tie-nx2/random-v0"


class Command(NamedTuple):
    """A command, and what it writes.

    Attributes:
        words: with {out}, {states}, {episodes} and {none}, a file of no settings.
        output: below the folder named `out`; a name with a suffix is a file.
        stages: whether it can be interrupted and resumed.
    """

    words: str
    output: str
    stages: bool = False


COMMANDS = {
    "generate": Command("generate --nx 0 --count 1 --workers 1 --out {out}/a", "a", True),
    "images": Command("images --nx 0 --count 1 --out {out}/a", "a", True),
    "collect": Command(f"collect --policy random --id {ID} --out {{out}}", ID, True),
    "suite": Command("suite --task tie --nx 2 --policy random --out {out}", ID),
    "train": Command("train --data {episodes} --out {out}/a", "a", True),
    "prompt": Command("prompt --model x --out {out}/a", "a", True),
    "evaluate": Command("evaluate --episodes 1 --out {out}/a.json", "a.json", True),
    "video": Command("evaluate --episodes 1 --video {out}/a.gif", "a.gif"),
    "gallery": Command("dataset gallery {states} --out {out}/a.png", "a.png"),
    "page": Command("dataset page {states} --out {out}/a.html", "a.html"),
    "replay": Command("dataset replay {episodes} --out {out}/a.gif", "a.gif"),
    "merge": Command("dataset merge {states} --out {out}/a.h5", "a.h5"),
    "merge --id": Command(f"dataset merge {{episodes}} --id {ID} --out {{out}}", ID),
    "compact": Command("dataset export {episodes} --out {out}/a.h5", "a.h5"),
    "minari": Command("dataset export {episodes} --to minari --out {out}/a", "a"),
    "huggingface": Command("dataset export {episodes} --to huggingface --out {out}/a", "a"),
    "select": Command("dataset select {states} --sample 1 --out {out}/a.h5", "a.h5"),
    "ogbench": Command(
        "dataset export {episodes} --to ogbench --out {out}/a", "a/tie-nx2-random-v0-train.npz"
    ),
}
STAGED = [name for name, command in COMMANDS.items() if command.stages]


def rows(names: Iterable[str]) -> list[Any]:
    """The names as parameters; what trains needs torch."""
    marks = {"train": pytest.mark.clients}
    return [pytest.param(name, marks=marks.get(name, ())) for name in names]


@pytest.fixture(scope="session")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of a step each."""
    root = tmp_path_factory.mktemp("two")
    words = "collect --policy random --episodes 2 --set task.horizon=1 --workers 1"
    assert knotgym(*words.split(), "--id", ID, "--out", root, "--quiet") == 0
    return root / ID


Type = Callable[..., int]


@pytest.fixture
def typed(tmp_path: Path, states_path: str, episodes: Path, monkeypatch: Patch) -> Type:
    """Type a command by its name in COMMANDS, with more words; its exit status."""

    def type_it(name: str, *more: str) -> int:
        monkeypatch.setenv("OPENAI_API_KEY", "none")
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


@pytest.mark.parametrize("name", rows(COMMANDS))
def test_what_is_there_stays(name: str, typed: Type, tmp_path: Path, capfd: Capture) -> None:
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


@pytest.mark.parametrize("name", rows(STAGED))
def test_an_interrupted_run_goes_only_by_a_word_and_no_link_for_it_is_followed(
    name: str, typed: Type, tmp_path: Path, capfd: Capture
) -> None:
    out = output_of(name, tmp_path)
    left = staging_of(out)
    with staged(out, {"of": "another run"}, RunOptions()) as (_, journal):
        journal["one"] = {"result": np.zeros(3)}
    for more in ((), ("--overwrite",)):
        assert typed(name, *more) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "interrupted run" in line and "--resume" in line and "--restart" in line
        assert (left / "journal/one.npy").is_file()
    assert typed(name, "--resume") == 2  # a journal of another run
    capfd.readouterr()
    shutil.rmtree(left)
    (tmp_path / "mine").mkdir()
    left.symlink_to(tmp_path / "mine")
    for more in ((), ("--resume",), ("--restart",), ("--overwrite",)):
        assert typed(name, *more) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "is a link, and is never followed" in line
        assert not list((tmp_path / "mine").iterdir())


@pytest.mark.parametrize("kind", ["file", "link to file"])
def test_overwrite_replaces_files_but_no_link_s_end(kind: str, typed: Type, tmp_path: Path) -> None:
    path = output_of("gallery", tmp_path)
    exists(kind, path, tmp_path)
    assert typed("gallery", "--overwrite") == 0
    assert path.read_bytes().startswith(b"\x89PNG") and not path.is_symlink()
    assert (tmp_path / "mine" / "file").read_text() == "mine"


def test_overwrite_replaces_sets_not_folders(typed: Type, tmp_path: Path, capfd: Capture) -> None:
    path = output_of("collect", tmp_path)
    words = ("--episodes", "1", "--set", "task.horizon=1", "--workers", "1", "--overwrite")
    exists("folder", path, tmp_path)
    assert typed("collect", *words) == 2 and (path / "file").is_file()
    shutil.rmtree(path)
    assert typed("collect", *words) == 0 and typed("collect", *words) == 0
    assert {one.name for one in path.iterdir()} == {"data", "manifest.json"}


SOURCES = {
    "collect": f"collect --policy random --episodes 1 --states {{h5}} --id {ID} --out {{root}}",
    "evaluate": "evaluate --episodes 1 --states {h5} --out {h5}",
    "video": "evaluate --episodes 1 --states {gif} --video {gif}",
    "settings": "evaluate --episodes 1 --settings {json} --out {json}",
    "images": "images --nx 0 --count 1 --states {h5} --out {set}",
    "generate": "generate --codes {codes} --out {codes}",
    "train": "train --data {set} --out {set}",
    "gallery": "dataset gallery {png} --out {png}",
    "page": "dataset page {html} --out {html}",
    "replay": "dataset replay {gif} --out {gif}",
    "import": "dataset import {npy} --out {npy}",
    "select": "dataset select {h5} --sample 1 --out {h5}",
    "split": "dataset split {h5} --parts a=0.5,b=0.5 --out {h5}",
    "delete": "dataset delete {h5} --rows 0 --out {h5}",
    "export": "dataset export {set} --to minari --out {set}",
    "merge": f"dataset merge {{set}} --id {ID} --out {{root}}",
}


@pytest.mark.parametrize("name", rows(SOURCES))
def test_a_source_is_never_replaced_not_even_with_overwrite(
    name: str, states_path: str, episodes: Path, tmp_path: Path, capfd: Capture
) -> None:
    root = tmp_path / "root"
    shutil.copytree(episodes, root / ID)
    places = {"root": root, "set": root / ID, "h5": root / ID / "data" / "states.h5"}
    for kind in ("gif", "html", "png", "json", "npy", "codes"):
        places[kind] = tmp_path / f"a.{kind}"
        shutil.copy(states_path, places[kind])
    shutil.copy(states_path, places["h5"])
    list_files(root / ID)
    places["json"].write_text("{}")
    places["codes"].write_text("1+,1-\n")
    np.save(places["npy"], np.zeros((8, 3)))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    words = [word.format(**places) for word in SOURCES[name].split()]
    assert knotgym(*words, "--overwrite", "--quiet") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "its source" in line or "reads; choose another" in line, line
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
