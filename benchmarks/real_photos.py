"""Read photographs whose codes are known, and print what was right.

    python benchmarks/real_photos.py FOLDER LABELS
    python benchmarks/real_photos.py --drawn 500
    python benchmarks/real_photos.py --statistics FOLDER...

FOLDER has the repositories that LABELS names, as OWNER/NAME or, with one repository, its files.
LABELS is a CSV file with the columns repo, path, ropes, ends (open or closed), crossings and
gauss_code; codes were counted by eye. `--drawn` draws so many photos of each kind of
the ropes of the test split. `--statistics` measures the pictures of folders, and drawn ones, across
the lines that are read, at 256 pixels: medians, and what is between the tenths at both ends.
docs/photos.md has the tables.
"""

import csv
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.learn import load_rope_reader
from knotgym.photos import is_picture, open_picture, photograph
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
        if shot is None or not least <= len(shot.ropes) <= most or least_angle(shot) > kind.flat:
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
    found = find_ropes_crossings([line * (1, -1, 1) for line in lines], not shot.ropes)
    points = np.concatenate(lines)
    beads = [place.astype(int) for place in (found.over_place, found.under_place)]
    ways = [points[(bead + 1) % len(points)] - points[bead] for bead in beads]
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


def statistics(picture: NDArray[np.uint8]) -> dict[str, float]:
    """Measure a picture: empty if too little rope is read in it."""
    side = 256 / max(picture.shape[:2])
    small = cv2.resize(picture, None, fx=side, fy=side, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    grain = cv2.Laplacian(lab[..., 0], cv2.CV_32F)
    off, widths, rises, length = np.arange(-16, 16.5, 0.5), list[float](), list[float](), 0.0
    for rope in load_rope_reader().read(small, views=1, scales=(1.0,)).ropes:
        way = np.gradient(rope.line, axis=0)
        steps = np.hypot(*way.T)[:, None]
        length += float(steps.sum())
        across = np.column_stack([-way[:, 1], way[:, 0]]) / np.maximum(steps, 1e-6)
        places = (rope.line[:, None] + off[:, None] * across[:, None] - 0.5).astype(np.float32)
        for levels in cv2.remap(lab, places[..., 0], places[..., 1], cv2.INTER_LINEAR):
            away = levels - np.median(levels[[*range(12), *range(-12, 0)]], axis=0)
            apart = np.sqrt(away**2 @ [1, 0.5, 0.5])
            top = np.median(apart[30:35])
            low = 32 - int(np.argmax(apart[32::-1] <= top / 2))
            high = 32 + int(np.argmax(apart[32:] <= top / 2))
            if top < 6 or not 8 <= low < 32 < high < len(off) - 8:
                continue
            widths.append((high - low) / 2)
            for edge in (apart[low - 8 : low + 9], apart[high - 8 : high + 9][::-1]):
                first, last = (int(np.argmax(edge > share * top)) for share in (0.2, 0.8))
                rises += [(last - first) / 2] * (last >= first > 0)
    if len(widths) < 10 or not rises:
        return {}
    return {
        "noise": 1.4826 * float(np.median(np.abs(grain - np.median(grain)))),
        "edge rise": float(np.median(rises)),
        "light": float(np.ptp(cv2.GaussianBlur(lab[..., 0], (0, 0), 24)[8:-8, 8:-8])),
        "length over width": length / float(np.median(widths)),
        "width": float(np.median(widths)),
    }


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("labels", type=Path, nargs="?")
    parser.add_argument("--drawn", type=int, default=0, help="photos of each kind to draw")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS], choices=[*KINDS])
    parser.add_argument("--weights", nargs=1, default=[], help="folder of a reader")
    parser.add_argument("--misread", action="store_true", help="print what was read wrongly")
    parser.add_argument("--statistics", type=Path, nargs="+", default=[], metavar="FOLDER")
    args = parser.parse_args()
    sets: dict[str, Iterable[NDArray[np.uint8]]] = {
        str(folder): map(open_picture, sorted(filter(is_picture, folder.iterdir()))[:40])
        for folder in args.statistics
    }
    if sets:
        sets |= {
            name: (photo[1] for photo in drawn(name, 40))
            for name in ("table, closed", "phone, closed", "2 to 4 ropes")
        }
    for name, pictures in sets.items():
        rows = [row for picture in pictures if (row := statistics(picture))]
        print(f"{name:32} {len(rows)} pictures", end="")
        for key in rows[0] if rows else ():
            low, half, high = np.quantile([row[key] for row in rows], (0.1, 0.5, 0.9))
            print(f"; {key} {half:.2f} ({low:.2f} to {high:.2f})", end="")
        print(flush=True)
    tables = {kind: drawn(kind, args.drawn) for kind in args.kinds if args.drawn}
    if args.labels:
        tables["real"] = real(args.folder, args.labels)
    for kind, photos in tables.items():
        counts = score(photos, args.weights, args.misread)
        told = ", ".join(f"{name} {count}" for name, count in counts.items())
        print(f"{kind:16} {told}", flush=True)


if __name__ == "__main__":
    main()
