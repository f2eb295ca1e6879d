"""Processes that begin the same command at the same moment, with one output.

    python benchmarks/together.py --rounds 50 --out together.json

A round is 2 to 8 processes of one kind of `commands.py`, which wait for the same moment. One must
end with 0 and leave the right bytes, whole; the others end with 2 and say in one line why, or with
0 if they came when it was done. Rounds that --out already tells aren't run again.
"""

from __future__ import annotations

import json
import os
import shutil
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from pathlib import Path

import numpy as np
from commands import KINDS, Fork, command, made, sources, warm


def outputs(room: Path) -> dict[str, str]:
    """Return what lies in a room for good."""
    return {path: digest for path, digest in made(room).items() if ".journal/" not in path}


def begin(words: list[str], several: int) -> tuple[Counter[str], list[str]]:
    """Start processes at once; return how they ended, and what was wrong with that."""
    gate, key = os.pipe()
    forks = [Fork(lambda: command(words), (gate, key)) for _ in range(several)]
    os.close(key)
    ends = [fork.outcome() for fork in forks]
    os.close(gate)
    faults = [
        f"status {end.status}: {end.said[-400:]}"
        for end in ends
        if end.status not in (0, 2)
        or "Traceback" in end.said
        or (end.status == 2 and end.said.count("knotgym: ") != 1)
    ]
    counts = Counter(f"status {end.status}" for end in ends)
    return counts, faults + ["none ended with 0"] * (not counts["status 0"])


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=50, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("together.json"))
    given = parser.parse_args()
    told = json.loads(given.out.read_text()) if given.out.is_file() else {}
    with sources(0) as (folder, typed, _):
        right: dict[str, dict[str, str]] = {}
        for number in range(given.rounds):
            for kind in given.kinds:  # round by round, so that every kind has some when time is up
                own = told.setdefault(kind, {"rounds": 0, "counts": {}, "faults": []})
                if own["rounds"] > number:
                    continue
                more, room = ["--workers", "1"] * KINDS[kind].has_workers, folder / kind
                if kind not in right:
                    room.mkdir()
                    warm([*typed(kind, 0, room / "a"), *more])
                    right[kind] = outputs(room)
                    shutil.rmtree(room)
                room.mkdir()
                several = int(np.random.default_rng(number).integers(2, 9))
                counts, faults = begin([*typed(kind, 0, room / "a"), *more], several)
                if outputs(room) != right[kind]:
                    faults.append(f"other bytes, {dict(counts)}")
                own["counts"] = Counter(own["counts"]) + counts
                own["faults"] += [f"round {number}: {fault}" for fault in faults]
                own["rounds"] = number + 1
                shutil.rmtree(room)
            given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        for kind, own in told.items():
            print(kind, own, flush=True)


if __name__ == "__main__":
    main()
