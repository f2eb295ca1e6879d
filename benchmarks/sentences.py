"""Draw sentences at random, to be read by a person: docstrings, errors, help texts and pages.

    python benchmarks/sentences.py --seed 20261128 [--docstrings 40] [--errors 20] [--helps 10]
        [--pages 3]

The same seed draws the same ones from the same checkout. Pages are named, the rest is printed.
"""

import argparse
import ast
import random
import re
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
Found = tuple[str, str]  # where it stands, and what it says


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, required=True)
    pools = {"docstrings": [*docstrings()], "errors": [*errors()], "helps": [*helps()]}
    pools["pages"] = [(_name(path), "") for path in sorted((REPOSITORY / "docs").rglob("*.md"))]
    for (name, pool), count in zip(pools.items(), (40, 20, 10, 3), strict=True):
        parser.add_argument(f"--{name}", type=int, default=count, help=f"of {len(pool)}")
    given = vars(parser.parse_args())
    rng = random.Random(given["seed"])
    for name, pool in pools.items():
        print(f"== {name}, {given[name]} of {len(pool)}")
        for where, text in rng.sample(pool, given[name]):
            print(f"{where}\n{text}" if text else where)


def docstrings() -> Iterator[Found]:
    """Yield the docstrings of modules, classes and functions."""
    for path, node in _nodes():
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield f"{_name(path)} {getattr(node, 'name', '')}".rstrip(), text


def errors() -> Iterator[Found]:
    """Yield what is raised with a message, as code."""
    for path, node in _nodes():
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            yield f"{_name(path)}:{node.lineno}", ast.unparse(node.exc)


def helps() -> Iterator[Found]:
    """Yield the options of all commands, from the page that is generated from their --help."""
    page = REPOSITORY / "docs" / "commands.md"
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if re.match(r"- `-", line):
            yield f"{_name(page)}:{number}", line


def _nodes() -> Iterator[tuple[Path, ast.AST]]:
    for path in sorted((REPOSITORY / "knotgym").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            yield path, node


def _name(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


if __name__ == "__main__":
    main()
