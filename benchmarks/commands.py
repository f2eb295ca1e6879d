"""Small runs of every command that writes, and forks of this process in which they run.

What `fuzz.py`, `kills.py`, `together.py` and `damage.py` share. A fork has the modules and the
compiled functions of this process, so a command that was run here once (`warm`) takes as long as
its work in a fork.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from knotgym.cli import main
from knotgym.common import KnotgymError, sha256
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
    "play": Kind("record {o} 3"),
    "select": Kind(f"dataset select {{s}}/sets/{ID} --sample 4 --out {{o}}.h5"),
    "split": Kind("dataset split {s}/set --parts train=0.5,test=0.5 --out {o}.h5"),
    "merge": Kind(f"dataset merge {{s}}/sets/{ID} {{s}}/sets/{OTHER} --out {{o}}"
                  " --id knotgym/x-v0"),
    "delete": Kind("dataset delete {s}/set --rows 0 --out {o}.h5"),
    "import": Kind("dataset import {s}/curve.npy --out {o}.h5"),
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


class Outcome(NamedTuple):
    """How a command ended: its status, what it printed, seconds and its largest memory, MB."""

    status: int
    said: str
    printed: str
    seconds: float
    megabytes: float


class Fork:
    """A call in a fork of this process, in a session of its own.

    Attributes:
        id: of the process.
        seconds: since it began.
    """

    def __init__(self, call: Callable[[], object], gate: tuple[int, int] | None = None) -> None:
        """Fork; the call waits until the parent closes the far end of a pipe `gate`, if any."""
        self._out, self._err = tempfile.TemporaryFile(), tempfile.TemporaryFile()
        self._began, self._megabytes = time.perf_counter(), 0.0
        self._status: int | None = None
        self.id = os.fork()
        if not self.id:
            self._run(call, gate)

    def _run(self, call: Callable[[], object], gate: tuple[int, int] | None) -> None:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(self._out.fileno(), 1)
        os.dup2(self._err.fileno(), 2)
        # a test's runner has others in their places
        sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))
        if gate is not None:
            os.close(gate[1])
            os.read(gate[0], 1)
        status = 0
        try:
            call()
        except SystemExit as end:
            status = int(end.code or 0)
        except BaseException as error:
            os.write(2, f"Traceback: {error!r}".encode())
            status = 99
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os._exit(status)

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began

    def has_ended(self) -> bool:
        if self._status is None:
            ended, status, usage = os.wait4(self.id, os.WNOHANG)
            if ended:
                self._status = os.waitstatus_to_exitcode(status)
                self._megabytes = usage.ru_maxrss / 1024
        return self._status is not None

    def outcome(self, limit: float = 600) -> Outcome:
        """Wait for its end; it is interrupted at the limit and killed 10 seconds later."""
        signals = [(limit, signal.SIGINT), (limit + 10, signal.SIGKILL)]
        while not self.has_ended():
            if signals and self.seconds > signals[0][0]:
                os.killpg(self.id, signals.pop(0)[1])
            time.sleep(0.005)
        texts = []
        for stream in (self._err, self._out):
            stream.seek(0)
            texts.append(stream.read().decode(errors="replace"))
        status = -1 if self._status is None else self._status
        return Outcome(status, texts[0], texts[1], round(self.seconds, 1), self._megabytes)


def command(words: Sequence[str]) -> None:
    """Run a command of the package, or record by hand: record ROOT EPISODES."""
    if words[0] != "record":
        main(words)
    try:
        record(Path(words[1]), int(words[2]))
    except KnotgymError as error:
        print(f"knotgym: {error}", file=sys.stderr)
        sys.exit(2)


def record(root: Path, episodes: int) -> None:
    """Record episodes as a tab of `knotgym play` does; log each pull once it is noted."""
    root.mkdir(exist_ok=True)
    with Recorder(PLAYED, 4, ID, root=root) as recorder, (root / ".noted").open("a") as log:
        while (number := recorder.next_number()) < episodes:
            session = Session(PLAYED, 4, number)
            for pull in range(1, 2 + number % 5):
                session.pull(10 * pull, np.array([0.1, 0.1, 0.05]))
                recorder.note(number, session.pulls)
                log.write(f"{number} {pull}\n")
                log.flush()
            recorder.finish(number, session.pulls)


def played(words: Sequence[str], limit: float = 600) -> Outcome:
    """Run a command in a fork."""
    return Fork(lambda: command(words)).outcome(limit)


def warm(words: Sequence[str]) -> None:
    """Run a command in this process, so that forks have what it loads.

    Raises:
        RuntimeError: it failed.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.getsignal(number) for number in numbers]
    with tempfile.TemporaryFile("w+") as said, redirect_stdout(said), redirect_stderr(said):
        try:
            command(words)
        except SystemExit as end:
            if end.code:
                said.seek(0)
                raise RuntimeError(f"{' '.join(words)}: {said.read()}") from end
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)


@contextmanager
def sources(*numbers: int) -> Iterator[tuple[Path, Callable[..., list[str]], ChatServer]]:
    """Yield a folder, sources of these seeds in it, and a chat server.

    Yields:
        The folder; what types a kind, with seed n and output o; and the server.
    """
    os.environ["OPENAI_API_KEY"] = "none"
    server = ChatServer(lambda number, body: "<answer>[0.1, 0, 0, 1, 0, 0]</answer>")
    with tempfile.TemporaryDirectory() as name, server.serving():
        given = Path(name) / "sources"

        def typed(kind: str, n: int, o: Path) -> list[str]:
            return KINDS[kind].words.format(s=given / str(n), n=n, o=o, url=server.url).split()

        for number, words in product(numbers, SOURCES):
            warm(words.format(n=number, o=given / str(number)).split())
        for number in numbers:
            points = read_states(given / str(number) / "set/states.h5").points
            np.save(given / str(number) / "curve.npy", points[0])
        yield Path(name), typed, server


def made(folder: Path) -> dict[str, str]:
    """SHA-256 of every file that isn't hidden."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: sha256(path) for name, path in files.items() if "/." not in f"/{name}"}
