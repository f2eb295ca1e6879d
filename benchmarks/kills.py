"""Commands that are killed again and again: whether what they leave and end with is right.

    python benchmarks/kills.py --kills 276 --out kills.json

A small run of each kind is made once without a break. Then the same is begun, killed at a random
moment (SIGKILL) of the time that took, or every second time of that in which it writes, and begun
again, with --resume where the command has it, until it was killed so often; one that is done before
its kill is begun again elsewhere, every second time over an older output, with --overwrite. After a
kill each output is absent, the older one or the right one, whole; sources never change; a finished
run has the right bytes. With --ways recipes are also run by 2 and 7 workers, and as three shards
that are merged. Kinds that --out already tells aren't run again.

`play` pulls as a browser's tab does: every pull that was noted must be in its one episode.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from commands import ID, KINDS, PLAYED, Fork, command, made, sources, warm

from knotgym.datasets import open_episodes
from knotgym.play import Session


def units(files: dict[str, str], depth: int) -> dict[tuple[str, ...], set[tuple[str, str]]]:
    """Files by what gets its name at once."""
    found: dict[tuple[str, ...], set[tuple[str, str]]] = {}
    for file in files.items():
        found.setdefault(Path(file[0]).parts[:depth], set()).add(file)
    return found


class Run(NamedTuple):
    """A run: what it left in its room, whether it was killed, its seconds, those since it wrote."""

    files: dict[str, str]
    killed: bool
    took: float
    wrote: float


def run(words: list[str], room: Path, wait: float = 3600, writes: bool = False) -> Run:
    """Run a command and kill it after so long, or so long after it wrote something in a room.

    Raises:
        RuntimeError: it failed.
    """
    before, fork, first = [*os.walk(room)], Fork(lambda: command(words)), 0.0
    while not fork.has_ended():
        time.sleep(0.001)
        if not first and [*os.walk(room)] != before:
            first = fork.seconds
        if (not writes or first) and fork.seconds > wait + (first if writes else 0.0):
            os.kill(fork.id, signal.SIGKILL)
            break
    ended, end = fork.seconds, fork.outcome()
    if end.status not in (0, -signal.SIGKILL):
        raise RuntimeError(f"{' '.join(words)}: status {end.status}: {end.said}")
    return Run(made(room), end.status != 0, ended, ended - (first or 0.0))


def run_kind(name: str, kills: int, typed: Callable[..., list[str]], rooms: Path) -> dict[str, Any]:
    """Kill a kind so many times; what went wrong, none if nothing did."""
    kind, rng = KINDS[name], np.random.default_rng(len(name))
    one = ["--workers", "1"] * kind.has_workers
    resume = ["--resume"] * (kind.has_workers or name == "prompt")
    given = made(rooms.parent / "sources")
    for part in ("old", "right", "warm"):
        (rooms / part).mkdir(parents=True)
    warm([*typed(name, 0, rooms / "warm/a"), *one])
    old = run([*typed(name, 1, rooms / "old/a"), *one], rooms / "old")
    right = run([*typed(name, 0, rooms / "right/a"), *one], rooms / "right")
    outputs = [units(whole.files, kind.depth) for whole in (old, right)]
    killed, finished, since, faults = 0, 0, 0, list[str]()
    while killed < kills or since:
        room, replaces = rooms / str(finished), finished % 2 == 1
        if not since:
            shutil.copytree(rooms / "old", room) if replaces else room.mkdir()
        words = [*typed(name, 0, room / "a"), *one, *resume, *["--overwrite"] * replaces]
        writes, most = killed % 2 == 1, right.wrote if killed % 2 else right.took
        broken = run(words, room, rng.uniform(0, most) if killed < kills else 3600, writes)
        if broken.killed:
            killed, since = killed + 1, since + 1
            there = units(broken.files, kind.depth)
            wrong = [u for u in there if there[u] not in [own.get(u) for own in outputs]]
            wrong += [u for u in outputs[0] if replaces and u not in there]
            faults += [f"kill {killed}: half or nothing of {'/'.join(unit)}" for unit in wrong]
            if not wrong and (resume or broken.files != right.files):
                continue
        elif broken.files != right.files:
            faults.append(f"after {since} kills: other bytes")
        finished, since = finished + 1, 0
    if made(rooms.parent / "sources") != given:
        faults.append("a source was changed")
    left = Counter(path.name.split("-")[0] for path in rooms.rglob(".*"))
    told = {"kills": killed, "finished": finished, "hidden": dict(left)}
    return {**told, "took": round(right.took, 2), "faults": faults}


def run_ways(name: str, typed: Callable[..., list[str]], rooms: Path) -> list[str]:
    """Run a kind by several workers and in shards; what went wrong."""
    kind, faults, one = KINDS[name], list[str](), ["--workers", "1"]
    right = made(rooms / "right")
    ways = [[["--workers", count]] for count in ("2", "7") if kind.has_workers]
    shards = [[*one, "--resume", "--set", f"run.shard={number}/3"] for number in (2, 1, 3)]
    ways += [[*4 * shards, one]] * kind.has_shards  # four times: what needs the others' results
    for number, way in enumerate(ways):
        room = rooms / f"way{number}"
        room.mkdir()
        for more in way:  # a fork can't have workers of its own
            words = [sys.executable, "-m", "knotgym", *typed(name, 0, room / "a"), *more]
            subprocess.run(words, check=True, capture_output=True)
        found = {file: own for file, own in made(room).items() if ".journal/" not in file}
        faults += [f"{way[0]}: other bytes"] * (found != right)
    return faults


def run_play(kills: int, room: Path) -> dict[str, Any]:
    """Kill a recording so many times; what of it is lost or doubled."""
    rng, killed, faults = np.random.default_rng(0), 0, list[str]()
    room.mkdir()
    while killed < kills:
        words = ["record", str(room), "100000"]
        killed += run(words, room, rng.uniform(0, 2), writes=True).killed
        if (room / ID).exists():
            open_episodes(room / ID)
    run(["record", str(room), "0"], room)  # stores what the last one left
    own = open_episodes(room / ID).episodes
    seeds, force = own.episodes["seed"], own.steps["force"]
    noted = dict(line.split() for line in (room / ".noted").read_text().splitlines())
    for number, pulls in noted.items():
        rows = np.flatnonzero(seeds == Session(PLAYED, 4, int(number)).batch.seed[0])
        steps = np.isin(own.episode_of(), rows)
        more = np.any(force[steps] != 0, axis=1).sum() - int(pulls)  # one may not be logged yet
        if len(rows) != 1 or more not in (0, 1):
            faults.append(f"episode {number} is there {len(rows)} times; {pulls} pulls were noted")
    return {"kills": killed, "finished": len(seeds), "faults": faults}


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=276, help="over all kinds")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--ways", action="store_true", help="workers and shards, too")
    parser.add_argument("--out", type=Path, default=Path("kills.json"))
    given = parser.parse_args()
    told = json.loads(given.out.read_text()) if given.out.is_file() else {}
    kills = math.ceil(given.kills / len(given.kinds))
    with sources(0, 1) as (folder, typed, server):
        for kind in given.kinds:
            if kind in told:
                continue
            asked = len(server.requests)
            if kind == "play":
                told[kind] = run_play(kills, folder / kind)
            else:
                told[kind] = run_kind(kind, kills, typed, folder / kind)
            if given.ways and kind != "play":
                told[kind]["faults"] += run_ways(kind, typed, folder / kind)
            if kind == "prompt":
                told[kind]["asked"] = len(server.requests) - asked
            print(kind, told[kind], flush=True)
            given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
