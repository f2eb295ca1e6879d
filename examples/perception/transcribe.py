"""Transcribe pictures of knot diagrams, lines with gaps, to PD codes by tracing, without learning.

    knotgym images --nx 3,4 --count 200 --test-nx none --appearance line --out diagrams
    python examples/perception/transcribe.py diagrams [--split test] [--count 500]

A diagram with n > 0 crossings is n arcs, each of which begins and ends where its strand goes under.
Every arc is a connected piece of ink that never branches, so its middle line is found by flooding
it from one end. Ends are then paired across the gaps: two ends face each other, and the segment
between them meets one arc, the upper strand. Walking from arc to arc gives the code.

A line drawing marks neither base point nor direction. A code counts as read if it is the picture's
from some base point, in one of the two directions.
"""

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
from cyclopts import run
from numpy.typing import NDArray
from pictures import shown_rows

from knotgym.datasets import decode
from knotgym.topology import GaussCode, Symmetry, chiralities, images, knot_type, pd_text

INK = 128  # grey level below which a pixel is ink
SPECK = 12  # pixels; smaller pieces of ink are noise
BACK = 8  # points of the middle line from which an end's direction is taken
_AROUND = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
Array = NDArray[np.float64]
End = tuple[int, int]  # arc, and 0 for its first or -1 for its last point


def read(image: NDArray[np.uint8]) -> GaussCode | None:
    """Read the code of a picture, uint8 (size, size, 3), with chirality; None if tracing fails."""
    ink = (image.max(axis=2) < INK).astype(np.uint8)
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(ink, connectivity=8)
    kept = [piece for piece in range(1, count) if stats[piece, cv2.CC_STAT_AREA] >= SPECK]
    masks = [(pieces == piece).astype(np.uint8) for piece in kept]
    if len(masks) == 1 and _has_hole(masks[0]):
        return GaussCode()
    arcs = [middle_line(mask) for mask in masks]
    if not arcs or min(map(len, arcs)) < 2:
        return None
    pairs = paired(arcs)
    return None if pairs is None else walked(arcs, pairs)


def _has_hole(mask: NDArray[np.uint8]) -> bool:
    _, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return bool((hierarchy[0, :, 3] >= 0).any())


def middle_line(mask: NDArray[np.uint8]) -> Array:
    """Return points along the middle of an arc from end to end, float64 (n, 2), x right, y up."""
    ink = {(x, y) for y, x in np.argwhere(mask).tolist()}
    last = _fronts(ink, min(ink))[-1]  # what a flood reaches last is an end
    line = np.array([np.mean(front, axis=0) for front in _fronts(ink, last[0])])
    return (line + 0.5) * [1.0, -1.0]


def _fronts(ink: set[tuple[int, int]], start: tuple[int, int]) -> list[list[tuple[int, int]]]:
    """Flood the ink from a pixel; return the pixels (x, y) that each step reaches."""
    left, fronts = ink - {start}, [[start]]
    while fronts[-1]:
        # four and eight neighbours in turn grow octagons, so that fronts stay across the line
        steps = _AROUND[: 4 if len(fronts) % 2 else 8]
        front = {(x + dx, y + dy) for x, y in fronts[-1] for dx, dy in steps} & left
        left -= front
        fronts.append(sorted(front))
    return fronts[:-1]


def paired(arcs: list[Array]) -> dict[End, tuple[End, int, float]] | None:
    """Pair ends across gaps.

    Returns:
        For every end the one opposite, the arc that passes over between them, and where on it, in
        points of its middle line; None if they can't all be paired.
    """
    ends = [(arc, side) for arc in range(len(arcs)) for side in (0, -1)]
    costs = []
    for one, other in itertools.combinations(ends, 2):
        a, b = arcs[one[0]][one[1]], arcs[other[0]][other[1]]
        gap = b - a
        apart = float(np.hypot(*gap))
        along = gap / max(apart, 1e-9)
        # 0 if both ends point at each other, 4 if both point away
        turn = 2 - _outwards(arcs, one) @ along + _outwards(arcs, other) @ along
        met = [hit for arc in range(len(arcs)) for hit in _hits(arcs, arc, a, b, (one, other))]
        costs.append((apart * (1 + turn) + 1000 * abs(len(met) - 1), one, other, met))
    found: dict[End, tuple[End, int, float]] = {}
    for _, one, other, met in sorted(costs, key=lambda cost: cost[0]):
        if one not in found and other not in found and met:
            found[one], found[other] = (other, *met[0]), (one, *met[0])
    return found if len(found) == len(ends) else None


def _outwards(arcs: list[Array], end: End) -> Array:
    line = arcs[end[0]] if end[1] else arcs[end[0]][::-1]
    back = min(BACK, len(line) - 1)
    along = line[-1] - line[-1 - back]
    return np.asarray(along / max(float(np.hypot(*along)), 1e-9))


def _hits(
    arcs: list[Array], arc: int, a: Array, b: Array, ends: tuple[End, End]
) -> list[tuple[int, float]]:
    """Return where the segment from a to b meets the middle line of an arc, apart from its ends."""
    line = arcs[arc]
    u, v, w = b - a, line[1:] - line[:-1], line[:-1] - a
    det = u[0] * v[:, 1] - u[1] * v[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / det  # share of a to b
        t = (w[:, 0] * u[1] - w[:, 1] * u[0]) / det  # share of the piece of the line
    own = [0 if side == 0 else len(line) - 2 for owner, side in ends if owner == arc]
    places = np.flatnonzero((s > 0) & (s < 1) & (t >= 0) & (t < 1))
    return [(arc, float(k + t[k])) for k in places if all(abs(k - end) > 2 for end in own)]


def walked(arcs: list[Array], pairs: dict[End, tuple[End, int, float]]) -> GaussCode | None:
    """Walk from arc to arc; return the code, or None if one walk doesn't pass every arc."""
    label: dict[frozenset[End], int] = {}
    for end, (other, *_) in pairs.items():
        label.setdefault(frozenset((end, other)), len(label) + 1)
    over: list[list[tuple[float, int]]] = [[] for _ in arcs]  # places on each arc, crossings
    for gap, number in label.items():
        _, arc, place = pairs[next(iter(gap))]
        over[arc].append((place, number))
    visits: list[int] = []
    directions: dict[int, Array] = {}  # visit -> direction of walking
    arc, begin = 0, 0
    for _ in arcs:
        forwards = begin == 0
        for place, number in sorted(over[arc], reverse=not forwards):
            k = min(int(place), len(arcs[arc]) - 2)
            near = max(k - 2, 0), min(k + 3, len(arcs[arc]) - 1)
            visits.append(number)
            along = arcs[arc][near[1]] - arcs[arc][near[0]]
            directions[number] = along if forwards else -along
        end = (arc, -1 if forwards else 0)
        number = label[frozenset((end, pairs[end][0]))]
        visits.append(-number)
        arc, begin = pairs[end][0]
        directions[-number] = arcs[arc][begin] - arcs[end[0]][end[1]]
    if sorted(visits) != sorted([*directions]) or len(visits) != 2 * len(arcs):
        return None
    letters = {}
    for number in label.values():
        o, u = directions[number], directions[-number]
        letters[number] = GaussCode.letters_of([o[0] * u[1] - o[1] * u[0]])
    return GaussCode.relabelled(visits, letters)


def same_diagram(one: GaussCode, other: GaussCode) -> bool:
    """Return whether both are codes of one diagram, from any base points, in any directions."""
    return other in images(one, Symmetry.REVERSE | Symmetry.REBASE)


def main(folder: Path, *, split: str = "test", count: int = 500, out: Path | None = None) -> None:
    """Transcribe the pictures of a table, and print how many are right.

    Args:
        folder: of the table.
        split: of the pictures.
        count: of the pictures, at most.
        out: file that gets the answers, as JSON lines.
    """
    tally: dict[int, list[tuple[bool, bool]]] = {}  # nx -> for each picture: diagram, knot right
    answers = list[str]()
    for row in shown_rows(folder, split, count):
        if row["appearance"]["name"] != "line":
            raise SystemExit("no line drawings; make some with `knotgym images --appearance line`")
        code, found = GaussCode.parse(row["gauss_code_chiral"]), read(decode(row["image"]))
        exact = found is not None and same_diagram(found, code)
        planar = found is not None and found.chirality in chiralities(found)
        knot = exact or (planar and knot_type(found) == row["knot"])
        tally.setdefault(code.nx, []).append((exact, knot))
        own = "" if found is None else pd_text(found)
        answers.append(json.dumps({"pd_code": row["pd_code"], "answer": own, "right": exact}))
    if out:
        out.write_text("\n".join(answers) + "\n", encoding="utf-8")
    print("nx  pictures  diagram     knot")
    for name, rows in [*sorted(tally.items()), ("all", [*itertools.chain(*tally.values())])]:
        shares = (f"{100 * sum(column) / len(rows):6.1f} %" for column in zip(*rows, strict=True))
        print(f"{name:3} {len(rows):8} {' '.join(shares)}")


if __name__ == "__main__":
    run(main)
