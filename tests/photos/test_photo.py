"""Photos: the answers are what an outside computation from points and camera finds.

`PHOTOS=20000 pytest -s -m 'slow or not slow' tests/photos/test_photo.py` looks at more.
"""

import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.photos.photo import photograph, take
from knotgym.photos.photo_painting import Shot
from knotgym.rendering import AppearanceConfig
from knotgym.states import read_states, shipped
from knotgym.topology import RopesCode, pd_text

Array = NDArray[np.float64]
PHOTOS = int(os.environ.get("PHOTOS", "12"))


def photos(count: int, size: int, seed: int) -> Iterator[tuple[Array, Shot]]:
    """Photograph shipped states in random order; yield their points, and their photos."""
    rng = np.random.default_rng(seed)
    ropes = [read_states(shipped(one), images=False).points for one in ("readable", "bench")]
    states = np.concatenate(ropes)
    while count:
        points = states[rng.integers(len(states))]
        if (shot := photograph(points, size, rng)) is not None:
            yield points, shot
            count -= 1


def faults(points: Array, shot: Shot) -> list[str]:
    """Compare all answers with what points, camera and picture say, without the package's code."""
    wrong, look, answers = list[str](), shot.look, shot
    t, h, turn = math.radians(look.tilt), math.radians(look.heading), look.turn

    def about_z(a: float) -> Array:
        return np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])

    # turn the world so that the camera leans along x, tilt it so that the line of sight is z
    tip = np.array([[math.cos(t), 0, -math.sin(t)], [0, 1, 0], [math.sin(t), 0, math.cos(t)]])
    seen = (points - points.mean(axis=0)) @ (about_z(h) @ tip @ about_z(-h)).T
    if not np.allclose(seen, answers.points - answers.points.mean(axis=0), atol=1e-12):
        wrong.append("projection")
    # every pair of segments
    a, b = seen, np.roll(seen, -1, axis=0) - seen
    i, j = (one[np.newaxis] for one in np.triu_indices(len(a), 2))
    apart = (i != 0) | (j != len(a) - 1)
    i, j = i[apart], j[apart]
    det, w = b[i, 0] * b[j, 1] - b[i, 1] * b[j, 0], a[j, :2] - a[i, :2]
    s = (w[:, 0] * b[j, 1] - w[:, 1] * b[j, 0]) / det
    u = (w[:, 0] * b[i, 1] - w[:, 1] * b[i, 0]) / det
    found = list[tuple[float, float, bool, int]]()  # over place, under place, first is over, sign
    for k in np.flatnonzero((0 <= s) & (s < 1) & (0 <= u) & (u < 1)).tolist():
        first = bool(a[i[k], 2] + s[k] * b[i[k], 2] > a[j[k], 2] + u[k] * b[j[k], 2])
        places = (i[k] + s[k], j[k] + u[k]) if first else (j[k] + u[k], i[k] + s[k])
        found.append((*places, first, 1 if (det[k] > 0) == first else -1))
    found.sort(key=lambda one: min(one[:2]))
    visits = sorted(
        [(o, k + 1) for k, (o, *_) in enumerate(found)]
        + [(v, -k - 1) for k, (_, v, *_) in enumerate(found)]
    )
    if tuple(k for _, k in visits) != answers.crossings.code.visits:
        wrong.append("code")
        return wrong
    if [sign for *_, sign in found] != list(answers.crossings.code.signs):
        wrong.append("signs")
    # the drawn line, against the beads in the picture
    bead = float(np.linalg.norm(b, axis=1).mean())
    scale = look.zoom * look.size / 0.66
    back = about_z(-turn)
    flat = (seen @ back.T)[:, :2] * (scale, -scale) + look.size / 2 + (look.right, look.down)
    off = np.linalg.norm(answers.line[:, :2] - flat, axis=1)
    if (
        off.max() > 0.9 * bead * scale + 0.2
        or np.abs(answers.line[:, 2] - seen[:, 2]).max() > 0.9 * bead
    ):
        wrong.append(f"line {off.max():.1f}")
    # mask and strands, against a line drawn through it by OpenCV
    canvas = np.full((look.size, look.size), 255, np.uint8)
    corners = np.rint((answers.line[:, :2] - 0.5) * 64).astype(np.int32)
    cv2.polylines(canvas, [corners], True, 0, 1, cv2.LINE_8, 6)
    far = cv2.distanceTransform(canvas, cv2.DIST_L2, 5)
    mask = answers.strands > 0
    radius = 0.005 * look.width * scale
    bow = 0.12 * bead * scale  # of the smooth line between beads
    if far[mask].max() > radius + 1.5 + bow or (
        not look.occluders and far[~mask].min() < radius - 1.5 - bow
    ):
        wrong.append("mask")
    edges = 2 * len(found)
    order = [k for _, k in visits]
    for k, (x, y) in enumerate(answers.pixels.tolist(), 1):
        into = order.index(k) + 1  # the edge that leads to the over visit
        if answers.strands[int(y), int(x)] not in (into, into % edges + 1):
            wrong.append("order")
        a_, b_, c_, d_ = json.loads(pd_text(answers.crossings.code))[k - 1]
        under = order.index(-k) + 1
        if (a_, c_) != (under, under % edges + 1) or {b_, d_} != {into, into % edges + 1}:
            wrong.append("pd")
    return wrong


@pytest.mark.parametrize("size", [128, 256, pytest.param(512, marks=pytest.mark.slow)])
def test_answers_are_those_of_an_outside_computation(size: int) -> None:
    wrong, crossings, spent, some = Counter[str](), 0, 0.0, photos(PHOTOS, size, size)
    for _ in range(PHOTOS):
        start = time.process_time()
        points, shot = next(some)
        spent += time.process_time() - start
        wrong.update(faults(points, shot))
        crossings += shot.crossings.nx
    speed = f"{PHOTOS / spent:.0f} with answers a CPU second"
    print(f"{size} pixels: {PHOTOS} photos, {crossings} crossings; {speed}")
    assert not wrong


def test_a_photo_is_taken_again_from_points_and_appearance() -> None:
    for _, shot in photos(6, 128, 5):
        again = take(shot.points, shot.look)
        assert np.array_equal(again.image, shot.image)
        assert np.array_equal(again.strands, shot.strands)
        for name in ("contrast", "order", "region"):
            assert getattr(again, name) == getattr(shot, name)


def test_no_camera_shows_two_strands_that_lie_on_each_other() -> None:
    there = np.column_stack([np.linspace(0, 0.3, 50), np.zeros((50, 2))])
    back = there[::-1] + (0, 0.003, 0.002)
    assert photograph(np.concatenate([there, back]), 128, np.random.default_rng(0)) is None


def test_a_plain_loop_is_one_strand() -> None:
    loop = read_states(shipped(), images=False).points[0]
    shot = photograph(loop, 128, np.random.default_rng(0))
    assert shot is not None and [one["strand"] for one in shot.columns["boxes"]] == [1]


def left_over(shot: Shot) -> RopesCode:
    """Return the code of what cuts and the picture's edge leave of a rope, from its closed code."""
    n, fine, look = len(shot.line), 16, shot.look
    ring = np.concatenate([shot.line, shot.line[:1]])[:, :2]
    places = np.arange(n * fine) / fine
    at = np.stack([np.interp(places, np.arange(n + 1), ring[:, k]) for k in (0, 1)], axis=1)
    seen = ((at >= 0) & (at < look.size)).all(axis=1)
    for begin, end in zip(look.cuts[::2], look.cuts[1::2], strict=True):
        seen &= (places / n - begin) % 1 >= end - begin
    both = zip(shot.crossings.over_place, shot.crossings.under_place, strict=True)
    visits = [
        (int(place * fine), k, sign) for k, pair in enumerate(both)
        if all(seen[int(place * fine)] for place in pair)
        for place, sign in zip(pair, "+-", strict=True)
    ]  # fmt: skip
    if seen.all():
        return RopesCode.of(shot.crossings.code.plain)
    start, texts, names = int(np.argmin(seen)), [""], dict[int, int]()
    for k in (start + 1 + np.arange(len(seen))) % len(seen):
        if not seen[k] and seen[k - 1]:
            texts.append("")
        for _, crossing, sign in (visit for visit in sorted(visits) if visit[0] == k):
            texts[-1] += f"{names.setdefault(crossing, len(names) + 1)}{sign},"
    return RopesCode.parse(";".join(one.strip(",") for one in texts[:-1]), closed=False)


def test_a_photo_of_cut_ropes_has_the_code_of_what_is_left() -> None:
    states, rng, kinds = (
        read_states(shipped("bench"), images=False),
        np.random.default_rng(3),
        set(),
    )
    for row in rng.choice(np.flatnonzero(states.nx > 2), 3 * PHOTOS).tolist():
        config = AppearanceConfig(look="phone", ropes=(1, 2, 3), cropped=0.5)
        shot = photograph(states.points[row], 256, rng, config=config)
        if shot is not None:
            wanted = left_over(shot).smallest(ordered=False)
            assert shot.code.plain.smallest(ordered=False) == wanted
            assert len(shot.pixels) == shot.code.nx
            assert np.array_equal(take(shot.points, shot.look).image, shot.image)
            kinds.add((len(shot.ropes), shot.code.nx > 1))
    assert len(kinds) > 4


def test_things_on_the_rope_cover_straight_pieces_of_single_strands_and_no_tape() -> None:
    found = 0
    for _, shot in photos(8, 128, 4):
        bare = take(shot.points, replace(shot.look, occluders=0))
        line = bare.line[:, :2]
        along = line - np.roll(line, 1, axis=0)
        for seed in range(5):
            laid = take(shot.points, replace(shot.look, occluders=2, marked=True, seed=seed))
            count, parts = cv2.connectedComponents((bare.strands != laid.strands).view(np.uint8))
            assert count <= 3
            found += count - 1
            for part in range(1, count):
                x, y = line.T.astype(int)
                covered = np.flatnonzero(parts[y, x] == part)
                assert np.ptp(covered) < 9 and 2 < covered.min(), covered
                first, last = along[covered[[0, -1]]]
                assert first @ last > 0.7 * np.linalg.norm(first) * np.linalg.norm(last)
    assert found > 12


def test_pieces_of_other_ropes_touch_nothing() -> None:
    ((_, shot),) = photos(1, 512, 0)
    look = replace(shot.look, others=0, occluders=0, noise=0.0, blur=0.0, jpeg=100, shadow=0.0)
    bare, crowded = take(shot.points, look), take(shot.points, replace(look, others=6))
    changed = np.argwhere((bare.image != crowded.image).any(axis=2))[::5, ::-1]
    away = np.linalg.norm(changed[:, None] - bare.line[None, :, :2], axis=2).min(axis=1)
    assert len(away) > 100 and away.min() > look.radius + 12  # px, of 18 from axis to surface
