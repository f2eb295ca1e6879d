"""Processes that begin the same command at the same moment, with one output.

    python benchmarks/together.py --rounds 50 --out together.json

Each round starts 2 to 8 processes of a command, by the kinds of `kills.py`. One must end with 0
and leave the right bytes, whole; the others end with 2 and say in one line why, or do nothing
more. Kinds that --out already tells aren't run again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from kills import KINDS, SOURCES, made, typed

from knotgym.states import read_states

NAMES = [name for name in KINDS if name not in ("play", "prompt", "reader", "clone")]


def rounds_of(name: str, rounds: int, sources: Path, room: Path) -> dict[str, Any]:
    """Start processes at once, so many times; return how they ended, and what went wrong."""
    kind, rng = KINDS[name], np.random.default_rng(0)
    counts, faults, right = Counter[str](), list[str](), dict[str, str]()
    for number in range(-1, rounds):  # the first round is of one process
        own = room / str(number)
        own.mkdir()
        words = typed(kind.words, o=own / "a", s=sources / "0", n=0, url="")
        words += ["--workers", "1"] * kind.has_workers
        several = int(rng.integers(2, 9)) if number >= 0 else 1
        pipe = subprocess.PIPE
        children = [subprocess.Popen(words, stderr=pipe, stdout=pipe) for _ in range(several)]
        said = [child.communicate()[1].decode() for child in children]
        ends = [child.returncode for child in children]
        counts.update(f"status {end}" for end in ends)
        files = {path: digest for path, digest in made(own).items() if ".journal/" not in path}
        right = right or files
        for end, text in zip(ends, said, strict=True):
            if end not in (0, 2) or "Traceback" in text:
                faults.append(f"round {number}: status {end}: {text[-400:]}")
        if ends.count(0) < 1 or files != right:
            faults.append(f"round {number}: {ends}, {'other' if files != right else 'right'} bytes")
    return {"rounds": rounds, **counts, "faults": faults}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=50, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--out", type=Path, default=Path("together.json"))
    given = parser.parse_args()
    told = json.loads(given.out.read_text()) if given.out.is_file() else {}
    with tempfile.TemporaryDirectory() as name:
        sources = Path(name) / "sources"
        for number, words in product("0", SOURCES[:3]):
            subprocess.run(typed(words, n=number, o=sources / number), check=True)
        np.savez(sources / "0/curves.npz", *read_states(sources / "0/set/states.h5").points)
        for kind in given.kinds:
            if kind not in told:
                (Path(name) / kind).mkdir()
                told[kind] = rounds_of(kind, given.rounds, sources, Path(name) / kind)
                print(kind, told[kind], flush=True)
                given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
