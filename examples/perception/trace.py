"""Read the Gauss code off a published picture without learning anything: trace the hue along the rope.

    python examples/perception/trace.py FOLDER [--split test] [--count 500]

A published rope says by its colour where along itself a pixel lies: the colours of beads 1 to 99 go once round a circle. On a black
background a pixel that one strand covers in part has that strand's hue, only darker. So each pixel whose colour is that of one
strand gives a place along the rope; the mean position of the pixels of a place, from bead to bead, is the rope's axis, a closed
polygon whose crossings are found as any rope's. Which strand is over is read at the crossing: the colour there is the over strand's,
and the pixels of the under strand are missing.

It needs the published colours and nothing else; it fails where strands run along each other or a kink's eye is smaller than a pixel.
"""

import argparse
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from knotgym.crossings import find_crossings
from knotgym.datasets.images import decode, read_rows
from knotgym.gauss import GaussCode
from knotgym.picture import bead_colours

BEADS = 100
FINE = 8  # colours between two beads that a pixel is compared with
STIFF = 2.0  # pixels' worth of a bend of the axis by one pixel, against a pixel that lies one pixel off it
Array = NDArray[np.float64]


def palette() -> tuple[Array, Array]:
    """Places along the rope float64 (n,), at beads' middles where whole, and unit colours there float64 (n, 3); the base bead left out."""
    place = np.arange(1, BEADS - 1, 1 / FINE)
    colours = bead_colours(BEADS).astype(np.float64)
    low = place.astype(int)
    mixed = colours[low] + (place - low)[:, None] * (colours[low + 1] - colours[low])
    return place, mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


PLACE, UNIT = palette()
COLOURS = bead_colours(BEADS).astype(np.float64)


def read(image: NDArray[np.uint8]) -> GaussCode | None:
    """The code that a picture uint8 (size, size, 3) shows, with chirality; None where the rope can't be followed."""
    rows, columns = np.nonzero(image.max(axis=2) > 40)
    at = np.stack([columns + 0.5, rows + 0.5], axis=1)
    seen = image[rows, columns].astype(np.float64)
    bright = np.linalg.norm(seen, axis=1)
    likeness = (seen / bright[:, None]) @ UNIT.T
    best = likeness.argmax(axis=1)
    white = (seen.min(axis=1) > 0.75 * seen.max(axis=1)) & (seen.max(axis=1) > 60)
    pure = (likeness.max(axis=1) > 0.997) & ~white
    axis = follow(at[pure], PLACE[best[pure]], np.minimum(bright[pure], 255.0), at[white], bright[white])
    if axis is None:
        return None
    flat = np.column_stack([axis[:, 0], -axis[:, 1], np.zeros(len(axis))])
    found = find_crossings(flat)  # heights are not known yet: each crossing's over and under may be exchanged
    step = len(axis) / BEADS
    height = np.zeros(len(axis))
    for over, under, position in zip(found.over_place, found.under_place, found.position, strict=True):
        if upper(image, (position[0], -position[1]), over / step, under / step):
            high, low = over, under
        else:
            high, low = under, over
        for place, lift in ((high, 1.0), (low, -1.0)):
            height[[int(place) % len(axis), (int(place) + 1) % len(axis)]] += lift
    return find_crossings(np.column_stack([flat[:, :2], height])).code


def follow(at: Array, place: Array, weight: Array, white: Array, bright: Array) -> Array | None:
    """The axis, float64 (2 BEADS, 2), half a bead apart from the start of the base bead, from pixels and their places."""
    knots = np.arange(0.5, BEADS + 0.5, 0.5) - 0.5  # the middle of bead i is knot 2 i
    points, weights = np.zeros((len(knots), 2)), np.zeros(len(knots))
    last = None
    for k, knot in enumerate(knots):
        if 1.0 <= knot <= BEADS - 1:
            near = np.abs(place - knot) <= 0.5
            if near.sum() == 0:
                continue
            own, mass = at[near], weight[near]
            if last is not None:  # of two blobs of one hue (a blend of two other strands) the one next to the last
                close = np.linalg.norm(own - points[last], axis=1) < 2.2 + 1.6 * (k - last)
                if not close.any():
                    continue
                own, mass = own[close], mass[close]
            points[k], weights[k] = (own * mass[:, None]).sum(axis=0) / mass.sum(), mass.sum() / 255
            last = k
    if len(white):
        points[0], weights[0] = (white * bright[:, None]).sum(axis=0) / bright.sum(), bright.sum() / 255
    if (weights > 0).sum() < len(knots) / 2:
        return None
    bend = np.roll(np.eye(len(knots)), 1, axis=0) + np.roll(np.eye(len(knots)), -1, axis=0) - 2 * np.eye(len(knots))
    return np.asarray(np.linalg.solve(np.diag(weights) + STIFF * bend.T @ bend, weights[:, None] * points))


def upper(image: NDArray[np.uint8], position: tuple[float, float], first: float, second: float) -> bool:
    """Whether the strand at place `first` (beads, bead middles whole) is the upper one at a crossing, by the pixels around it."""
    x, y = position
    column, row = int(x), int(y)
    total = 0.0
    for r in range(max(0, row - 1), min(len(image), row + 2)):
        for c in range(max(0, column - 1), min(len(image), column + 2)):
            seen, apart = image[r, c].astype(np.float64), np.hypot(c + 0.5 - x, r + 0.5 - y)
            total += np.exp(-((apart / 0.6) ** 2)) * (distance(seen, second) - distance(seen, first))
    return total > 0


def distance(seen: Array, place: float) -> float:
    """From a colour to those of the rope within a bead of a place."""
    beads = [int(round(place)) + k for k in (-1, 0, 1)]
    return float(min(np.linalg.norm(seen - COLOURS[bead % BEADS]) for bead in beads))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--split")
    parser.add_argument("--count", type=int, default=10**9)
    given = parser.parse_args()
    right: Counter[tuple[str, object]] = Counter()
    tried: Counter[tuple[str, object]] = Counter()
    missed = []
    for number, row in enumerate(read_rows(given.folder, given.split, ["image", "gauss_code", "nx", "grade", "accepted", "appearance", "source"])):
        if number >= given.count:
            break
        if row["appearance"]["colours"] != "published" or any(row["appearance"]["background"]):
            continue
        code = read(decode(row["image"]))
        good = code is not None and str(code) == row["gauss_code"]
        keys = [("all", ""), ("nx", row["nx"]), ("grade", row["grade"]), ("accepted" if row["accepted"] else "not accepted", "")]
        for key in keys:
            tried[key] += 1
            right[key] += good
        if row["accepted"] and not good:
            missed.append((row["source"]["row"], row["gauss_code"], "lost" if code is None else str(code)))
    for key in sorted(tried, key=str):
        print(f"{' '.join(map(str, key)):16} {right[key]:5} of {tried[key]:5} {100 * right[key] / tried[key]:6.2f} %")
    for one in missed:
        print("accepted, misread: row {}, {} read as {}".format(*one))


if __name__ == "__main__":
    main()
