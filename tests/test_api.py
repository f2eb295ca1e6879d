"""The public names: all there, listed once more by hand, light to import, and seen by mypy."""

import ast
import importlib
import importlib.util
import pkgutil
from pathlib import Path
from types import ModuleType
from typing import assert_type

import pytest

import knotgym

from .fresh_interpreter import modules_after

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "knotgym",
    "knotgym.adapters",
    "knotgym.datasets",
    "knotgym.generate",
    "knotgym.loaders",
)
EAGER = {"__version__"}  # all others are imported when they are first used


def package(name: str) -> ModuleType:
    return importlib.import_module(name)


def tree_of(name: str) -> ast.Module:
    return ast.parse(Path(package(name).__file__ or "").read_text(encoding="utf-8"))


def checked_imports(name: str) -> dict[str, str]:
    """What a package imports for type checkers: public name -> "module:name"."""
    guards = [node for node in tree_of(name).body if isinstance(node, ast.If)]
    (guard,) = (node for node in guards if ast.unparse(node.test) == "TYPE_CHECKING")
    return {
        alias.asname or alias.name: f"{node.module}:{alias.name}"
        for node in guard.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


@pytest.mark.parametrize("name", PACKAGES)
def test_type_checkers_and_the_interpreter_see_the_same_names(name: str) -> None:
    assert {*checked_imports(name)} == {*package(name).__all__} - EAGER


@pytest.mark.parametrize(
    ("name", "public"), [(name, public) for name in PACKAGES for public in package(name).__all__]
)
def test_a_public_name_is_what_its_module_holds(name: str, public: str) -> None:
    if public in EAGER:
        assert isinstance(getattr(package(name), public), str)
        return
    module, _, there = checked_imports(name)[public].partition(":")
    assert getattr(package(name), public) is getattr(importlib.import_module(module), there)


@pytest.mark.parametrize("name", PACKAGES)
def test_a_public_name_is_never_that_of_a_module_beside_it(name: str) -> None:
    # whichever came last, the module or the name, would be what the package gives
    beside = {module.name for module in pkgutil.iter_modules(package(name).__path__)}
    assert beside & {*package(name).__all__} == set()


@pytest.mark.parametrize("name", PACKAGES)
def test_dir_lists_the_public_names_and_a_wrong_one_is_refused(name: str) -> None:
    assert {*package(name).__all__} <= {*dir(package(name))}
    with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'knotty'"):
        _ = package(name).knotty


@pytest.mark.parametrize("name", PACKAGES)
def test_importing_a_package_imports_nothing_heavy(name: str) -> None:
    heavy = {
        *("cv2", "d3rlpy", "dask", "h5py", "matplotlib", "minari", "mujoco", "numba", "pandas"),
        *("polars", "pyarrow", "pydantic", "pyknotid", "rich", "torch"),
    }
    assert modules_after(f"import {name}") & heavy == set()


def test_types_are_what_mypy_is_told() -> None:
    """Where mypy reads this file, it checks these too."""
    assert_type(knotgym.label(knotgym.Rope().loop()), knotgym.GaussCode)
    assert_type(knotgym.read_states(knotgym.shipped(), images=False), knotgym.States)
    assert_type(knotgym.TaskConfig(task="tie").start_nx, int)
