"""What becomes of damaged files: mutated copies of a file of each kind, each verified.

    python benchmarks/mutations.py --count 2000 --states A/states.h5 --episodes B/main_data.hdf5
    python benchmarks/mutations.py --count 2000 --pictures C/data/train-00000-of-00001.parquet
    python benchmarks/mutations.py --count 2000 --manifests A/manifest.json --policies D/policy.json

The copies are read in a process that has everything imported and is replaced when it crashes or
hangs. Outcomes: "refused", one line of a `KnotgymError`; "found", a fault of `verify`; "unchanged",
all that a reader gets is what the sound file gives; "wrong", something else was read and no fault
named; "harmful", the HDF5 library crashes or hangs and `verify` lives to say so; "traceback",
"crash" and "hang", the command's own. The table goes to standard output, the counts to --out, from
which a run that was ended goes on: as many copies of the same file aren't read again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from damaged_files import DAMAGES, copied
from file_readers import TOLD

from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidFile, KnotgymError
from knotgym.datasets.foreign_file import try_files

LIMIT = 60.0  # seconds for a file
READ_BY_ONE = 200  # files, then another process reads
BAD = ("traceback", "crash", "hang", "wrong")


def judged(kind: str, path: Path, right: dict[str, str]) -> str:
    """What becomes of a file, read by this process."""
    try:
        faults, given = TOLD[kind](path)
        other = sorted(n for n in {*given, *right} if given.get(n) != right.get(n))
        wrong = f"wrong: {', '.join(other)}"
        return "found" if faults else wrong if other else "unchanged"
    except KnotgymError as error:
        clear = str(error).isprintable()
        return "refused" if clear else f"traceback: control characters in {error!r}"
    except BaseException as error:  # whatever it is, it is the outcome
        return f"traceback: {type(error).__name__}: {error}"


def _judge(kind: str, right: dict[str, str], pipe: Any, other: Any) -> None:
    other.close()  # so that this process ends with the one that asks it
    warnings.simplefilter("error", RuntimeWarning)  # more than one line
    for path in iter(pipe.recv, None):
        pipe.send((judged(kind, path, right), time.process_time()))


def _as_commands_say(path: Path) -> str:
    """ "harmful" where `verify`, which tries files first, would say so in a line."""
    try:
        try_files([path])
    except InvalidFile:
        return "harmful"
    return ""


class Readers:
    """Processes that read files of a kind, one at a time and each in place of a lost one.

    Attributes:
        cpu: seconds that those before the one now took.
    """

    def __init__(self, kind: str, right: dict[str, str], limit: float = LIMIT) -> None:
        self.cpu = 0.0
        self._given, self._limit = (kind, right), limit
        self._begin()

    def _begin(self) -> None:
        forked = multiprocessing.get_context("fork")
        self._pipe, pipe = forked.Pipe()
        self._child = forked.Process(target=_judge, args=(*self._given, pipe, self._pipe))
        self._child.start()
        pipe.close()
        self._left, self._taken = READ_BY_ONE, 0.0

    def outcome(self, path: Path) -> str:
        """What becomes of a file; also a crash, or a hang, unless it is none at a second look:
        processes are stopped where others measure.
        """
        said = self._outcome(path)
        return self._outcome(path) if said == "hang" else said

    def _outcome(self, path: Path) -> str:
        said = "hang"
        try:
            self._pipe.send(path)
            if self._pipe.poll(self._limit):
                said, self._taken = self._pipe.recv()
        except (EOFError, OSError):
            said = "crash"
        self._left -= 1
        if said in ("hang", "crash") or not self._left:
            self.close()
            self._begin()
        return _as_commands_say(path) or said if said in ("hang", "crash") else said

    def close(self) -> None:
        """End the process."""
        self._child.kill()
        self._child.join()
        self.cpu += self._taken


def run(
    kind: str,
    source: Path,
    count: int,
    seed: int = 0,
    done: dict[str, Any] | None = None,
    save: Callable[[dict[str, Any]], object] = lambda _: None,
) -> dict[str, Any]:
    """Mutate a file and read the copies, the classes of damage in turn.

    Args:
        kind, source: what is mutated.
        count, seed: of the copies.
        done: what an earlier run of the same file and seed returned; goes on from there.
        save: told how far it is, after every READ_BY_ONE copies.

    Returns:
        Outcomes of each class, each bad one with its number, and CPU seconds; JSON.
    """
    asked = {"sha256": sha256(source), "bytes": source.stat().st_size, "seed": seed}
    before = done or {"count": 0, "classes": {}, "bad": [], "cpu_seconds": 0.0}
    counts = {one.__name__: Counter(before["classes"].get(one.__name__)) for one in DAMAGES[kind]}
    bad: list[str] = [*before["bad"]]
    began = time.process_time()
    right = TOLD[kind](source)[1]
    readers = Readers(kind, right)

    def told(number: int) -> dict[str, Any]:
        spent = before["cpu_seconds"] + readers.cpu + time.process_time() - began
        found = {"count": number, "classes": counts, "bad": bad, "cpu_seconds": round(spent, 1)}
        return {**asked, **found}

    with tempfile.TemporaryDirectory() as folder:
        for number in range(before["count"], count):
            damage = DAMAGES[kind][number % len(DAMAGES[kind])]
            copy = copied(kind, source, Path(folder))
            damage(copy, np.random.default_rng([seed, number]))
            said = readers.outcome(copy)
            counts[damage.__name__][said.split(":")[0]] += 1
            if said.split(":")[0] in BAD:
                bad.append(f"{kind} {damage.__name__} {number}: {said}")
            if (number + 1) % READ_BY_ONE == 0:
                save(told(number + 1))
    readers.close()
    return told(count)


def table(report: dict[str, Any]) -> str:
    """The outcomes of every kind and class."""
    rows = {
        f"{kind}, {name}": row
        for kind, one in report.items()
        for name, row in one["classes"].items()
    }
    outcomes = sorted({name for row in rows.values() for name in row} | {*BAD})
    lines = [("class", *outcomes), ("---", *("---:" for _ in outcomes))]
    lines += [(name, *(str(row.get(one, 0)) for one in outcomes)) for name, row in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def summary(report: dict[str, Any]) -> str:
    """The outcomes of every kind, as docs/formats/index.md has them."""
    outcomes = ("refused", "found", "unchanged", "harmful", *(BAD[3:] + BAD[:3]))
    lines = [("kind", "copies", "bytes", *outcomes, "CPU s"), ("---", *["---:"] * 11)]
    for kind, one in report.items():
        counts: Counter[str] = sum((Counter(row) for row in one["classes"].values()), Counter())
        sizes = (str(one["count"]), str(one["bytes"]))
        seconds = f"{one['cpu_seconds']:.0f}"
        named = kind.replace("_", " ")
        lines.append((named, *sizes, *(str(counts[name]) for name in outcomes), seconds))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=400, help="copies of each file")
    parser.add_argument("--seed", type=int, default=0)
    for kind in TOLD:
        parser.add_argument(f"--{kind}", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    report: dict[str, Any] = {}
    if given.out and given.out.is_file():
        report = json.loads(given.out.read_text(encoding="utf-8"))
    for kind in TOLD:
        source: Path | None = getattr(given, kind)
        if source is None:
            continue
        asked = {"sha256": sha256(source), "seed": given.seed}
        done = report.get(kind, {})
        done = done if asked.items() <= done.items() else {}
        if done.get("count", 0) >= given.count:
            continue

        def save(found: dict[str, Any], kind: str = kind) -> None:
            report[kind] = found
            if given.out:
                given.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")

        save(run(kind, source, given.count, given.seed, done, save))
        print(*report[kind]["bad"], sep="\n", flush=True)
    print(table(report), summary(report), sep="\n\n")


if __name__ == "__main__":
    main()
