"""Random commands, most of them wrong: whether each ends in one clear line.

    python benchmarks/fuzz.py --commands 1500 --out fuzz.jsonl

Options and arguments are those that the help of each command lists; values are drawn from files of
every kind, damaged, linked or missing, and from numbers and texts of every size. A command runs in
a fork of this process, in a folder with small datasets. It must end with status 0, 1, 2 or 130,
without a traceback, in --memory megabytes; an interruption after --seconds must end it; a mistake
(status 2) is one line, and nothing is written. Each command that failed is a line of --out, with
its words and what went wrong; number k depends on the seed and k alone.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from commands import Outcome, played
from rich.console import Console

from knotgym.cli import application

DATASET = "show verify gallery replay page select split delete merge import export".split()
NOT = ("dataset", "play", "demo")
NAMES = [name for name in application() if name[0] != "-" and name not in NOT]
NAMES += [f"dataset {name}" for name in DATASET]
OPTION = re.compile(r"^ *\*? +(--[a-z-]+)(?: (--[a-z-]+))?(?: ([A-Z,]+))?", re.MULTILINE)
ARGUMENT = re.compile(r"^ (?:\*  | *)([A-Z][A-Z-]+)  ", re.MULTILINE)

NUMBERS = "0 1 2 3 -1 07 1.5 1e3 nan inf 99999999999999999999 ٣ 1,1 0-2 2-0 0-99999 , x".split(" ")
TEXTS = ["", " ", "tie", "expert", "random", "x" * 5000, "a\nb", "\x1b[2J", "é", "../x", "--nx"]
TEXTS += ["os:system", "json:loads", "none", "nx = 1", "nx / 0 > 1", "1/3", "train=0.5,test=0.5"]
TEXTS += ["knotgym/a/b-v0", "a-v0", "minari", "huggingface", "compact", "ogbench", "curves"]
SETTINGS = "task.horizon=5 task.nx=99 policy.noise=2 run.shard=4/3 task.views=x a=b".split()
SETTINGS += ["task.image_size=1000000", "x", "=", "task=3", "task.horizon=1e9"]
FILES = "missing empty noise link pipe folder states.h5 cut.h5 episodes.h5 minari curve.csv".split()
FILES += ["table.json", "deep/er/out", "set", "set/states.h5", "x" * 300, ".", "..", ""]
# more than a few would be honest work for hours; at most one in ten commands asks for it
WORK = "--count --episodes --ropes --steps --size".split()


def grammar() -> dict[str, list[tuple[str, str]]]:
    """Return the options of each command, (what is typed, kind), and its arguments, ("", kind)."""
    found = {}
    for name in NAMES:
        text = io.StringIO()
        console = Console(file=text, width=400, force_terminal=False)
        words = [*name.split(), "--help"]
        application()(words, console=console, result_action="return_value")
        lines = (line.strip("╭╮╰╯│─") for line in text.getvalue().splitlines())
        shown = "\n".join(lines).partition("Examples:")[0]
        options = [(one, kind) for one, _, kind in OPTION.findall(shown) if one != "--help"]
        found[name] = [*options, *(("", kind) for kind in ARGUMENT.findall(shown))]
    return found


def words_of(rng: np.random.Generator, name: str, parts: list[tuple[str, str]]) -> list[str]:
    """Draw the words of a command."""

    def drawn(some: list[str]) -> str:
        return some[rng.integers(len(some))]

    words = name.split()
    for typed, kind in parts:
        if not typed and rng.random() < 0.9:
            several = name in ("dataset merge", "dataset import")
            words += [drawn(FILES) for _ in range(int(rng.integers(1, 4)) if several else 1)]
        elif typed and rng.random() < 0.3:
            words.append(typed)
            if kind in ("N", "N,N", "X", "INT", "FLOAT") and rng.random() < 0.9:
                words.append(drawn(NUMBERS))
            elif kind == "PATH" and rng.random() < 0.9:
                words.append(drawn(FILES))
            elif typed == "--set":
                words.append(drawn(SETTINGS))
            elif kind:
                words.append(drawn([*TEXTS, *FILES, *NUMBERS]))
    if rng.random() < 0.05:
        words.insert(int(rng.integers(1, len(words) + 1)), drawn([*TEXTS, *FILES]))
    listed = {typed for typed, _ in parts}
    small = [one for one in WORK if one in listed and (one not in words or rng.random() < 0.9)]
    words += [word for one in small for word in (one, "1")]
    if "--workers" in listed and "--workers" not in words:
        words += ["--workers", "1"]
    if "--model" in listed:  # no server listens there
        words += ["--base-url", "http://127.0.0.1:9/v1"]
    return words


def sandbox(folder: Path) -> None:
    """Fill a folder with datasets and what isn't one."""
    quiet = ["--quiet", "--workers", "1", "--engine", "chain"]
    kept = Path.cwd()
    os.chdir(folder)
    for words in (
        ["generate", "--nx", "0,1", "--count", "4", "--out", "set", *quiet],
        ["collect", "--task", "unknot", "--nx", "1", "--policy", "random", "--episodes", "3"]
        + ["--set", "task.horizon=4", "--out", "minari", "--id", "knotgym/a/b-v0", *quiet],
    ):
        assert played(words, 600).status == 0, words
    shutil.copy("set/states.h5", "states.h5")
    shutil.copy(next(Path("minari").rglob("episodes.h5")), "episodes.h5")
    Path("cut.h5").write_bytes(Path("states.h5").read_bytes()[:5000])
    Path("empty").touch()
    Path("noise").write_bytes(np.random.default_rng(0).bytes(5000))
    Path("curve.csv").write_text("x,y,z\n0,0,0\n1,0,0\n1,1,0\n0,1,0\n")
    Path("table.json").write_text('{"a": [1, {"b": null}]}')
    Path("folder").mkdir()
    Path("folder", "mine.txt").write_text("mine")
    Path("link").symlink_to("folder/mine.txt")
    os.mkfifo("pipe")
    os.chdir(kept)


def listing(folder: Path) -> Mapping[str, tuple[int, int]]:
    """Return the size and time of change of everything in a folder."""
    paths = [path for path in folder.rglob("*") if not path.is_dir()]
    stats = {str(path.relative_to(folder)): path.lstat() for path in paths}
    return {
        name: (stat.st_size, stat.st_mtime_ns)
        for name, stat in stats.items()
        if "__pycache__" not in name
    }


def faults_of(outcome: Outcome, memory: float, changed: list[str]) -> list[str]:
    """List what a command did that none should."""
    found = []
    if "Traceback" in outcome.said or outcome.status == 99:
        found.append("traceback")
    if outcome.status not in (0, 1, 2, 130):
        found.append(f"status {outcome.status}")
    if outcome.status in (1, 2) and not outcome.said.strip() and not outcome.printed.strip():
        found.append("no word")
    if outcome.status == 2 and outcome.said.count("\n") != 1:
        found.append("not one line")
    if outcome.status == 2 and changed:
        found.append(f"wrote {changed[:3]}")
    if outcome.megabytes > memory:
        found.append(f"{outcome.megabytes:.0f} MB")
    return found


def fresh(made: Path, room: Path) -> None:
    """Make a room a copy of the sandbox."""
    shutil.rmtree(room, ignore_errors=True)
    shutil.copytree(made, room, symlinks=True, copy_function=copied)


def copied(source: str, target: str) -> None:
    """Copy a file with its times; a new pipe is made for a pipe."""
    if Path(source).is_fifo():
        os.mkfifo(target)
    else:
        shutil.copy2(source, target, follow_symlinks=False)


def run(commands: range, seed: int, limit: float, memory: float, out: Path) -> Counter[str]:
    """Run commands; return how many ended how."""
    told: Counter[str] = Counter()
    parts: dict[str, list[tuple[str, str]]] = grammar()
    with tempfile.TemporaryDirectory() as name, out.open("a", encoding="utf-8") as lines:
        made, room = Path(name, "made"), Path(name, "room")
        made.mkdir()
        os.environ["MINARI_DATASETS_PATH"] = str(room / "minari")
        sandbox(made)
        fresh(made, room)
        os.chdir(room)
        before = listing(room)
        for number in commands:
            rng = np.random.default_rng([seed, number])
            chosen = NAMES[rng.integers(len(NAMES))]
            words = words_of(rng, chosen, parts[chosen])
            outcome = played(words, limit)
            now = listing(room)
            changed = [path for path in {*before, *now} if before.get(path) != now.get(path)]
            found = faults_of(outcome, memory, changed)
            told[f"status {outcome.status}"] += 1
            told.update(fault.split(" ")[0] for fault in found)
            if found or outcome.seconds > limit:
                line = {"number": number, "words": words, "faults": found, **outcome._asdict()}
                line["printed"] = outcome.printed[-300:]
                lines.write(json.dumps(line) + "\n")
                lines.flush()
            if changed:
                os.chdir("/")
                fresh(made, room)
                os.chdir(room)
                before = listing(room)
        os.chdir("/")
    return told


def entry() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    kinds: list[tuple[str, Callable[[str], object], object]] = [
        ("commands", int, 1500),
        ("first", int, 0),
        ("seed", int, 0),
        ("seconds", float, 30.0),
        ("memory", float, 1024.0),
        ("out", Path, Path("fuzz.jsonl")),
    ]
    for name, kind, default in kinds:
        parser.add_argument(f"--{name}", type=kind, default=default)
    given = parser.parse_args()
    commands = range(given.first, given.first + given.commands)
    told = run(commands, given.seed, given.seconds, given.memory, given.out.resolve())
    print(json.dumps(dict(sorted(told.items()))))


if __name__ == "__main__":
    entry()
