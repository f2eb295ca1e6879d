"""Commands that are killed again and again: whether what they leave and end with is right.

    python benchmarks/kills.py --kills 250 --out kills.json

A small run of each kind is made once without a break. Then the same is begun, killed at a random
moment (SIGKILL) of the time that took, or every second time of that in which it writes, and begun
again, with --resume where the command has it, until it was killed so often; one that is done before
its kill is begun again elsewhere, every second time over an older output, with --overwrite. After a
kill each output is absent, the older one or the right one, whole; sources never change; a finished
run has the right bytes. Recipes are also run by 2 and 7 workers, and as three shards that are
merged. Kinds that --out already tells aren't run again.

`play` pulls as a browser's tab does: every pull that was noted must be in its one episode.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knotgym.common import sha256
from knotgym.datasets import open_episodes
from knotgym.envs import TaskConfig
from knotgym.play import Recorder, Session
from knotgym.states import read_states

sys.path.append(str(Path(__file__).parents[1]))
from tests.prompting.chat_server import ChatServer  # noqa: E402

ID, OTHER = "knotgym/unknot-nx1/one-v0", "knotgym/unknot-nx1/two-v0"
TASK = "--task unknot --nx 1 --engine chain --policy random --set task.horizon=6"
KNOT = "--nx 0,1 --count 4 --engine chain"
READER = "--task tie --nx 2 --engine chain --policy expert --episodes 3 --observation state"


class Kind(NamedTuple):
    """A command: its words, with the sources {s}, of one of two seeds {n}, and the output {o}."""

    words: str
    has_workers: bool = False  # and is resumed
    has_shards: bool = False
    depth: int = 0  # parts of a path that name what appears at once; 0: all appears at once


KINDS = {
    "generate": Kind(f"generate {KNOT} --seed {{n}} --out {{o}}", True, True),
    "collect": Kind(f"collect {TASK} --episodes 200 --observation state --id {ID} --seed {{n}}"
                    " --out {o}", True, True),
    "evaluate": Kind(f"evaluate {TASK} --episodes 200 --seed {{n}} --out {{o}}.json", True, True),
    "images": Kind("images --nx 0,1 --count 8 --engine chain --seed {n} --out {o}", True, True),
    "suite": Kind("suite --task unknot --nx 2 --split train --states readable --policy random,noisy"
                  " --episodes random=2,noisy=1{n} --seed 1 --out {o}", True, False, 4),
    "reader": Kind("train --data {s}/sets/knotgym/tie-nx2/three-v0 --steps 6 --set batch=2"
                   " --set save_every=2 --seed {n} --out {o}", True),
    "clone": Kind("train --learner clone --steps 6 --set clone.demonstrations=3 --seed {n}"
                  " --set clone.save_every=2 --set clone.batch=4 --out {o}", True),
    "prompt": Kind("prompt --task unknot --nx 1 --episodes 2 --set task.horizon=4 --seed {n}"
                   " --set task.image_size=32 --model m --base-url {url} --out {o}"),
    "play": Kind(""),
    "select": Kind(f"dataset select {{s}}/sets/{ID} --sample 4 --out {{o}}.h5"),
    "split": Kind("dataset split {s}/set --parts train=0.5,test=0.5 --out {o}.h5"),
    "merge": Kind(f"dataset merge {{s}}/sets/{ID} {{s}}/sets/{OTHER} --out {{o}}"
                  " --id knotgym/x-v0"),
    "delete": Kind("dataset delete {s}/set --rows 0 --out {o}.h5"),
    "import": Kind("dataset import {s}/curves.npz --out {o}.h5"),
    "compact": Kind("dataset export {s}/set --to compact --out {o}"),
    "recording": Kind(f"dataset export {{s}}/sets/{ID} --to recording --out {{o}}.h5"),
    "ogbench": Kind(f"dataset export {{s}}/sets/{ID} --to ogbench --out {{o}}"),
    "huggingface": Kind("dataset export {s}/set --to huggingface --out {o}"),
    "minari": Kind(f"dataset export {{s}}/sets/{ID} --to minari --out {{o}}"),
    "gallery": Kind("dataset gallery {s}/set --out {o}.png"),
    "page": Kind("dataset page {s}/set --out {o}.html"),
    "replay": Kind(f"dataset replay {{s}}/sets/{ID} --out {{o}}.gif"),
    "demo": Kind("demo --out {o}"),
}  # fmt: skip
PLAYED = TaskConfig(task="tie", nx=2, horizon=6, engine="chain")
SOURCES = (
    f"generate {KNOT} --seed {{n}} --out {{o}}/set",
    f"collect {TASK} --episodes 6 --observation state --seed {{n}} --id {ID} --out {{o}}/sets",
    f"collect {TASK} --episodes 6 --observation state --seed 3{{n}} --id {OTHER} --out {{o}}/sets",
    f"collect {READER} --seed {{n}} --id knotgym/tie-nx2/three-v0 --out {{o}}/sets",
)


def typed(words: str, **places: Any) -> list[str]:
    """A command line."""
    return [sys.executable, "-m", "knotgym", *words.format(**places).split()]


def made(folder: Path) -> dict[str, str]:
    """SHA-256 of every file that isn't hidden."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: sha256(path) for name, path in files.items() if "/." not in f"/{name}"}


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
    before, began, first = [*os.walk(room)], time.perf_counter(), 0.0
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(words, stdout=said, stderr=said)
        while child.poll() is None:
            time.sleep(0.003)
            now = time.perf_counter()
            if not first and [*os.walk(room)] != before:
                first = now
            if (not writes or first) and now > wait + (first if writes else began):
                os.kill(child.pid, signal.SIGKILL)
                break
        if child.wait() not in (0, -signal.SIGKILL):
            said.seek(0)
            raise RuntimeError(f"{' '.join(words)}: {said.read().decode()}")
    ended = time.perf_counter()
    return Run(made(room), child.returncode != 0, ended - began, ended - (first or began))


def run_kind(name: str, kills: int, sources: Path, rooms: Path, url: str) -> dict[str, Any]:
    """Kill a kind so many times; what went wrong, none if nothing did."""
    kind, rng = KINDS[name], np.random.default_rng(len(name))
    one = ["--workers", "1"] * kind.has_workers
    resume = ["--resume"] * (kind.has_workers or name == "prompt")

    def command(room: Path, number: int, *more: str) -> list[str]:
        places = {"o": room / "a", "s": sources / str(number), "n": number, "url": url}
        return [*typed(kind.words, **places), *more]

    given = made(sources)
    (rooms / "old").mkdir()
    (rooms / "right").mkdir()
    old = run(command(rooms / "old", 1, *one), rooms / "old")
    right = run(command(rooms / "right", 0, *one), rooms / "right")
    outputs = [units(whole.files, kind.depth) for whole in (old, right)]
    killed, finished, since, faults = 0, 0, 0, list[str]()
    while killed < kills or since:
        room, replaces = rooms / str(finished), finished % 2 == 1
        if not since:
            subprocess.run(["cp", "-r", rooms / "old", room] if replaces else ["mkdir", room])
        words = command(room, 0, *one, *resume, *["--overwrite"] * replaces)
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
    if made(sources) != given:
        faults.append("a source was changed")
    ways = [[["--workers", count]] for count in ("2", "7") if kind.has_workers]
    shards = [[*one, "--resume", "--set", f"run.shard={number}/3"] for number in (2, 1, 3)]
    ways += [[*4 * shards, one]] * kind.has_shards  # four times: what needs the others' results
    for number, way in enumerate(ways):
        room = rooms / f"way{number}"
        room.mkdir()
        for more in way:
            found = run(command(room, 0, *more), room).files
        found = {file: own for file, own in found.items() if ".journal/" not in file}
        faults += [f"{way[0]}: other bytes"] * (found != right.files)
    left = Counter(path.name.split("-")[0] for path in rooms.rglob(".*"))
    told = {"kills": killed, "finished": finished, "ways": len(ways), "hidden": dict(left)}
    return {**told, "took": round(right.took, 1), "faults": faults}


def play(folder: Path, episodes: int) -> None:
    """Record episodes as a tab does; log each pull once it is noted."""
    with Recorder(PLAYED, 4, ID, root=folder) as recorder, (folder / "noted").open("a") as log:
        while (number := recorder.next_number()) < episodes:
            session = Session(PLAYED, 4, number)
            for pull in range(1, 2 + number % 5):
                session.pull(10 * pull, np.array([0.1, 0.1, 0.05]))
                recorder.note(number, session.pulls)
                log.write(f"{number} {pull}\n")
                log.flush()
            recorder.finish(number, session.pulls)


def run_play(kills: int, room: Path) -> dict[str, Any]:
    """Kill a recording so many times; what of it is lost or doubled."""
    rng, killed, faults = np.random.default_rng(0), 0, list[str]()
    words = [sys.executable, __file__, "--play", str(room)]
    while killed < kills:
        killed += run([*words, "100000"], room, rng.uniform(0, 20), writes=True).killed
        if (room / ID).exists():
            open_episodes(room / ID)
    run([*words, "0"], room)  # stores what the last one left
    own = open_episodes(room / ID).episodes
    seeds, force = own.episodes["seed"], own.steps["force"]
    noted = dict(line.split() for line in (room / "noted").read_text().splitlines())
    for number, pulls in noted.items():
        rows = np.flatnonzero(seeds == Session(PLAYED, 4, int(number)).episode_seed)
        steps = np.isin(own.episode_of(), rows)
        more = np.any(force[steps] != 0, axis=1).sum() - int(pulls)  # one may not be logged yet
        if len(rows) != 1 or more not in (0, 1):
            faults.append(f"episode {number} is there {len(rows)} times; {pulls} pulls were noted")
    return {"kills": killed, "finished": len(seeds), "faults": faults}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=250, help="over all kinds")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("kills.json"))
    parser.add_argument("--play", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.play:
        return play(Path(given.play[0]), int(given.play[1]))
    told = json.loads(given.out.read_text()) if given.out.is_file() else {}
    os.environ["OPENAI_API_KEY"] = "none"
    server = ChatServer(lambda number, body: "<answer>[0.1, 0, 0, 1, 0, 0]</answer>")
    with tempfile.TemporaryDirectory() as name, server.serving():
        sources, kills = Path(name) / "sources", math.ceil(given.kills / len(given.kinds))
        for number, words in product("01", SOURCES):
            subprocess.run(typed(words, n=number, o=sources / number), check=True)
        for number in "01":
            points = read_states(sources / number / "set/states.h5").points
            np.savez(sources / number / "curves.npz", *points)
        for kind in given.kinds:
            if kind in told:
                continue
            room, asked = Path(name) / kind, len(server.requests)
            room.mkdir()
            if kind == "play":
                told[kind] = run_play(kills, room)
            else:
                told[kind] = run_kind(kind, kills, sources, room, server.url)
            if kind == "prompt":
                told[kind]["asked"] = len(server.requests) - asked
            print(kind, told[kind], flush=True)
            given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
