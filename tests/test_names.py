"""Every refusal is an error of this package, which a caller can catch by one name."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "knotgym").rglob("*.py"))


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
