"""Read photographs whose codes are known, and print what was right.

    python benchmarks/real_photos.py FOLDER LABELS
    python benchmarks/real_photos.py --drawn 500

FOLDER has the repositories that LABELS names, as OWNER/NAME or, with one repository, its files.
LABELS is a CSV file with the columns repo, path, ropes, ends (open or closed), crossings and
gauss_code; codes were counted by eye. `--drawn` draws so many photos of each kind of
the ropes of the test split. docs/photos.md has the tables.
"""

import csv
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.learn import load_rope_reader
from knotgym.photos import open_picture, photograph
from knotgym.rendering import AppearanceConfig
from knotgym.states import read_states, shipped
from knotgym.topology import RopesCode, find_ropes_crossings

# name, picture, code (None without a rope), is closed, and crossings: more than the code's where
# they can be counted, but which strand is over can't be told by eye
Known = tuple[str, NDArray[np.uint8], RopesCode | None, bool, int]
PHONE: dict[str, Any] = {"look": "phone", "open": 0.0, "cropped": 0.0}


class Kind(NamedTuple):
    """Drawn photos: settings, open ropes, most of the flattest angle, whether no rope is seen."""

    settings: dict[str, Any]
    ropes: tuple[int, int] = (0, 0)
    flat: float = 90.0
    bare: bool = False


KINDS = {
    "table, closed": Kind({}),
    "phone, closed": Kind(PHONE),
    "open": Kind(PHONE | {"open": 1.0}, (1, 1)),
    "2 to 4 ropes": Kind(PHONE | {"ropes": (2, 3, 4)}, (2, 4)),
    "cropped": Kind(PHONE | {"open": 0.5, "cropped": 1.0}, (1, 9)),
    "8 to 30 degrees": Kind(PHONE | {"open": 0.5}, (0, 1), 30.0),
    "no rope": Kind(PHONE | {"open": 1.0}, (1, 1), bare=True),
}


def real(folder: Path, labels: Path) -> Iterator[Known]:
    with labels.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            path, closed = folder / row["repo"] / row["path"], row["ends"] == "closed"
            picture = open_picture(path if path.exists() else folder / row["path"])
            code = RopesCode.parse(row["gauss_code"], closed)
            yield row["path"], picture, code, closed, int(row["crossings"])


def drawn(name: str, count: int) -> Iterator[Known]:
    kind, rng = KINDS[name], np.random.default_rng(list(KINDS).index(name))
    config, (least, most) = AppearanceConfig(name="photo", **kind.settings), kind.ropes
    states = read_states(shipped("bench"), images=False)
    rows = np.flatnonzero(states.split == "test")
    while count:
        shot = photograph(states.points[rng.choice(rows)], 256, rng, config=config)
        if shot is None or not (
            least <= len(shot.ropes) <= most and least_angle(shot) <= kind.flat
        ):
            continue
        picture, code = shot.image, None if kind.bare else shot.code
        if code and shot.others:  # pieces of other ropes, which a person sees as well
            more = len(shot.others)
            code = RopesCode(code.visits + ((),) * more, code.closed + (False,) * more)
        if kind.bare:  # a part without any rope
            row, column = rng.integers(0, 160, 2)
            window = slice(row, row + 96), slice(column, column + 96)
            if np.pad(shot.strands, 12)[row : row + 120, column : column + 120].any():
                continue
            picture = picture[window]
        closed = code is not None and all(code.closed)
        yield f"{name} {count}", picture, code, closed, code.nx if code else 0
        count -= 1


def least_angle(shot: Any) -> float:
    """Return the smallest angle at a crossing, degrees; 90 without crossings."""
    lines = shot.ropes or [shot.line * (1, 1, shot.look.scale)]
    found, points = (
        find_ropes_crossings([one * (1, -1, 1) for one in lines], not shot.ropes),
        np.concatenate(lines),
    )
    ways = [
        points[(place.astype(int) + 1) % len(points)] - points[place.astype(int)]
        for place in (found.over_place, found.under_place)
    ]
    a, b = (np.arctan2(*way[:, 1::-1].T) for way in ways)
    off = np.abs(a - b) % np.pi
    return float(np.degrees(np.minimum(off, np.pi - off).min(initial=np.pi / 2)))


def score(photos: Iterator[Known], weights: list[str], says: bool) -> Counter[str]:
    """Read photos and count what is right; `says` prints what isn't."""
    reader, counts, spent = load_rope_reader(*weights), Counter[str](), 0.0
    for name, picture, code, closed, crossings in photos:
        start = time.process_time()
        reading = reader.read(picture)
        spent += time.process_time() - start
        found = reading.code and reading.code.plain.smallest(ordered=False)
        wanted = code and code.plain.smallest(ordered=False)
        known, sure = crossings == (code.nx if code else 0), reading.confidence >= 0.5
        right = known and found == wanted
        counts["photos"] += 1
        counts["known codes"] += known
        counts["crossings"] += reading.crossings == crossings
        counts["whole code"] += right
        counts["false closed"] += reading.closed and not closed
        counts["refused"] += code is not None and reading.code is None
        counts["sure"] += sure
        counts["sure of known"] += sure and known
        counts["sure and right"] += right and sure
        if says and not right:
            print(f"{name}: {wanted}, read {found} ({reading.confidence:.2f}) {reading.reason}")
    counts["CPU ms each"] = round(1000 * spent / max(counts["photos"], 1))
    return counts


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("labels", type=Path, nargs="?")
    parser.add_argument("--drawn", type=int, default=0, help="photos of each kind to draw")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS], choices=[*KINDS])
    parser.add_argument("--weights", nargs=1, default=[], help="folder of a reader")
    parser.add_argument("--misread", action="store_true", help="print what was read wrongly")
    args = parser.parse_args()
    tables = {kind: drawn(kind, args.drawn) for kind in args.kinds if args.drawn}
    if args.labels:
        tables["real"] = real(args.folder, args.labels)
    for kind, photos in tables.items():
        counts = score(photos, args.weights, args.misread)
        print(
            f"{kind:16} " + ", ".join(f"{name} {count}" for name, count in counts.items()),
            flush=True,
        )


if __name__ == "__main__":
    main()
