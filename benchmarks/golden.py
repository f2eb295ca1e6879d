"""Golden runs: small runs of states, episodes and pictures, and the SHA-256 of every stored array.

    python benchmarks/golden.py --compare tests/data/golden.json
    python benchmarks/golden.py --out tests/data/golden.json   # after a change that is meant

Runs `python -m knotgym` of the environment that it is started in, so that it can be run at any
commit and the files compared: what a change of code left alone has the same digests. Versions,
checksums and times in manifests are no part of it, nor is Minari's form, which follows from the
columns. --compare prints what differs; status 1 if anything does. `pytest -m thorough
tests/benchmarks` compares with the file above.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
from cyclopts import run

SEED = "3"
CHAIN = ("--engine", "chain")
RUNS = {
    "states": ("generate", "--nx", "0,1", "--count", "3"),
    "knot": ("generate", "--knot", "3_1", "--nx", "3,4", "--count", "2", *CHAIN),
    "play": ("generate", "--source", "play", "--nx", "1", "--count", "2", "--no-demonstrations"),
    "episodes": (
        *("collect", "--task", "tie", "--nx", "2", "--policy", "mixed"),
        *("--episodes", "6", "--set", "policy.planner.budget=200"),
    ),
    "recorded": ("collect", "--task", "tie", "--policy", "noisy", "--episodes", "4", *CHAIN),
    "pictures": ("images", "--nx", "0-2", "--count", "60", "--vary", "all"),
}


def digests(folder: Path) -> dict[str, str]:
    """File and dataset or column -> SHA-256 of its values, for all below a folder."""
    digest_of: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".h5":
            digest_of.update({f"{name}:{key}": value for key, value in of_hdf5(path).items()})
        elif path.suffix == ".parquet":
            digest_of.update({f"{name}:{key}": value for key, value in of_parquet(path).items()})
        elif path.suffix == ".png":
            digest_of[name] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    return digest_of


def of_hdf5(path: Path) -> dict[str, str]:
    """Dataset -> SHA-256 of its values."""
    digest_of: dict[str, str] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            values = np.asarray(item[()])
            is_text = values.dtype == object
            data = repr(values.tolist()).encode() if is_text else values.tobytes()
            digest_of[name] = hashlib.sha256(data).hexdigest()[:16]

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return digest_of


def of_parquet(path: Path) -> dict[str, str]:
    """Column -> SHA-256 of its values."""
    from pyarrow import parquet

    table = parquet.read_table(path)
    return {
        name: hashlib.sha256(repr(table[name].to_pylist()).encode()).hexdigest()[:16]
        for name in table.column_names
    }


def main(
    *, kinds: str = ",".join(RUNS), out: Path | None = None, compare: Path | None = None
) -> None:
    """Run the commands of RUNS and print the digest of all that they stored.

    Args:
        kinds: of RUNS.
        out: file to write.
        compare: what an earlier run wrote to --out.
    """
    made = dict[str, str]()
    with tempfile.TemporaryDirectory() as room:
        for kind in kinds.split(","):
            folder = Path(room) / kind
            words = [*RUNS[kind], "--seed", SEED, "--quiet", "--out", str(folder)]
            subprocess.run([sys.executable, "-m", "knotgym", *words], check=True)
            made.update({f"{kind}/{name}": value for name, value in digests(folder).items()})
    if out is not None:
        out.write_text(json.dumps(made, indent=1, sort_keys=True), encoding="utf-8")
    total = hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()
    print(f"{len(made)} datasets, columns and pictures; all together {total}")
    if compare is not None:
        before = json.loads(compare.read_text(encoding="utf-8"))
        before = {k: v for k, v in before.items() if k.partition("/")[0] in kinds.split(",")}
        names = [name for name in sorted({*before, *made}) if before.get(name) != made.get(name)]
        print("\n".join(f"differs: {name}" for name in names) or "nothing differs")
        sys.exit(1 if names else 0)


if __name__ == "__main__":
    run(main)
