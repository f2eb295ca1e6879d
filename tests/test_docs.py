"""What people read: that examples run, that tables name what files and environments really have,
that links lead somewhere.
"""

import ast
import importlib
import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import h5py
import numpy as np
import pytest
from pytest_types import Capture, Patch
from synthetic_episodes import TINY

import knotgym
from knotgym import datasets
from knotgym.common import Table
from knotgym.envs import OBSERVATIONS, TaskConfig
from knotgym.rendering import APPEARANCES
from knotgym.states import write_states

from .scripts import ROOT
from .small_job import knotgym as typed
from .test_readme import steps

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
ENVIRONMENT = DOCS / "environment.md"

Rows = list[list[str]]
ID = "knotgym/tie-nx2/expert-v0"  # the dataset that the pages load


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def tables(page: Path) -> dict[str, Rows]:
    """The rows of all tables below each heading of a page, cell by cell, without their heads."""
    found: dict[str, Rows] = {}
    heading, in_table = "", False
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = line.lstrip("#").strip()
        if not line.startswith("|"):
            in_table = False
        elif line.startswith("| ---"):
            in_table = True
        elif in_table:
            cells = re.split(r"(?<!\\)\|", line.strip().strip("|"))
            found.setdefault(heading, []).append([cell.strip() for cell in cells])
    return found


def code_words(cell: str) -> list[str]:
    """What stands in backquotes."""
    return re.findall(r"`([^`]+)`", cell)


def names(rows: Rows) -> set[str]:
    """The names that the first cells of a table's rows are about."""
    return {word for row in rows for word in code_words(row[0])}


def defaults(heading: str) -> dict[str, Any]:
    """The keywords of a table of the page of the environment, and what they are by default."""
    rows = [[code_words(cell)[0] for cell in row[:2]] for row in tables(ENVIRONMENT)[heading]]
    return {name: ast.literal_eval(value) for name, value in rows}


def blocks(page: Path) -> list[str]:
    """The Python of a page, block by block."""
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)


@pytest.fixture(scope="module")
def minari(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with the one dataset that the pages load, and all that may be stored in one."""
    tiny = datasets.open_episodes(TINY["expert"])
    metadata = datasets.MinariMetadata(
        dataset_id=ID,
        algorithm_name="expert",
        description="Tiny.",
        author=("Ada",),
        author_email=("ada@example",),
        code_permalink="https://example.org",
        digests={"rope": tiny.task.rope_config.fingerprint},
    )
    facts = {"run": {"seed": 0}, "selection": []}
    root = tmp_path_factory.mktemp("minari")
    rows, steps = tiny.episodes
    sizes = dict(steps.schema.sizes)
    labelled = Table(datasets.STEPS.sized(**sizes), {**steps, "expert_action": steps["action"]})
    datasets.publish([datasets.Episodes(rows, labelled)], tiny.task, metadata, root, facts=facts)
    return root


def test_the_ten_lines_of_the_readme_run(capsys: Capture) -> None:
    ten = blocks(ROOT / "README.md")[0]
    assert sum(bool(line.strip()) for line in ten.splitlines()) <= 10
    exec(compile(ten, "README.md", "exec"), {})
    first, second = capsys.readouterr().out.splitlines()
    assert " -> " in first and second.startswith("177 ")


# Blocks that the fast tests don't run, by a word of theirs. Those of clients.md are run by
# tests/adapters/test_clients.py.
ELSEWHERE = {
    "data.md": "images(",  # below, with pictures
    "images.md": "read_rows(",
    "own-task.md": "own",  # below, with its commands
    "recipes.md": "# recipe",  # by tests/examples/test_learners.py
}


def with_blocks(page: Path) -> Any:
    """Mark the pages whose blocks need the extra learn."""
    marks = [pytest.mark.clients] if page.name in ("perception.md", "photos.md") else []
    return pytest.param(page, marks=marks, id=page_name(page))


@pytest.mark.parametrize(
    "page", [with_blocks(page) for page in PAGES if blocks(page) and page.name != "clients.md"]
)
def test_a_page_s_blocks_run(page: Path, minari: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(minari))
    monkeypatch.chdir(tmp_path)
    with patch.dict(APPEARANCES), patch.dict(OBSERVATIONS):  # a page may add one, for itself
        for block in blocks(page):
            if ELSEWHERE.get(page.name, "\0") not in block:
                exec(compile(block, page.name, "exec"), {"__name__": page.stem})


@pytest.mark.clients
def test_the_blocks_that_read_pictures_run(tmp_path: Path, monkeypatch: Patch) -> None:
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    few = "images --nx 0,1 --count 4 --set test_nx=none --set code_share=0 --workers 1 --quiet"
    assert typed(*few.split(), "--out", "pictures") == 0
    for page in ("data.md", "formats/images.md"):
        for block in blocks(DOCS / page):
            if ELSEWHERE[Path(page).name] in block:
                exec(compile(block, page, "exec"), {})


@pytest.mark.thorough
def test_the_page_of_an_own_task_runs_line_by_line(tmp_path: Path) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    own = {**os.environ, "PATH": path, "MINARI_DATASETS_PATH": str(tmp_path / "minari")}
    text = (DOCS / "own-task.md").read_text(encoding="utf-8")
    assert not re.search(r"knotgym(\.\w+)*\._", text)
    for kind, lines in steps(text):
        words = ["bash", "-euc", lines]
        if kind == "python":
            named = re.match(r"# (\w+\.py)\n", lines)
            (script := tmp_path / (named[1] if named else "block.py")).write_text(lines)
            words = [sys.executable, str(script)]
        subprocess.run(words, cwd=tmp_path, env=own, check=True, timeout=600)


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_lead_to_files_and_files_that_are_named_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)]+)\)", re.sub(r"```.*?```", "", text, flags=re.S)):
        if not target.startswith(("https://", "#")):
            assert (page.parent / target.partition("#")[0]).exists(), target
    named = re.findall(
        r"`((?:knotgym|tests|benchmarks|examples|docs)/[\w./-]*(?:\.\w+|/))[`:](?! at 44bef3e)",
        text,
    )
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_the_pages_of_commands_are_what_the_commands_say() -> None:
    for path, text in runpy.run_path(str(DOCS / "commands.py"))["pages"]().items():
        assert path.read_text(encoding="utf-8") == text, "run python docs/commands.py"


def test_the_page_of_the_environment_names_every_keyword_and_its_default() -> None:
    assert defaults("Keywords") == {
        field.name: field.default for field in fields(TaskConfig) if field.name != "task"
    }


def test_the_page_of_the_environment_names_what_info_holds(states_path: str) -> None:
    env = gym.make("knotgym/Tie-v0", nx=1, states=states_path, observation="state")
    info = env.reset(seed=0)[1]
    rows = tables(ENVIRONMENT)["Info"]
    assert names(rows) == info.keys()
    for row in rows:
        kind, value = row[1], info[code_words(row[0])[0]]
        assert kind == (
            f"{value.dtype} {value.shape}"
            if isinstance(value, np.ndarray)
            else type(value).__name__
        )


def test_the_state_file_is_as_its_page_says(tmp_path: Path) -> None:
    write_states(tmp_path / "states.h5", knotgym.read_states(knotgym.shipped()))
    with h5py.File(tmp_path / "states.h5") as file:
        said = names(tables(DOCS / "formats/states.md")["Attributes of the file"])
        assert said == {*file.attrs}


def test_tables_of_columns_are_those_of_the_schemas() -> None:
    with_tables = runpy.run_path(str(DOCS / "schemas.py"))["with_tables"]
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert text == with_tables(text), f"{page_name(page)}: run python docs/schemas.py"


def test_the_episode_file_is_as_its_page_says(minari: Path) -> None:
    said = tables(DOCS / "formats/episodes.md")
    with h5py.File(minari / ID / "data/episodes.h5") as file:
        # of states that aren't bundled, and of entries
        own = {"states_sha256", "tasks", "protocol", "claims"}
        assert names(said["Attributes of the file"]) - own == {*file.attrs} - own
    with h5py.File(minari / ID / "data/main_data.hdf5") as file:
        assert names(said["Attributes of an episode"]) == {*file["episode_0"].attrs}
        found = list[str]()
        file["episode_0"].visititems(
            lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None
        )
        named = {re.sub("/macro_.*", "/macro_*", name) for name in found}
        assert named and named <= names(said["Datasets of an episode"])


def test_minari_s_metadata_are_as_their_page_says(minari: Path) -> None:
    entries = json.loads((minari / ID / "data/metadata.json").read_text(encoding="utf-8"))
    said = names(tables(DOCS / "formats/episodes.md")["Entries of metadata.json"])
    scores = {"ref_min_score", "ref_max_score", "num_episodes_average_score"}
    assert said - scores == entries.keys() - scores


def test_formats_and_versions_are_those_of_the_overview() -> None:
    said = {
        code_words(row[2])[0]: int(re.findall(r"\d+", row[2])[0])
        for row in tables(DOCS / "formats/index.md")["File formats"]
        if code_words(row[2])
    }
    written = "states.schema datasets.episode_dataset datasets.image_table"
    written += " control.planning.moves learn.card"
    for module in map(
        vars, (importlib.import_module(f"knotgym.{name}") for name in written.split())
    ):
        version = module.get("FORMAT_VERSION", module.get("VERSION", 1))
        assert said.pop(module["FORMAT"]) == version
    assert said == {}


def test_the_citation_has_the_version_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {project['version']}\n" in citation
    assert all((ROOT / name).is_file() for name in project["license-files"])


@pytest.mark.parametrize(
    "name",
    ["readable", "random-walk", "hard-unknots", pytest.param("bench", marks=pytest.mark.thorough)],
)
def test_what_train_and_test_share_is_as_computed(name: str) -> None:
    said = [line for line in (DOCS / "sets.md").read_text().splitlines() if "| `" in line]
    for row in datasets.summary(datasets.locate(name))[2]["train and test"].rows:
        assert f"| `{name}` | {' | '.join(map(str, row))} |" in said
