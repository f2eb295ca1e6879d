"""Pictures of the rope as a camera shows it: one colour, on a table, with the answers.

`photograph` tilts the rope as a camera would see it and draws an appearance from a generator until
a person can decide every crossing (`LIMITS`); `take` makes the same picture again from the points
and the appearance. The camera is orthographic. From `tilted` on, points are in its axes: x right, y
up, z towards the camera. The Gauss code, the crossings and all answers are what it sees.

After a change run `PHOTOS=2000 pytest tests/photos/test_photo.py`: no answer may differ from
those of an outside computation.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, InvalidInput, Stream
from knotgym.photos import view_kernels
from knotgym.photos.photo_look import DEFAULT, LOOKS, Photo, Rng, drawn_look
from knotgym.photos.photo_painting import PhotoRope, PhotoView, Shot, ground_of, is_clear, painted
from knotgym.rendering import AppearanceConfig, Drawer, Drawn, checked_points
from knotgym.topology import Crossings

_CONFIG = AppearanceConfig()
TILT = _CONFIG.tilt  # largest tilt of the camera, degrees
_TRIES = 12  # cameras
_SQUEEZE = (0.3, 1.0)  # of ropes, which flattens crossings
_CROP = 2.2  # share of the side of a picture that a rope which it cuts fills, at most
Camera = tuple[float, float]  # tilt and heading, degrees


class PhotoDrawer(Drawer):
    """Draws photos, with the answers as columns of their own."""

    look, structs = Photo, ("photo", "phone")

    def seen(self, points: Array, config: AppearanceConfig, rng: Rng) -> tuple[Array, Camera]:
        camera = _drawn_camera(rng, config.tilt)
        return tilted(points, *camera), camera

    def image(self, points: Array, look: Any) -> NDArray[np.uint8]:
        return take(points, look).image

    def drawn(self, points: Array, look: Any, crossings: Crossings | None = None) -> Drawn:
        return _taken(PhotoRope(points, look.size, crossings), look)

    def sampled(
        self,
        points: Array,
        config: AppearanceConfig,
        rng: Rng,
        camera: Camera = (0.0, 0.0),
        crossings: Crossings | None = None,
    ) -> Drawn:
        side = config.sides[int(rng.integers(len(config.sides)))]
        rope = PhotoRope(points, side, crossings)
        marked = bool(rng.random() < config.marked)
        for attempt in range(_TRIES):
            # a crossing may hide the base from here; then, after half of the tries, there is no
            # tape
            if shot := _drawn(rope, rng, camera, marked and attempt < _TRIES // 2, config):
                return shot
        # `legible` has shown that this one can be read
        return _taken(rope, replace(_clearest(rope, camera), look=config.look))

    def for_episode(self, points: Array, size: int, goal: int) -> Photo:
        # The camera is vertical and tape marks the base, so that picture and code agree. The scale
        # is that of `PictureConfig`, the rope as thick as it is, and nothing lies on it.
        rng = Stream.EPISODE_LOOK.generator(0, goal)
        look = replace(drawn_look(Photo(size=size), rng), marked=True, occluders=0)
        view = PhotoView(PhotoRope(points, size), look)
        view.stamp(look.radius)
        return view.coloured(look, ground_of(look)[0], rng)

    def legible(self, points: Array, size: int, crossings: Crossings | None = None) -> bool:
        # most that are refused show too small a region, which is known before anything is painted
        rope = PhotoRope(points, size, crossings)
        look = _clearest(rope)
        view = PhotoView(rope, look)
        if not view.region(2 * look.radius):
            return False
        view.stamp(look.radius)
        return is_clear(view, look)


def photograph(
    points: Array, size: int, rng: Rng, *, tilt: float = TILT, marked: bool | None = None,
    config: AppearanceConfig = _CONFIG,
) -> Shot | None:  # fmt: skip
    """Draw a camera and an appearance until the picture is legible.

    Args:
        points: float64 (beads, 3), metres.
        size: side of the picture, pixels.
        tilt: largest tilt of the camera, degrees.
        marked: whether tape marks the base; None to draw it.
        config: its look, and the ropes of a look that cuts them.

    Returns:
        None if no camera of several shows a legible picture.

    Raises:
        InvalidInput: points are no closed rope, or the size isn't from 16 to 2048.
    """
    checked_points(points, 2)
    if size not in range(16, 2049):
        raise InvalidInput(f"size must be from 16 to 2048 pixels, got {size!r}")
    points = np.asarray(points, dtype=np.float64)
    for _ in range(_TRIES):
        # from many directions strands touch or fold, whatever the appearance; then another is tried
        camera = _drawn_camera(rng, tilt)
        if shot := _drawn(PhotoRope(tilted(points, *camera), size), rng, camera, marked, config):
            return shot
    return None


def _clearest(rope: PhotoRope, camera: Camera = (0.0, 0.0)) -> Photo:
    """Return the plainest look: a narrow white rope on a dark surface, as large as the picture."""
    (least, most), bright = LOOKS[_CONFIG.look].widths, (235, 230, 220)
    # as narrow as allowed, which leaves most background between strands
    more: dict[str, Any] = {"first": bright, "last": bright}
    return _framed(rope, camera, 0.0, 1.0, (0.0, 0.0), most, least, **more)


def _drawn_camera(rng: Rng, tilt: float = TILT) -> Camera:
    """Draw tilt and heading, degrees, evenly over the directions up to a tilt."""
    # the area of a cap is proportional to its height (Archimedes), so an even cosine is an even
    # direction
    lean = math.degrees(math.acos(rng.uniform(math.cos(math.radians(tilt)), 1.0)))
    return lean, float(rng.uniform(0.0, 360.0))


def tilted(points: Array, tilt: float, heading: float) -> Array:
    """Return points (n, 3) in the axes of a camera that leans by `tilt` towards `heading`.

    >>> tilted(np.array([[0.0, 0.0, 1.0]]), 90.0, 0.0).round(9).tolist()  # seen from the right
    [[-1.0, 0.0, 0.0]]
    """
    angles = [(math.cos(a), math.sin(a)) for a in map(math.radians, (tilt, heading))]
    # a copy, as numba would compile again for what can't be written
    return view_kernels.tilted(np.array(points, np.float64, order="C"), *angles)


def take(points: Array, look: Photo) -> Shot:
    """Take the photo of points (beads, 3) in the camera's axes with an appearance."""
    return _taken(PhotoRope(points, look.size), look)


def _taken(rope: PhotoRope, look: Photo) -> Shot:
    view = PhotoView(rope.cut(look.cuts, look.squeeze), look)
    view.stamp(look.radius)
    return painted(view, look, view.region(2 * look.radius))


def _drawn(
    rope: PhotoRope, rng: Rng, camera: Camera, marked: bool | None, config: AppearanceConfig
) -> Shot | None:
    """Draw frame and appearance of one view; None if it isn't legible."""
    ranges, squeeze = LOOKS[config.look], 1.0
    if not ranges.free and rope.shown.nx > ranges.limits.crossings:
        return None
    cuts: tuple[float, ...] = ()
    turn, fill = rng.uniform(-math.pi, math.pi), rng.uniform(*ranges.fill)
    place, share, (least, most) = rng.uniform(-1.0, 1.0, 2).tolist(), rng.random(), ranges.widths
    widest, room = least + share * (most - least), most
    if ranges.free:
        cuts, marked, unit = _cuts(config, rng), False, rope.size / 256
        squeeze = rng.uniform(*_SQUEEZE)
        rope, least = rope.cut(cuts, squeeze), unit * least
        widest = room = least * (most / ranges.widths[0]) ** share
        if rng.random() < config.cropped:
            fill = rng.uniform(1.05, _CROP)
    named: dict[str, Any] = {"look": config.look, "cuts": cuts, "squeeze": squeeze}
    look = _framed(rope, camera, turn, fill, place, room, **named)
    view = PhotoView(rope, look)
    if len(view.met) > ranges.limits.crossings:
        return None
    # a rope that is illegible at its narrowest isn't looked at any further
    region = view.region(least)
    for width in (widest, max(least, 0.6 * widest), least) if region else ():
        if region := view.region(width):
            break
    if not region:
        return None
    wanted = bool(rng.random() < 0.2) if marked is None else marked
    hidden = view.base_spacing < 1.5 * width
    if marked and hidden:
        return None
    view.stamp(0.5 * width)
    # from pixels to a factor on the width of the real rope
    width /= 2 * DEFAULT.rope_radius * look.scale
    look = replace(look, width=width, marked=wanted and not hidden)
    # another appearance costs less than another camera; of 129 views that came so far 110 were
    # legible with the first, 12 with the second, 5 with the third and 2 with the fourth
    for _ in range(4):
        look = drawn_look(look, rng)
        shot = painted(view, look, region, rng)
        if shot.legible:
            return shot
        # they were stamped beside the rope, and the next appearance has others
        if look.others:
            view.stamp(look.radius)
    return None


def _cuts(config: AppearanceConfig, rng: Rng) -> tuple[float, ...]:
    """Draw the pieces that are missing of a rope: none of a closed one, one for each open rope."""
    count = config.ropes[int(rng.integers(len(config.ropes)))]
    if count == 1 and rng.random() >= config.open:
        return ()
    missing = rng.uniform(0.06, 0.7) if count == 1 else rng.uniform(0.25, 0.6)
    shares = rng.uniform(0.5, 1.5, (2, count))
    shares *= np.array([[missing], [1 - missing]]) / shares.sum(axis=1, keepdims=True)
    ends = rng.random() + np.append(0.0, np.cumsum(shares.T))
    return tuple(ends[: 2 * count].tolist())


def _framed(
    rope: PhotoRope,
    camera: Camera,
    turn: float,
    fill: float,
    place: Sequence[float],
    widest: float,
    width: float | None = None,
    **more: Any,
) -> Photo:
    """Choose zoom and position: the rope fills a share of the picture's side, `place` of the rest.

    Args:
        fill: beyond 1 the picture's edge cuts the rope.
        place: right and down, from -1 to 1.
        widest: the rope may be so wide, px.
        width: of the rope, px; None for its real one.
        more: other fields of the appearance.
    """
    size, (tilt, heading) = rope.size, camera
    sides = rope.extent(turn, size / DEFAULT.view)
    # half of the widest rope is beyond its axis on either side, and a pixel is left to the edge
    room = size - widest - 2.0
    zoom = fill * room / max(high - low for low, high in sides)
    # a share of what is left free, and what brings the middle of the drawing to the picture's
    right, down = (
        0.5 * (room - zoom * (high - low)) * share - 0.5 * zoom * (low + high)
        for share, (low, high) in zip(place, sides, strict=True)
    )
    if width is not None:
        # from pixels to a factor on the width of the real rope
        more["width"] = width / (2 * DEFAULT.rope_radius * (zoom * size / DEFAULT.view))
    frame: dict[str, Any] = {"zoom": zoom, "right": right, "down": down}
    return Photo(size=size, turn=turn, tilt=tilt, heading=heading, **frame, **more)
