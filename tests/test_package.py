"""The package as a stranger meets it: what importing it costs and gives, that its errors travel,
and what the wheel holds.
"""

import importlib
import importlib.metadata
import os
import pickle
import re
import shutil
import tomllib
import zipfile
from pathlib import Path

import pytest

from knotgym.common import KnotgymError

from .fresh_interpreter import modules_after, python

ROOT = Path(__file__).parents[1]
# a renderer's modules; some of it is imported by mujoco itself
DRAWING = {f"mujoco.{name}" for name in ("renderer", "rendering", "egl", "osmesa", "glfw")}
HEAVY = {"torch", "dask", "minari", "pandas", "pyarrow", "pyknotid", "matplotlib", "OpenGL", "glfw"}

ERRORS = [
    one
    for one in vars(importlib.import_module("knotgym.common.errors")).values()
    if isinstance(one, type) and issubclass(one, KnotgymError)
]


@pytest.mark.thorough
def test_a_task_made_alone_imports_no_learner_nor_renderer(states_path: str) -> None:
    made = f"gymnasium.make('knotgym:knotgym/Convert-v0', states={states_path!r}).reset(seed=0)"
    modules = modules_after(f"import gymnasium; {made}")
    assert "knotgym.envs.environment" in modules
    assert (modules - modules_after("import mujoco.batch")) & (HEAVY | DRAWING) == set()


@pytest.mark.thorough
def test_the_package_runs_where_no_machine_code_can_be_kept(tmp_path: Path) -> None:
    copy = tmp_path / "knotgym"
    shutil.copytree(ROOT / "knotgym", copy, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in (copy, *(one for one in copy.rglob("*") if one.is_dir())):
        (folder / "__pycache__").touch()  # in the way of a folder: root may write everywhere
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    environment = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    environment |= {"HOME": "/dev/null", "TMPDIR": str(temporary), "PYTHONPATH": str(tmp_path)}
    lines = (
        "import knotgym, os; from knotgym.topology.crossings import label;"
        " assert knotgym.__file__.startswith(os.environ['PYTHONPATH']), knotgym.__file__;"
        " label(knotgym.Rope().loop()); print(os.environ['NUMBA_CACHE_DIR'])"
    )
    ended = python("-c", lines, env=environment, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert str(temporary) in ended.stdout and not any(temporary.iterdir())


def test_the_main_job_imports_only_what_it_uses(tmp_path: Path) -> None:
    words = f"generate --nx 1 --count 1 --workers 1 --quiet --out {tmp_path / 'a'}"
    job = f"from knotgym.cli import main\ntry: main({words.split()})\nexcept SystemExit: pass"
    modules = modules_after(job)
    ours = sorted(name for name in modules if name.partition(".")[0] == "knotgym")
    assert (tmp_path / "a" / "states.h5").is_file() and "torch" not in modules
    # A room that the job begins to use may raise this; a policy or environment that it doesn't use
    # may not.
    assert len(ours) <= 100, ours


def test_every_marker_and_every_step_runs_in_ci() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    steps, run, every = ((ROOT / ".ci" / name).read_text() for name in ("steps", "run", "all"))
    bodies = dict(re.findall(r"^(\w+)\(\) \{(.*?)^\}", steps, re.M | re.S))
    landing, nightly = (
        {step for lane in re.findall(r"^lane \w+ (.*)", text, re.M) for step in lane.split()}
        for text in (run, every)
    )
    assert landing - {"$(touched_clients)"} < nightly
    assert nightly == {name for name, body in bodies.items() if "    within " in body}
    for marker in options["markers"]:
        name = marker.partition(":")[0]
        runs = re.compile(rf"^[^#\n]*pytest\S* .*-m {name}\b", re.M)
        assert any(runs.search(bodies[step]) for step in nightly), name


@pytest.mark.parametrize("error", ERRORS)
def test_every_error_pickles_with_its_message(error: type[KnotgymError]) -> None:
    again = pickle.loads(pickle.dumps(error.__new__(error, "what was wrong")))
    assert type(again) is error and str(again) == "what was wrong"


@pytest.mark.slow
def test_the_wheel_installs_elsewhere_and_loads_its_assets(tmp_path: Path) -> None:
    # without the links at the top level, as a checkout that cannot have them
    source = tmp_path / "source"
    shutil.copytree(
        ROOT,
        source,
        ignore=shutil.ignore_patterns(".*", "build", "dist", "*.egg-info", "__pycache__", "tests"),
    )
    for link in ("datasets", "generate", "loaders"):
        shutil.rmtree(source / link)
    python("-m", "pip", "wheel", "--no-deps", "--wheel-dir", tmp_path, source, check=True)
    (wheel,) = tmp_path.glob("knotgym-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    assert {"knotgym/py.typed", "knotgym/states/curated/states.h5"} <= names
    assert "knotgym/datasets/card_templates/state_card.md" in names
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"knotgym"}
    code = (
        "import gymnasium, knotgym; gymnasium.make('knotgym/Convert-v0', nx=4).reset(seed=0);"
        " print(knotgym.__file__)"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    run = python("-c", code, cwd=tmp_path, env=environment, check=True)
    assert Path(run.stdout.strip()) == tmp_path / "site" / "knotgym" / "__init__.py"
