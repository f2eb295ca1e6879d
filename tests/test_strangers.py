"""Files of strangers are data: what they name isn't followed, and what they claim is computed.

Each test failed before the fault that it tells of was mended.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Capture, Patch
from synthetic_episodes import TINY

import knotgym
from knotgym.datasets import open_episodes, write_episodes
from knotgym.states import read_states, write_states

from .fresh_interpreter import python
from .small_job import knotgym as typed

ID = "knotgym/tie-nx2/expert-v0"
PLAY = "--task tie --nx 2 --engine chain --workers 1 --quiet"


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of the expert, with their run's facts; only ever read."""
    root = tmp_path_factory.mktemp("minari")
    words = f"collect {PLAY} --episodes 4 --id {ID} --set task.horizon=30"
    assert typed(*words.split(), "--out", root) == 0
    assert knotgym.verify(root / ID) == []
    return root / ID


@pytest.mark.parametrize(
    "words",
    [
        f"collect {PLAY} --policy random --episodes 1 --states {{}} --id a/b-v0 --out {{}}/out",
        f"evaluate {PLAY} --policy random --episodes 1 --states {{}}",
        "images --nx 1 --count 1 --engine chain --workers 1 --states {} --out {}/out",
        "dataset show {}",
        "dataset gallery {} --out {}/a.png",
        "dataset page {} --out {}/a.html",
        "dataset replay {} --out {}/a.gif",
        "dataset export {} --to huggingface --out {}/out",
        "dataset merge {} --out {}/a.h5",
    ],
)
def test_a_link_planted_in_a_folder_is_not_followed(
    words: str, states_path: str, tmp_path: Path, capfd: Capture
) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "states.h5").symlink_to(states_path)
    assert typed(*words.format(tmp_path / "set", tmp_path).split()) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "states.h5 is a link" in line
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_set_shares_no_file_with_its_states(states_path: str, tmp_path: Path) -> None:
    words = f"collect {PLAY} --policy random --episodes 1 --set task.horizon=2 --id a/b-v0"
    assert typed(*words.split(), "--states", states_path, "--out", tmp_path) == 0
    made = tmp_path / "a" / "b-v0"
    merge = f"dataset merge {made} --id a/c-v0 --out {tmp_path} --quiet"
    assert typed(*merge.split()) == 0
    own = [
        Path(states_path),
        *(path / "data" / "states.h5" for path in (made, made.parent / "c-v0")),
    ]
    assert len({path.stat().st_ino for path in own}) == 3


@pytest.mark.parametrize(
    ("table", "column", "value", "says"),
    [
        ("episodes", "seed", 5, "seed is none of the run's"),
        ("episodes", "seed", [1, 0], "seed draws another"),  # rows exchange their values
        ("episodes", "start", [1, 1], "goes with another state|draws another start|isn't row"),
        ("steps", "macro_bead", 99, "isn't one of the macro-action"),
        ("steps", "macro_target", 60_000, "isn't one of the macro-action"),
        ("steps", "macro_side", 7, "isn't one of the macro-action"),
    ],
)
def test_what_was_not_played_is_a_fault(
    collected: Path, tmp_path: Path, table: str, column: str, value: Any, says: str
) -> None:
    dataset = open_episodes(collected)
    columns = {name: array.copy() for name, array in getattr(dataset.episodes, table).items()}
    if isinstance(value, list):
        columns[column][: len(value)] = columns[column][value]
    else:
        columns[column][0] = value
    harmed = getattr(dataset.episodes, table).replaced(**columns)
    episodes = dataset.episodes._replace(**{table: harmed})
    write_episodes(tmp_path / "a.h5", [episodes], dataset.task, dataset.facts)  # digests fit them
    (fault, *_) = knotgym.verify(tmp_path / "a.h5")
    assert re.search(says, fault)


@pytest.mark.parametrize("selection", ["x", 3, {"a": 1}, [1]])
@pytest.mark.parametrize("kind", ["states", "episodes"])
def test_a_selection_of_another_form_is_one_line(
    kind: str, selection: Any, states_path: str, tmp_path: Path, capfd: Capture
) -> None:
    path = tmp_path / "set.h5"
    if kind == "states":
        write_states(path, read_states(states_path).replaced({}, selection=selection))
    else:
        dataset = open_episodes(TINY["random"])
        facts = {**dataset.facts, "selection": selection}
        write_episodes(path, [dataset.episodes], dataset.task, facts)
    for words in ("select --sample 1", "split --parts a=0.5,b=0.5"):
        assert typed("dataset", *words.split(), path, "--out", tmp_path / "out.h5") == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "its selection should be a list of objects" in line
    assert [one.name for one in tmp_path.iterdir()] == ["set.h5"]


def test_a_state_file_is_not_by_vertices_as_it_says(states_path: str, tmp_path: Path) -> None:
    write_states(tmp_path / "a.h5", read_states(states_path).replaced({}, form="vertices"))
    assert not read_states(tmp_path / "a.h5").by_vertices


@pytest.mark.parametrize("named", ["{path}", "{root}/a/../../states.h5", "a/../../states.h5"])
@pytest.mark.parametrize("beside", ["", "stray"])
def test_states_that_a_file_names_elsewhere_are_not_published(
    named: str, beside: str, states_path: str, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "root"))
    (tmp_path / "root" / "a").mkdir(parents=True)
    private = tmp_path / "states.h5"  # as if it were a private file of the user
    private.write_bytes(Path(states_path).read_bytes())
    given = tmp_path / "given"
    given.mkdir()
    dataset = open_episodes(TINY["random"])
    task = replace(dataset.task, states=named.format(path=private, root=tmp_path / "root"))
    write_episodes(given / "set.h5", [dataset.episodes], task, {"states_sha256": "0" * 64})
    if beside:
        (given / "states.h5").write_bytes(private.read_bytes())
    words = ("merge", given / "set.h5", "--id", "a/b-v0")
    assert typed("dataset", *words, "--out", tmp_path / "out") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "SHA-256" in line and not (tmp_path / "out").exists()


def test_an_id_names_no_folder_to_write(tmp_path: Path, capfd: Capture) -> None:
    dataset = open_episodes(TINY["random"])
    metadata = {**(dataset.metadata or {}), "dataset_id": "a/b-x/../../../c"}
    facts = {**dataset.facts, "metadata": metadata}
    write_episodes(tmp_path / "set.h5", [dataset.episodes], dataset.task, facts)
    for form in ("ogbench", "minari"):
        words = ("export", tmp_path / "set.h5", "--to", form, "--out", tmp_path / "out")
        assert typed("dataset", *words) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "a dataset id has the form" in line
    assert [one.name for one in tmp_path.iterdir()] == ["set.h5"]


@pytest.mark.thorough  # which runs where mkdocs brings it
def test_settings_of_numba_in_the_current_folder_are_not_read(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    for text in ("{: no yaml", "disable_jit: 1\n"):
        (tmp_path / ".numba_config.yaml").write_text(text)
        script = "import knotgym, numba; print(numba.config.DISABLE_JIT); import yaml"
        ended = python("-P", "-c", script, cwd=tmp_path)
        assert (ended.stdout, ended.stderr) == ("0\n", "")


def test_a_replay_of_a_generated_state_ends_in_it(tmp_path: Path) -> None:
    words = "generate --nx 0 --count 1 --engine chain --workers 1 --no-demonstrations --quiet"
    assert typed(*words.split(), "--out", tmp_path / "set") == 0
    assert typed("dataset", "replay", tmp_path / "set", "--out", tmp_path / "a.gif", "--quiet") == 0
