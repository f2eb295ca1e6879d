"""CPU seconds of this checkout beside another one's, by the difference of two runs.

    python benchmarks/pairs.py OTHER [--rounds 2] [pictures photos stream states near collect]

OTHER is a checkout of another commit with the package installed in its `.venv`, as here. Each row
of WORK is run for a small and for a large number of items in both, by turns, with one process and
one thread; what an item costs is the difference, so that imports, reading and cards don't count.
Run everything once before, so that nothing is compiled. An item of `stream` is a batch of 64
pictures, of `near` all pairs of a set. Prints milliseconds an item, here and there, and how many
times as many items a CPU second this checkout makes: the median of the rounds.
"""

import os
import resource
import subprocess
import tempfile
from pathlib import Path
from statistics import median
from typing import NamedTuple

from cyclopts import run

ROOT = Path(__file__).parents[1]
KNOTGYM = "-m knotgym"
_STREAM = """
import itertools
from knotgym.generate import ImagesConfig
from knotgym.loaders import stream
config = ImagesConfig(nx=(0, 1, 2, 3, 4), engine="chain")
blocks = stream(config, seed=0, batch=64, block=64, shuffled=1, repeats=1)
for pictures in itertools.islice(blocks, {n}): pass
"""
_NEAR = """
from knotgym.states import read_states, resolve_states
from knotgym.states.near_duplicates import pairs_within
points = read_states(resolve_states(None), images=False).points
for _ in range({n}): pairs_within(points)
"""


class Work(NamedTuple):
    """What is timed: words of Python's, with {n} items and a folder {out}; small and large n."""

    words: str | list[str]
    small: int
    large: int


_IMAGES = f"{KNOTGYM} images --engine chain --nx 0-4 --count {{n}} --out {{out}} --workers 1"
WORK = {
    "pictures": Work(f"{_IMAGES} --appearance published", 200, 800),
    "photos": Work(f"{_IMAGES} --appearance photo", 50, 200),
    "stream": Work(["-c", _STREAM], 2, 8),
    "states": Work(
        f"{KNOTGYM} generate --nx 0-4 --count {{n}} --out {{out}} --workers 1 --no-demonstrations",
        20,
        60,
    ),
    "near": Work(["-c", _NEAR], 100, 2000),
    "collect": Work(
        f"{KNOTGYM} collect --task tie --nx 2 --policy random --episodes {{n}} --engine chain"
        " --form columns --out {out} --workers 1",
        256,
        1024,
    ),
}


def seconds(checkout: Path, words: str | list[str], n: int) -> float:
    """Return the CPU seconds of a run in a checkout."""
    one = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        given = words.split() if isinstance(words, str) else words
        filled = [word.format(n=n, out=Path(folder, "out")) for word in given]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [str(checkout / ".venv" / "bin" / "python"), *filled],
            cwd=checkout,
            env=os.environ | one,
            check=True,
            capture_output=True,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(other: Path, *work: str, rounds: int = 2) -> None:
    """Print what an item costs in this checkout and in another.

    Args:
        other: checkout to compare with.
        work: rows of WORK; all by default.
        rounds: of each row.
    """
    for name in work or WORK:
        words, small, large = WORK[name]
        costs = [
            [
                1000 * (seconds(one, words, large) - seconds(one, words, small)) / (large - small)
                for one in (ROOT, other.resolve())
            ]
            for _ in range(rounds)
        ]
        here, there = (median(column) for column in zip(*costs, strict=True))
        ratio = median(theirs / own for own, theirs in costs)
        print(f"{name:9} {here:8.2f} {there:8.2f} ms an item, {ratio:5.2f} times", flush=True)


if __name__ == "__main__":
    run(main)
