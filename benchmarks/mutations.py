"""What becomes of damaged files: mutated copies of a file of each kind, each verified.

    python benchmarks/mutations.py --count 500 --states A/states.h5 --episodes B/main_data.hdf5
    python benchmarks/mutations.py --count 500 --pictures C/data/train-00000-of-00001.parquet
    python benchmarks/mutations.py --count 500 --manifests A/manifest.json --policies D/policy.json

Every copy is read in a process of its own, as a command would. Outcomes: "refused", one line of a
`KnotgymError`; "found", a fault of `verify`; "unchanged", all that a reader gets is what the sound
file gives; "wrong", something else was read and no fault named; "traceback", "crash" and "hang".
The table goes to standard output, the counts to --out.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from damaged_files import DAMAGES, TOLD, copied

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.datasets.state_verification import state_faults
from knotgym.datasets.states import read_states
from knotgym.errors import KnotgymError

LIMIT = 60.0  # seconds for a file
KINDS = ("states", "episodes", *TOLD)
TYPES = ("c16", "f4", "i1", "u8", "?", "S3", "V5", "i4,f8", "O", "ref", "enum")
Random = np.random.Generator


def _datasets(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if hasattr(item, "dtype") else None)
    return names


def _one(file: h5py.File, rng: Random) -> str:
    names = _datasets(file)
    return names[int(rng.integers(len(names)))]


def bits(path: Path, rng: Random, first: int = 0) -> None:
    """One to four bits flipped."""
    raw = bytearray(path.read_bytes())
    for at in rng.integers(first, len(raw), int(rng.integers(1, 5))):
        raw[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


def head(path: Path, rng: Random) -> None:
    """One bit in the first 4 kB flipped, which are mostly the library's."""
    raw = bytearray(path.read_bytes())
    raw[int(rng.integers(min(4096, len(raw))))] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


def cut(path: Path, rng: Random) -> None:
    """Its end missing."""
    raw = path.read_bytes()
    path.write_bytes(raw[: int(rng.integers(len(raw)))])


def types(path: Path, rng: Random) -> None:
    """A column of another type."""
    kind = TYPES[int(rng.integers(len(TYPES)))]
    special = {
        "O": h5py.string_dtype(),
        "ref": h5py.ref_dtype,
        "enum": h5py.enum_dtype({"a": 0, "b": 1}),
    }
    with h5py.File(path, "a") as file:
        name = _one(file, rng)
        shape = file[name].shape
        del file[name]
        file.create_dataset(name, shape, dtype=special.get(kind) or np.dtype(kind))


def sizes(path: Path, rng: Random) -> None:
    """A column of other sizes, up to 10 billion rows that aren't stored."""
    with h5py.File(path, "a") as file:
        name = _one(file, rng)
        old = file[name]
        shape, kind = list(old.shape) or [1], old.dtype
        del file[name]
        shape[int(rng.integers(len(shape)))] = int(rng.choice([0, 1, 3, 10**6, 10**10]))
        chunks = None if 0 in shape else tuple(min(n, 4) for n in shape)
        file.create_dataset(name, tuple(shape), dtype=kind, chunks=chunks)


def links(path: Path, rng: Random) -> None:
    """A column, or its group, that is a link, or that lies in another file."""
    with h5py.File(path, "a") as file:
        name = _one(file, rng)
        old = file[name]
        shape, kind = old.shape, old.dtype
        del file[name]
        way = int(rng.integers(4))
        if way == 0:
            file[name] = h5py.ExternalLink("/dev/zero", "/a")
        elif way == 1:
            file[name] = h5py.SoftLink("/" + _one(file, rng))
        elif way == 2 and kind.kind != "O" and shape:
            file.create_dataset(name, shape, kind, external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
        elif shape:
            layout = h5py.VirtualLayout(shape, "f8")
            layout[:] = h5py.VirtualSource("/dev/zero", "a", shape)
            file.create_virtual_dataset(name, layout)


def attributes(path: Path, rng: Random) -> None:
    """An attribute of another type or value."""
    values = [1.5, True, "\x1b[2J", b"\xff", np.arange(3), "{}", -1, h5py.Empty("f8"), 2**63]
    with h5py.File(path, "a") as file:
        places = [file, *(file[name] for name in file if len(file[name].attrs))]
        holder = places[int(rng.integers(len(places)))]
        names = list(holder.attrs)
        holder.attrs[names[int(rng.integers(len(names)))]] = values[int(rng.integers(len(values)))]


def values(path: Path, rng: Random) -> None:
    """One number of a column another: a NaN, a huge one, a negative one."""
    with h5py.File(path, "a") as file:
        numeric = [name for name in _datasets(file) if file[name].dtype.kind in "fiu"]
        data = file[numeric[int(rng.integers(len(numeric)))]]
        if data.size:
            at = tuple(int(rng.integers(size)) for size in data.shape)
            new = [float("nan"), 1e30, -7.0] if data.dtype.kind == "f" else [99, 7, 1]
            data[at] = new[int(rng.integers(3))]


CLASSES: dict[str, Callable[[Path, Random], None]] = {
    one.__name__: one for one in (bits, head, cut, types, sizes, links, attributes, values)
}


def told(kind: str, path: Path) -> tuple[list[str], dict[str, str]]:
    """The faults of a file, and digests of all that its reader gives."""
    if kind in TOLD:
        return TOLD[kind](path)
    given: dict[str, str] = {}
    if kind == "states":
        states = read_states(path)
        faults = list(state_faults(states))
        for name, column in states.columns().items():
            given[name] = hashlib.sha256(column.tobytes()).hexdigest()
    else:
        faults = verify_episodes(path, frames=None, pyknotid=False, act_out=True)
        reader = EpisodeReader(path)
        for index in range(len(reader)):
            given[f"episode {index}"] = reader.episode(index).digest()
            seen = reader.observations(index) if reader.stored != "none" else {}
            seen = seen if isinstance(seen, dict) else {"": seen}
            for name, one in seen.items():
                whole = np.ascontiguousarray(one).tobytes()
                given[f"observations {index} {name}"] = hashlib.sha256(whole).hexdigest()
    return faults, given


def _judge(kind: str, path: Path, right: dict[str, str], say: Any) -> None:
    try:
        faults, given = told(kind, path)
        other = sorted(n for n in {*given, *right} if given.get(n) != right.get(n))
        wrong = f"wrong: {', '.join(other)}"
        say.send("found" if faults else wrong if other else "unchanged")
    except KnotgymError as error:
        clear = str(error).isprintable()
        say.send("refused" if clear else f"traceback: control characters in {error!r}")
    except BaseException as error:  # whatever it is, it is the outcome
        say.send(f"traceback: {type(error).__name__}: {error}")


def outcome(kind: str, path: Path, right: dict[str, str], limit: float = LIMIT) -> str:
    """What becomes of a file, found out in a process of its own."""
    forked = multiprocessing.get_context("fork")
    heard, say = forked.Pipe(duplex=False)
    child = forked.Process(target=_judge, args=(kind, path, right, say))
    child.start()
    say.close()
    try:
        return str(heard.recv()) if heard.poll(limit) else "hang"
    except EOFError:
        return "crash"
    finally:
        child.kill()
        child.join()


def _classes(kind: str) -> dict[str, Callable[[Path, Random], None]]:
    return {one.__name__: one for one in DAMAGES[kind]} if kind in DAMAGES else CLASSES


def run(files: dict[str, Path], count: int, seed: int = 0) -> dict[str, Any]:
    """Mutate and read: `count` copies of each file, the classes in turn."""
    counts: dict[str, Counter[str]] = {}
    bad: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for kind, source in files.items():
            right = told(kind, source)[1]
            classes = _classes(kind)
            for number in range(count):
                name = list(classes)[number % len(classes)]
                copy = copied(kind, source, Path(folder))
                classes[name](copy, np.random.default_rng([seed, number]))
                said = outcome(kind, copy, right)
                counts.setdefault(f"{kind} {name}", Counter())[said.split(":")[0]] += 1
                if said.split(":")[0] in ("traceback", "crash", "hang", "wrong"):
                    bad.append(f"{kind} {name} {number}: {said}")
    return {"count": count, "seed": seed, "counts": counts, "bad": bad}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=400, help="copies of each file")
    parser.add_argument("--seed", type=int, default=0)
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    files = {kind: getattr(given, kind) for kind in KINDS}
    report = run({k: path for k, path in files.items() if path}, given.count, given.seed)
    outcomes = sorted({name for row in report["counts"].values() for name in row})
    print("| class |", " | ".join(outcomes), "|")
    print("| --- |", " | ".join("---:" for _ in outcomes), "|")
    for name, row in report["counts"].items():
        print(f"| {name} |", " | ".join(str(row[one]) for one in outcomes), "|")
    print(*report["bad"], sep="\n")
    if given.out:
        given.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
