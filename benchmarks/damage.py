"""Files in which one byte was changed: whether that is found, or nothing was lost.

    python benchmarks/damage.py --changes 200 --out damage.json

Change k of a kind of file depends on (seed, kind, k) alone. What reads the file must then end with
1 or 2, in words and without a traceback; or with 0 and what it ends with for the right file. For
datasets that is `dataset verify`, and the values and attributes that an HDF5 file, the rows that a
Parquet file or the document that a JSON file holds; otherwise it is what the reader prints and
writes. What a user typed has no right value: what is read as something else is counted as `another
value`. All other changes are `missed`, and --out tells which bytes. Changes that --out already
tells aren't made again.

`dataset verify` first tries in another process whether the HDF5 library survives a file. Here the
process that reads is a fork anyway, and only where it dies the whole command is run.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import h5py
import numpy as np
from commands import Fork, Outcome, command, made, warm

from knotgym.common import KnotgymError, sha256
from knotgym.loaders import arrays
from knotgym.runs import executor

TASK = "--task unknot --nx 1 --engine chain --policy random --set task.horizon=4 --workers 1"
STATES = "generate --nx 0,1 --count 4 --engine chain --workers 1 --quiet"
SET = f"collect {TASK} --episodes 3 --quiet"
PLAYED = "evaluate --task unknot --nx 1 --engine chain --workers 1 --episodes 2 --quiet"
CLONE = "train --learner clone --steps 4 --set clone.demonstrations=2 --set clone.batch=2 --quiet"
SETTINGS = '[task]\nhorizon = 4\nsplit = "test"\n[run]\noverwrite = true\n'
CODES = "1+,1-\n1+,2-,2+,1-\nX[1,2,2,1]\n"

PART = 20  # changes of a kind before it is the next one's turn


class Kind(NamedTuple):
    """A kind of file: what makes it, its name, what reads it, and what that writes, if it does."""

    makes: tuple[str, ...]
    file: str
    reads: str
    writes: str = ""
    typed: bool = False  # by a user


KINDS = {
    "states": Kind((f"{STATES} --out set",), "set/states.h5", "dataset verify set/states.h5"),
    "columns": Kind((f"{SET} --form columns --out c --id a/b-v0",), "*.h5",
                    "dataset verify c/a/b-v0"),
    "minari": Kind((f"{SET} --form minari --observation state --out m --id a/b-v0",),
                   "main_data.hdf5", "dataset verify m/a/b-v0"),
    "recording": Kind((f"{SET} --form recording --out r --id a/b-v0",), "*.h5",
                      "dataset verify r/a/b-v0"),
    "images": Kind(("images --nx 0,1 --count 4 --engine chain --workers 1 --quiet --out p",),
                   "*.parquet", "dataset verify p"),
    "entry": Kind((f"{PLAYED} --policy random --record e.h5",), "e.h5", "dataset verify e.h5"),
    "evaluation": Kind((f"{PLAYED} --policy random --out v.json",
                        f"{PLAYED} --policy noisy --out right.json"), "v.json",
                       "compare v.json right.json"),
    "journal": Kind((f"{STATES} --set run.shard=1/2 --out j", f"{STATES} --set run.shard=2/2"
                     " --resume --out j"), "*.npy", f"{STATES} --resume --out j", "j"),
    "policy": Kind((f"{CLONE} --out l",), "policy.json", f"{PLAYED} --policy l --out v.json",
                   "v.json"),
    "weights": Kind((f"{CLONE} --out l",), "*.safetensors", f"{PLAYED} --policy l --out v.json",
                    "v.json"),
    "pictures": Kind((f"{SET} --form columns --out c --id a/b-v0", "cache"), "*.npy", "cache", "d"),
    "settings": Kind((), "settings.toml", f"{PLAYED} --policy random --settings settings.toml"
                     " --out v.json", "v.json", True),
    "codes": Kind((), "codes.txt", f"{STATES} --no-demonstrations --codes codes.txt --out g", "g",
                  True),
}  # fmt: skip


def held(path: Path) -> Any:
    """Return what a file holds, in a form that can be compared; None if nobody can read it."""
    try:
        if path.suffix == ".json":
            return json.loads(path.read_bytes())
        if path.suffix == ".parquet":
            from pyarrow import parquet

            table = parquet.read_table(path)
            return str(table.schema.metadata), table.to_pydict()
        with h5py.File(path) as file:
            found = [_of_object(file)]
            file.visititems(lambda name, one: found.append((name, _of_object(one))))
        return found
    except Exception:  # whatever a library raises at a damaged file
        return None


def _of_object(one: Any) -> Any:
    attributes = {name: np.asarray(value).tolist() for name, value in one.attrs.items()}
    return attributes, one[()].tolist() if isinstance(one, h5py.Dataset) else None


def read(words: str) -> None:
    """Run a command without processes of its own, or read pictures from a cache."""
    if words != "cache":
        with mock.patch("knotgym.cli.inspection.executor", lambda workers: executor(1)):
            command(words.split())
    try:
        found = arrays("c/a/b-v0", observation="pixels", cache="cache")["observations"]
    except KnotgymError as error:
        print(f"knotgym: {error}", file=sys.stderr)
        sys.exit(2)
    np.save("d", found)


def prepare(kind: Kind, folder: Path) -> None:
    """Make a kind of file, and whatever it takes to read it, in a folder."""
    folder.mkdir()
    os.chdir(folder)
    Path("settings.toml").write_text(SETTINGS)
    Path("codes.txt").write_text(CODES)
    for words in kind.makes:
        if words == "cache":
            read(words)
        else:
            warm(words.split())


def outcome(kind: Kind, pristine: Path, file: Path, data: bytes) -> tuple[Outcome, Any]:
    """Read a copy of the folder with other data in the file; return the end and what was found."""
    work = pristine.parent / "work"
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(pristine, work)
    os.chdir(work)
    file.write_bytes(data)
    end = Fork(lambda: read(kind.reads)).outcome(60)
    if end.status < 0:  # the HDF5 library crashed
        run = [sys.executable, "-m", "knotgym", *kind.reads.split()]
        found = subprocess.run(run, capture_output=True, text=True)
        end = Outcome(found.returncode, found.stderr, found.stdout, 0, 0)
    if "verify" in kind.reads and file.read_bytes() != data:
        return end._replace(status=99, said="the file was written"), None
    if "verify" in kind.reads:
        return end, held(file)
    written = Path(kind.writes)
    digests = {"": sha256(written)} if written.is_file() else made(written)
    return end, [end.printed, digests if kind.writes else {}]


def change(name: str, changes: range, seed: int, folder: Path) -> dict[str, Any]:
    """Change a byte so many times; return how often what happened, and what was missed."""
    kind, pristine = KINDS[name], folder / "made"
    if not pristine.exists():
        prepare(kind, pristine)
    os.chdir(pristine)
    file = sorted(Path().rglob(kind.file))[0]
    right, counts, faults = file.read_bytes(), Counter[str](), []
    end, expected = outcome(kind, pristine, file, right)
    assert end.status == 0, end.said
    for number in changes:
        rng = np.random.default_rng([seed, *name.encode(), number])
        at, new = int(rng.integers(len(right))), bytearray(right)
        new[at] ^= int(rng.integers(1, 256))
        end, found = outcome(kind, pristine, file, bytes(new))
        verdict = f"status {end.status}"
        if "Traceback" in end.said or (end.status in (1, 2) and not end.said.strip()):
            verdict = "traceback or silence"
        elif end.status == 0:
            other = "another value" if kind.typed else "missed"
            verdict = "without effect" if found == expected else other
        counts[verdict] += 1
        if verdict not in ("status 1", "status 2", "without effect", "another value"):
            faults.append([number, str(file), at, right[at], new[at], end.said[-300:]])
    return {"bytes": len(right), "counts": counts, "faults": faults}


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--changes", type=int, default=200, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("damage.json"))
    given = parser.parse_args()
    out, start = given.out.resolve(), Path.cwd()
    told = json.loads(out.read_text()) if out.is_file() else {}
    with tempfile.TemporaryDirectory() as room:
        # in parts, so that every kind has some when time is up
        for first, kind in product(range(0, given.changes, PART), given.kinds):
            own = told.setdefault(kind, {"changes": 0, "counts": {}, "faults": []})
            part = range(own["changes"], min(first + PART, given.changes))
            if not part:
                continue
            folder = Path(room) / kind
            folder.mkdir(exist_ok=True)
            new = change(kind, part, given.seed, folder)
            own["counts"] = Counter(own["counts"]) + new["counts"]
            own["faults"] += new["faults"]
            own |= {"changes": part.stop, "bytes": new["bytes"]}
            out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        os.chdir(start)
    for kind, own in told.items():
        print(kind, own, flush=True)


if __name__ == "__main__":
    main()
