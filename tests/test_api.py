"""The public names: all there, listed once more by hand, and light to import."""

import ast
import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import knotgym

from .fresh_interpreter import modules_after

ROOT = Path(__file__).parents[1]
ROOMS = {module.name for module in pkgutil.iter_modules(knotgym.__path__) if module.ispkg}
PACKAGES = ("knotgym", *(f"knotgym.{room}" for room in sorted(ROOMS)))
MODULES = {
    room: {one.name for one in pkgutil.iter_modules([f"{ROOT}/knotgym/{room}"])} for room in ROOMS
}
EXTRAS = {"torch", "trimesh", "viser"}  # without them some rooms are only listed
EAGER = {"__version__"}  # all others are imported when they are first used


def package(name: str) -> ModuleType:
    return importlib.import_module(name)


def listed(name: str) -> dict[str, str]:
    """What the door of a package lists: public name -> the module that defines it."""
    stub = Path(package(name).__file__ or "").with_suffix(".pyi")
    return {
        alias.name: f"{name}.{node.module}"
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


@pytest.mark.parametrize("name", PACKAGES)
def test_a_door_names_each_thing_once_and_finds_it(name: str) -> None:
    assert {*listed(name)} == {*package(name).__all__} - EAGER
    for public, module in listed(name).items():
        try:
            found = getattr(importlib.import_module(module), public)
        except ModuleNotFoundError as error:
            assert error.name in EXTRAS
            continue
        assert getattr(package(name), public) is found


def test_rooms_are_entered_through_their_doors() -> None:
    """Only a room's own modules and its own tests may import from deeper than its door."""
    assert [place for path in sources() for place in round_the_door(path)] == []


def round_the_door(path: Path) -> Iterator[str]:
    """Imports of a file, or of the Python blocks of a page, that name a module of another room."""
    text, parts = path.read_text(encoding="utf-8"), path.relative_to(ROOT).parts
    own = parts[1] if len(parts) > 2 and parts[0] in ("knotgym", "tests") else ""
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)
    for node in ast.walk(ast.parse("\n".join(blocks) if path.suffix == ".md" else text)):
        if not isinstance(node, ast.Import | ast.ImportFrom) or getattr(node, "level", False):
            continue
        within = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
        for top, room, inside, *_ in (f"{within}{one.name}..".split(".") for one in node.names):
            if top == "knotgym" and inside in MODULES.get(room, ()) and room != own:
                yield f"{path}: knotgym.{room}.{inside}"


def sources() -> list[Path]:
    """Python files and pages of the checkout."""
    beside = ("benchmarks", "docs", "examples", "knotgym", "tests")
    files = [path for folder in beside for path in (ROOT / folder).rglob("*.py")]
    return [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *files]


@pytest.mark.parametrize("name", PACKAGES)
def test_a_public_name_is_never_that_of_a_module_beside_it(name: str) -> None:
    # whichever came last, the module or the name, would be what the package gives
    beside = {module.name for module in pkgutil.iter_modules(package(name).__path__)}
    assert beside & {*package(name).__all__} == set()


def test_importing_packages_imports_nothing_heavy() -> None:
    heavy = {
        *("cv2", "d3rlpy", "dask", "h5py", "matplotlib", "minari", "mujoco", "numba", "pandas"),
        *("polars", "pyarrow", "pydantic", "pyknotid", "rich", "torch"),
    }
    assert modules_after(f"import {', '.join(PACKAGES)}") & heavy == set()
