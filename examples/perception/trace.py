"""Read the Gauss code of a published picture by tracing the hue along the rope, without learning.

    python examples/perception/trace.py FOLDER [--split test] [--count 500] [--page misread.png]

In published pictures the hue encodes the position along the rope: the colours of beads 1 to 99 go
once round a circle. On a black background, a pixel that one strand covers in part has that strand's
hue, only darker. So each pixel that shows a single strand gives a position along the rope. The mean
coordinates of the pixels of each position form the rope's axis, a closed polygon, whose crossings
are found as in any rope. Which strand is over is decided at the crossing: the colour there is the
over strand's.

This needs only the published colours. It fails where strands run along each other, or where the
hole of a kink is smaller than a pixel.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pictures import Misread, page, shown_rows

from knotgym.datasets import decode
from knotgym.prompting import reading_scores, reading_table
from knotgym.rendering import bead_colours
from knotgym.topology import GaussCode, find_crossings

BEADS = 100
FINE = 8  # colours between neighbouring beads with which pixels are compared
# weight of the axis's squared second differences against the squared distances of its pixels
STIFF = 2.0
Array = NDArray[np.float64]


def palette() -> tuple[Array, Array]:
    """Return positions along the rope, float64 (n,), and their unit colours, float64 (n, 3).

    Positions are in beads, whole numbers at the middles of beads; the white base bead is left out.
    """
    place = np.arange(1, BEADS - 1, 1 / FINE)
    colours = bead_colours(BEADS).astype(np.float64)
    low = place.astype(int)
    mixed = colours[low] + (place - low)[:, None] * (colours[low + 1] - colours[low])
    return place, mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


PLACE, UNIT = palette()
COLOURS = bead_colours(BEADS).astype(np.float64)


def read(image: NDArray[np.uint8]) -> GaussCode | None:
    """Read the code of a picture, uint8 (size, size, 3), with chirality; None if tracing fails."""
    rows, columns = np.nonzero(image.max(axis=2) > 40)
    at = np.stack([columns + 0.5, rows + 0.5], axis=1)
    seen = image[rows, columns].astype(np.float64)
    bright = np.linalg.norm(seen, axis=1)
    likeness = (seen / bright[:, None]) @ UNIT.T
    best = likeness.argmax(axis=1)
    grey = (seen.min(axis=1) > 0.75 * seen.max(axis=1)) & (seen.max(axis=1) > 60)
    pure = (likeness.max(axis=1) > 0.997) & ~grey
    # Find the base bead as the whitest 3 x 3 pixels, by their least channel. Crossings of strands
    # of opposite hues are grey too, but smaller.
    whiteness = image.min(axis=2).astype(np.float64)
    top = np.unravel_index(cv2.blur(whiteness, (3, 3)).argmax(), whiteness.shape)
    white = np.where(
        np.hypot(at[:, 1] - top[0] - 0.5, at[:, 0] - top[1] - 0.5) < 2.5,
        whiteness[rows, columns],
        0.0,
    )
    if not white.any():
        return None
    base = np.average(at, axis=0, weights=white)
    axis = follow(
        at[pure], PLACE[best[pure]], np.minimum(bright[pure], 255.0) / 255, base, white.sum() / 255
    )
    if axis is None:
        return None
    flat = np.column_stack([axis[:, 0], -axis[:, 1], np.zeros(len(axis))])
    # all heights are 0 so far, so which strand is called over is arbitrary
    crossings = find_crossings(flat)
    step = len(axis) / BEADS
    height = np.zeros(len(axis))
    for over, under, position in zip(
        crossings.over_place, crossings.under_place, crossings.position, strict=True
    ):
        if upper(image, (position[0], -position[1]), over / step, under / step):
            high, low = over, under
        else:
            high, low = under, over
        for place, lift in ((high, 1.0), (low, -1.0)):
            height[[int(place) % len(axis), (int(place) + 1) % len(axis)]] += lift
    return find_crossings(np.column_stack([flat[:, :2], height])).code


def follow(at: Array, place: Array, weight: Array, base: Array, base_weight: float) -> Array | None:
    """Fit the axis to pixels.

    Args:
        at: float64 (n, 2), pixels.
        place: float64 (n,), their positions along the rope, beads.
        weight: float64 (n,).
        base: float64 (2,), the base bead.
        base_weight: its weight.

    Returns:
        float64 (2 BEADS, 2), points half a bead apart that start at the base bead; None if fewer
        than half of them are seen.
    """
    count = 2 * BEADS
    points, weights = np.zeros((count, 2)), np.zeros(count)
    points[0], weights[0] = base, base_weight
    for direction in (1, -1):  # from the base bead, which is certain, to the far side
        last = 0
        for k in range(2, BEADS + 1):
            near = np.abs(place - direction * k / 2 % BEADS) <= 0.5
            # a second blob of the same hue may be a blend of two other strands: take only pixels
            # near the last point, and allow more distance the more points were missed since
            near &= np.linalg.norm(at - points[direction * last], axis=1) < 2.2 + 1.6 * (k - last)
            if near.any():
                points[direction * k], weights[direction * k], last = (
                    np.average(at[near], axis=0, weights=weight[near]),
                    weight[near].sum(),
                    k,
                )
    if (weights > 0).sum() < count / 2:
        return None
    # Minimize sum w |x - p|^2 + STIFF |D x|^2, D being the circular second difference; missing
    # points have weight 0 and are interpolated.
    bend = (
        np.roll(np.eye(count), 1, axis=0) + np.roll(np.eye(count), -1, axis=0) - 2 * np.eye(count)
    )
    return np.asarray(
        np.linalg.solve(np.diag(weights) + STIFF * bend.T @ bend, weights[:, None] * points)
    )


def upper(
    image: NDArray[np.uint8], position: tuple[float, float], first: float, second: float
) -> bool:
    """Return whether, at a crossing, the strand at position `first` is over that at `second`.

    Compares the pixels around the crossing with both strands' colours. Positions along the rope are
    in beads, whole numbers at the middles of beads.
    """
    x, y = position
    column, row = int(x), int(y)
    total = 0.0
    for r in range(max(0, row - 1), min(len(image), row + 2)):
        for c in range(max(0, column - 1), min(len(image), column + 2)):
            seen, apart = image[r, c].astype(np.float64), np.hypot(c + 0.5 - x, r + 0.5 - y)
            total += np.exp(-((apart / 0.6) ** 2)) * (
                distance(seen, second) - distance(seen, first)
            )
    return total > 0


def distance(seen: Array, place: float) -> float:
    """Return the least distance of a colour from those within a bead of a position."""
    beads = [int(round(place)) + k for k in (-1, 0, 1)]
    return float(min(np.linalg.norm(seen - COLOURS[bead % BEADS]) for bead in beads))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--split")
    parser.add_argument("--count", type=int)
    parser.add_argument(
        "--page", type=Path, help="file for a page of the accepted pictures that were misread"
    )
    given = parser.parse_args()
    readings: list[dict[str, object]] = []
    missed: list[Misread] = []
    columns = ["image", "gauss_code", "grade", "accepted", "appearance", "source"]
    for row in shown_rows(given.folder, given.split, given.count, columns):
        if row["appearance"]["colours"] != "published" or any(row["appearance"]["background"]):
            continue
        image = decode(row["image"])
        code = read(image)
        true = GaussCode.parse(row["gauss_code"])
        good = code is not None and code.matches(true)
        found = None if code is None else str(code)
        facts = {name: row[name] for name in ("gauss_code", "grade", "accepted")}
        readings.append({**facts, "read": found})
        if row["accepted"] and not good:
            missed.append((image, row["gauss_code"], "lost" if code is None else str(code)))
            print(
                f"accepted, misread: row {row['source']['row']}, {row['gauss_code']} read as"
                f" {missed[-1][2]}"
            )
    for cells in reading_table(reading_scores(readings)):
        print("{:16} {:>6} {:>8} {:>9} {:>6}".format(*cells))
    if given.page and missed:
        page(missed, given.page)
        print(f"{given.page}: {len(missed)} misread")
    elif given.page:
        print(f"no accepted picture was misread, so there is no {given.page}")


if __name__ == "__main__":
    main()
