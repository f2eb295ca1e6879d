"""What a command compiles, in all of its processes, with a fresh cache.

    python benchmarks/compiled.py generate --nx 3 --count 40 --out /tmp/set

Each line is a function, the CPU seconds with and without what it calls, and its signature. Below
stand the functions that were compiled with two signatures, and those that two processes compiled,
which waited for each other in vain. Numba's own are counted, not judged.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from argparse import REMAINDER, ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from pathlib import Path
from typing import Any

# imported by every Python process that starts with it on its path
LISTENER = """
import json, os, time
from numba.core import event

class Listener(event.Listener):
    began, inner = [], [0.0]

    def on_start(self, event):
        self.began.append(time.process_time())
        self.inner.append(0.0)

    def on_end(self, event):
        seconds = time.process_time() - self.began.pop()
        own = seconds - self.inner.pop()
        self.inner[-1] += seconds
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__}.{function.__qualname__}"
        line = os.getpid(), name, str(event.data["args"]), round(seconds, 3), round(own, 3)
        with open(os.environ["COMPILED"], "a") as lines:
            lines.write(json.dumps(line) + "\\n")

event.register("numba:compile", Listener())
"""


def compiled(words: list[str]) -> list[Any]:
    """Run Python with words; return (process, function, signature, seconds, own) in order."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sitecustomize.py").write_text(LISTENER, encoding="utf-8")
        path = os.pathsep.join([name, str(Path(__file__).parents[1])])
        cache = {"NUMBA_CACHE_DIR": str(folder / "cache"), "COMPILED": str(folder / "lines")}
        subprocess.run([sys.executable, *words], env=os.environ | cache | {"PYTHONPATH": path})
        return [json.loads(line) for line in (folder / "lines").read_text().splitlines()]


def twice(lines: list[Any]) -> tuple[list[str], list[str]]:
    """Return the package's functions of two signatures, and those that two processes compiled."""
    own = [(pid, name, kind) for pid, name, kind, *_ in lines if name.startswith("knotgym.")]
    kinds = Counter(name for name, _ in {(name, kind) for _, name, kind in own})
    places = Counter(name for name, _ in {(name, pid) for pid, name, _ in own})
    found = ([name for name in count if count[name] > 1] for count in (kinds, places))
    return next(found), next(found)


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs=REMAINDER, help="a command of knotgym")
    lines = compiled(["-m", "knotgym", *parser.parse_args().words])
    for pid, name, kind, seconds, own in sorted(lines, key=lambda line: -line[-1]):
        print(f"{seconds:6.2f} {own:6.2f} {pid:7} {name} {kind[:200]}")
    signatures, processes = twice(lines)
    print(f"{sum(line[-1] for line in lines):6.2f} CPU s, {len(lines)} functions")
    print("two signatures:", ", ".join(signatures) or "none")
    print("two processes:", ", ".join(processes) or "none")


if __name__ == "__main__":
    main()
