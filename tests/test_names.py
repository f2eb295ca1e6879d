"""Every class and every module is found by its name alone."""

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "knotgym").rglob("*.py"))
CLASS = re.compile(r"^ *class (\w+)", re.MULTILINE)


def twice(names: list[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]


def test_no_two_modules_have_one_name() -> None:
    assert FILES and twice([path.name for path in FILES if path.stem != "__init__"]) == []


def test_no_two_classes_have_one_name() -> None:
    classes = [name for path in FILES for name in CLASS.findall(path.read_text(encoding="utf-8"))]
    assert classes and twice(classes) == []


def test_what_a_module_says_to_run_is_there() -> None:
    named = re.compile(
        r"((?:tests|benchmarks)/[\w/]+\.py)(?![^`]*`?\s(?:#\s)?at\s(?:#\s)?[0-9a-f]{7})"
    )
    absent = {
        f"{path.name}: {name}"
        for path in FILES
        for name in named.findall(path.read_text(encoding="utf-8"))
        if not (ROOT / name).is_file()
    }
    assert absent == set()


def plain_errors(module: ast.Module) -> list[ast.Raise]:
    """Where errors of Python's own are raised.

    Not in a `try`, which makes ours of them, nor in `__len__`, where a TypeError says "no length".
    """
    caught = {
        inner
        for block in ast.walk(module)
        if isinstance(block, ast.Try) or getattr(block, "name", "") == "__len__"
        for statement in getattr(block, "body", [])
        for inner in ast.walk(statement)
    }
    return [
        node
        for node in ast.walk(module)
        if isinstance(node, ast.Raise)
        and node not in caught
        and isinstance(node.exc, ast.Call)
        and isinstance(node.exc.func, ast.Name)
        and node.exc.func.id in ("ValueError", "RuntimeError", "TypeError", "FileNotFoundError")
    ]


def test_every_refusal_is_a_knotgym_error() -> None:
    assert [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path, text in ((path, path.read_text(encoding="utf-8")) for path in FILES)
        if "Error(" in text
        for node in plain_errors(ast.parse(text))
    ] == []
