"""How many small faults the tests find: mutants of a room's code, run against the tests.

    python benchmarks/mutants.py topology states datasets loaders --count 100 --out mutants.json

A mutant differs from the code in one place, drawn from the seed: a comparison turned round or by
its edge, + for -, * for /, `and` for `or`, a condition denied, a whole number one more. It is
killed if a test fails, or if the tests take --limit CPU seconds. Each is tried in a copy of the
checkout: first by the tests of a default run that run its line, as coverage says (none is known of
compiled functions), then by the tests of its room. Survivors are listed with what was changed: each
is a test that is missing, or code that means the same. With --out each mutant is written down at
once; the same command goes on where it was stopped, and a larger --count adds more.
"""

import ast
import copy
import json
import resource
import shutil
import subprocess
import sys
import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from coverage import CoverageData

ROOT = Path(__file__).parents[1]
PAIRS: list[tuple[type, type]] = [(ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq)]
PAIRS += [(ast.Is, ast.IsNot), (ast.Add, ast.Sub), (ast.And, ast.Or)]
SWAPPED = {ast.In: ast.NotIn, ast.Mult: ast.Div, **dict(PAIRS), **{b: a for a, b in PAIRS}}


def swap(node: Any, name: str) -> None:
    """Put the other operator, or the first of several, in a node's place for it."""
    held = getattr(node, name)
    if isinstance(held, list):
        held[0] = SWAPPED[type(held[0])]()
    else:
        setattr(node, name, SWAPPED[type(held)]())


def deny(node: Any) -> None:
    """Deny a node's condition."""
    node.test = ast.UnaryOp(ast.Not(), node.test)


def count_on(node: Any) -> None:
    """Make a number one more."""
    node.value += 1


def changes(node: ast.AST) -> Iterator[Callable[[Any], None]]:
    """Yield what can be done to a node."""
    for name in ("op", "ops"):
        held = getattr(node, name, None)
        first = held[0] if isinstance(held, list) else held
        if type(first) in SWAPPED and not isinstance(node, ast.AugAssign):
            yield partial(swap, name=name)
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield deny
    if isinstance(node, ast.Constant) and type(node.value) is int:
        yield count_on


def mutants(path: Path) -> list[Callable[[], tuple[str, str]]]:
    """Return the mutants of a file: what says line and change, and gives the text of the file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))

    def mutant(place: int, change: Callable[[Any], None]) -> tuple[str, str]:
        other = copy.deepcopy(tree)
        node: Any = next(node for k, node in enumerate(ast.walk(other)) if k == place)
        before = ast.unparse(node).splitlines()[0]
        change(node)
        said = f"{node.lineno}: {before} -> {ast.unparse(node).splitlines()[0]}"
        return said, ast.unparse(ast.fix_missing_locations(other))

    nodes = enumerate(ast.walk(tree))
    return [partial(mutant, place, change) for place, node in nodes for change in changes(node)]


def fails(copied: Path, words: list[str], limit: int) -> bool:
    """Return whether a test fails in a copy of the checkout, or takes too long."""
    run = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *words]
    within = partial(resource.setrlimit, resource.RLIMIT_CPU, (limit, limit))
    try:  # what waits for ever takes no CPU time
        ended = subprocess.run(
            run, cwd=copied, capture_output=True, timeout=20 * limit, preexec_fn=within
        )
    except subprocess.TimeoutExpired:
        return True
    return ended.returncode != 0


def is_killed(copied: Path, known: CoverageData, module: Path, line: int, limit: int) -> bool:
    """Return whether a test fails: one that runs a line, or another of its room."""
    contexts = (known.contexts_by_lineno(str(copied / module)) or {}).get(line, [])
    running = sorted({name.rpartition("|")[0] for name in contexts} - {""})
    room = str(Path("tests", *module.parts[1:-1]))
    return any(fails(copied, words, limit) for words in (running, [room]) if words)


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="+", help="rooms of the package, such as topology")
    parser.add_argument("--count", type=int, default=100, help="mutants, as many of each room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, default=300, help="CPU seconds of a run of the tests")
    parser.add_argument("--out", type=Path, help="where to write the result as JSON")
    asked, result = parser.parse_args(), dict[str, Any]()
    if asked.out and asked.out.exists():
        result = json.loads(asked.out.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as name:
        copied = Path(name, "checkout")
        unwanted = shutil.ignore_patterns(".git", ".venv", ".*cache", "__pycache__", "build")
        shutil.copytree(ROOT, copied, symlinks=True, ignore=unwanted)
        traced = ["--cov=knotgym", "--cov-context=test", "--cov-report=", "--cov-fail-under=0"]
        if fails(copied, traced, 10 * asked.limit):
            sys.exit("the tests fail without a mutant")
        known = CoverageData(str(copied / ".coverage"))
        known.read()
        for room in asked.rooms:
            files = sorted((ROOT / "knotgym" / room).rglob("*.py"))
            sizes = np.array([path.stat().st_size for path in files], dtype=float)
            rng = np.random.default_rng([asked.seed, *room.encode()])
            own = result.setdefault(room, {"killed": 0, "survivors": []})
            before = own["killed"] + len(own["survivors"])
            for number in range(-(-asked.count // len(asked.rooms))):
                found = list[Callable[[], tuple[str, str]]]()
                while not found:
                    path = files[rng.choice(len(files), p=sizes / sizes.sum())]
                    found = mutants(path)
                module, chosen = path.relative_to(ROOT), found[rng.integers(len(found))]
                if number < before:
                    continue
                said, text = chosen()
                (copied / module).write_text(text, encoding="utf-8")
                if is_killed(copied, known, module, int(said.partition(":")[0]), asked.limit):
                    own["killed"] += 1
                else:
                    own["survivors"].append(f"{module}:{said}")
                shutil.copy(path, copied / module)
                print(f"{room}: {own['killed']} killed, alive {own['survivors']}", flush=True)
                if asked.out:
                    asked.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
