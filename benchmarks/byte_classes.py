"""Which changed bytes of a state or episode file `verify` catches: bytes flipped, class by class.

    python benchmarks/byte_classes.py --states A/states.h5 --episodes B/main_data.hdf5 --count 20

A class is where a byte lies: in what a column stores, in the chunks of one that is filtered, or in
the rest, which is the library's own (headers, names, attributes, B-trees, heaps, and space that it
left free). A byte of each class is flipped whole, --count times. Told are the share that is caught
(a line of error, or a fault), that which changes nothing that a reader gets, and any other: wrong.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from damaged_files import copied
from file_readers import TOLD
from mutations import BAD, Readers
from numpy.typing import NDArray

REST = "the library's own"
CAUGHT = ("refused", "found", "harmful")


def ranges(path: Path) -> dict[str, list[tuple[int, int]]]:
    """Of each column, over all episodes, where its values are stored: first bytes and sizes."""
    found: dict[str, list[tuple[int, int]]] = defaultdict(list)

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        column = "/".join(part for part in name.split("/") if not part.startswith("episode_"))
        if item.chunks:
            count = item.id.get_num_chunks()
            chunks = [item.id.get_chunk_info(k) for k in range(count)]
            found[column] += [(chunk.byte_offset, chunk.size) for chunk in chunks]
        elif item.id.get_offset() is not None:
            found[column].append((item.id.get_offset(), item.id.get_storage_size()))

    with h5py.File(path) as file:
        file.visititems(look)
    return dict(found)


def places(path: Path) -> dict[str, NDArray[np.int64]]:
    """The bytes of each class."""
    size = path.stat().st_size
    rest = np.ones(size, dtype=bool)
    classes = {}
    for name, parts in sorted(ranges(path).items()):
        mine = [np.arange(first, first + length) for first, length in parts if length]
        if mine:
            classes[name] = np.concatenate(mine)
            rest[classes[name]] = False
    classes[REST] = np.flatnonzero(rest)
    return classes


def flipped(kind: str, source: Path, count: int, seed: int = 0) -> dict[str, Any]:
    """Flip `count` bytes of each class of a file, one at a time; all of a class with fewer."""
    right = TOLD[kind](source)[1]
    readers, told = Readers(kind, right), {}
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        for name, own in places(source).items():
            outcomes: Counter[str] = Counter()
            unnoticed = []
            for at in rng.choice(own, min(count, len(own)), replace=False).tolist():
                copy = copied(kind, source, Path(folder))
                raw = bytearray(copy.read_bytes())
                raw[at] ^= 255
                copy.write_bytes(raw)
                said = readers.outcome(copy).split(":")[0]
                outcomes[said] += 1
                if said == "unchanged" or said in BAD:
                    unnoticed.append([at, said])
            told[name] = {
                "bytes": len(own),
                "outcomes": dict(outcomes),
                "caught": sum(outcomes[one] for one in CAUGHT) / sum(outcomes.values()),
                "not caught": unnoticed,
            }
    readers.close()
    return told


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for kind in ("states", "episodes"):
        parser.add_argument(f"--{kind}", type=Path)
    parser.add_argument("--count", type=int, default=20, help="bytes of a class")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("byte_classes.json"))
    given = parser.parse_args()
    report: dict[str, Any] = {}
    print("| class | bytes | caught | changes nothing | wrong |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for kind in ("states", "episodes"):
        if (source := getattr(given, kind)) is None:
            continue
        report[kind] = flipped(kind, source, given.count, given.seed)
        for name, one in report[kind].items():
            outcomes = one["outcomes"]
            tried = sum(outcomes.values())
            caught = sum(outcomes.get(said, 0) for said in CAUGHT)
            idle = outcomes.get("unchanged", 0)
            print(
                f"| {kind}, {name} | {one['bytes']} | {caught} of {tried} | {idle}"
                f" | {tried - caught - idle} |"
            )
        given.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
