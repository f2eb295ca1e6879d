"""Runs that are killed again and again: whether what they leave and what they end with is right.

    python benchmarks/kills.py --kills 20 --kinds generate collect evaluate images --out kills.json

A small run of each kind is made once without a break. Then the same is begun, killed at a random
moment of the time that took (SIGKILL, its workers die with it), and gone on with by --resume, until
it was killed --kills times; a run that is done before its kill is begun anew elsewhere. After every
kill nothing may stand under the final name, and every finished run must have the bytes of the one
without a break. Kinds that --out already tells aren't run again.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.atomic_files import sha256

ID = "knotgym/unknot-nx1/random-v0"
TASK = ("--task", "unknot", "--nx", "1", "--engine", "chain")
EPISODES = ("--policy", "random", "--set", "task.horizon=6", "--episodes", "200")
KINDS: dict[str, tuple[str, ...]] = {
    "generate": ("generate", "--nx", "0,1", "--count", "4", "--engine", "chain"),
    "collect": ("collect", *TASK, *EPISODES, "--observation", "state", "--id", ID),
    "evaluate": ("evaluate", *TASK, *EPISODES),
    "images": ("images", "--nx", "0,1", "--count", "12", "--engine", "chain"),
}


def typed(kind: str, room: Path, workers: int, *more: str) -> list[str]:
    """The command of a kind that writes below a room."""
    words = [*KINDS[kind], "--workers", str(workers), "--quiet", "--out", str(room / "a"), *more]
    return [sys.executable, "-m", "knotgym", *words]


def final(kind: str, room: Path) -> Path:
    """The folder or file that a kind makes in a room."""
    return room / "a" / ID if kind == "collect" else room / "a"


def made(folder: Path) -> dict[str, str]:
    """SHA-256 of every file."""
    files = [folder] if folder.is_file() else sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): sha256(path) for path in files if path.is_file()}


def break_off(words: list[str], seconds: float) -> bool:
    """Run a command and kill it after so long; whether it lived until then.

    Raises:
        RuntimeError: it failed.
    """
    run = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        said = run.communicate(timeout=seconds)[1]
    except subprocess.TimeoutExpired:
        os.kill(run.pid, signal.SIGKILL)
        run.communicate()
        return True
    if run.returncode:
        raise RuntimeError(said.decode())
    return False


def run_kind(kind: str, kills: int, workers: int, seed: int) -> dict[str, Any]:
    """Kill a kind so many times; what went wrong, none if nothing did."""
    rng, faults = np.random.default_rng(seed), []
    with tempfile.TemporaryDirectory() as name:
        rooms = Path(name)
        began = time.perf_counter()
        (rooms / "whole").mkdir()
        break_off(typed(kind, rooms / "whole", workers), 3600)
        took = time.perf_counter() - began
        right = made(final(kind, rooms / "whole"))
        killed, rounds, finished, resumes = 0, 0, 0, 0
        room = rooms / "0"
        room.mkdir()
        while killed < kills or resumes:
            moment = float(rng.uniform(0, took)) if killed < kills else 3600
            if break_off(typed(kind, room, workers, "--resume"), moment):
                killed += 1
                resumes += 1
                there = final(kind, room).exists()
                if there and made(final(kind, room)) != right:
                    faults.append(f"kill {killed}: half of it stands under the final name")
                continue
            if made(final(kind, room)) != right:
                faults.append(f"after {resumes} kills: other bytes")
            finished, resumes, rounds = finished + 1, 0, rounds + 1
            room = rooms / str(rounds)
            room.mkdir()
    return {"kills": killed, "finished": finished, "took": round(took, 1), "faults": faults}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("kills.json"))
    given = parser.parse_args()
    told: dict[str, Any] = {}
    if given.out.is_file():
        told = json.loads(given.out.read_text(encoding="utf-8"))
    for kind in given.kinds:
        if told.get(kind, {}).get("kills", 0) >= given.kills:
            continue
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        told[kind] = run_kind(kind, given.kills, given.workers, given.seed)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        told[kind]["cpu_seconds"] = round(spent, 1)
        print(kind, told[kind], flush=True)
        given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
