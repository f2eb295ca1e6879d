"""Files in which one byte was changed: whether `dataset verify` finds it, or nothing was lost.

    python benchmarks/damage.py --changes 200 --out damage.json

Change k of a kind of file depends on (seed, kind, k) alone. `dataset verify` must end with 1 or 2,
without a traceback, or with 0 if the file holds what it held: values and attributes of an
HDF5 file, rows of a Parquet file, a JSON document. Otherwise the change is `missed`; --out tells
which bytes. Kinds that --out already tells aren't run again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from fuzz import Outcome, played

TASK = "--task unknot --nx 1 --engine chain --policy random --set task.horizon=4 --workers 1"
SET = f"collect {TASK} --episodes 3 --quiet"
KINDS = {  # what makes it, what is verified, which of its files is changed
    "states": ("generate --nx 0,1 --count 4 --engine chain --workers 1 --quiet --out set",
               "set/states.h5", "set/states.h5"),
    "columns": (f"{SET} --form columns --out c --id a/b-v0", "c/a/b-v0", "*.h5"),
    "minari": (f"{SET} --form minari --observation state --out m --id a/b-v0", "m/a/b-v0",
               "main_data.hdf5"),
    "recording": (f"{SET} --form recording --out r --id a/b-v0", "r/a/b-v0", "*.h5"),
    "images": ("images --nx 0,1 --count 4 --engine chain --workers 1 --quiet --out p", "p",
               "*.parquet"),
    "entry": (f"evaluate {TASK} --episodes 3 --quiet --record e.h5", "e.h5", "e.h5"),
    "evaluation": (f"evaluate {TASK} --episodes 3 --quiet --out v.json", "v.json", "v.json"),
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--changes", type=int, default=200, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("damage.json"))
    given = parser.parse_args()
    out = given.out.resolve()
    told = json.loads(out.read_text()) if out.is_file() else {}
    start = Path.cwd()
    with tempfile.TemporaryDirectory() as room:
        os.chdir(room)
        for kind in given.kinds:
            if kind not in told:
                told[kind] = change(kind, given.changes, given.seed)
                print(kind, told[kind], flush=True)
                out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        os.chdir(start)


def change(kind: str, changes: int, seed: int) -> dict[str, Any]:
    """Change a byte so many times; return how often what happened, and what was missed."""
    words, whole, name = KINDS[kind]
    made = played(words.split(), 1800)
    assert made.status == 0, made.said
    files = [Path(whole)] if Path(whole).is_file() else sorted(Path(whole).rglob(name))
    file, counts, missed = files[0], Counter[str](), []
    right, held_right = file.read_bytes(), held(file)
    assert verified(whole).status == 0
    for number in range(changes):
        rng = np.random.default_rng([seed, list(KINDS).index(kind), number])
        at, new = int(rng.integers(len(right))), bytearray(right)
        new[at] ^= int(rng.integers(1, 256))
        file.write_bytes(new)
        outcome = verified(whole)
        verdict = "traceback" if "Traceback" in outcome.said else f"status {outcome.status}"
        if outcome.status == 0:
            verdict = "without effect" if held(file) == held_right else "missed"
        counts[verdict] += 1
        if verdict not in ("status 1", "status 2", "without effect"):
            missed.append([number, at, right[at], new[at], outcome.said[-300:]])
        if not file.exists() or file.read_bytes() != new:
            counts["verify wrote"] += 1
    file.write_bytes(right)
    shutil.rmtree("__pycache__", ignore_errors=True)
    return {**counts, "bytes": len(right), "faults": missed}


def verified(path: str) -> Outcome:
    return played(["dataset", "verify", path, "--quiet"], 120)


if __name__ == "__main__":
    main()
