"""Camera and colours of pictures, and the projection of points to pixels.

The camera looks straight at the rope's centre of mass, from the top, the left or the front:

    view     camera at    image right    image up
    top      +z           +x             +y
    left     -x           -y             +z
    front    -y           +x             +z

Every view is drawn as the top view of a rotated rope (`seen_from`), so the rest of this module
deals with the top view only. Pixel coordinates are continuous, x to the right and y down: pixel
(row, column) covers [column, column + 1) x [row, row + 1); its centre is (column + 0.5, row + 0.5).
Source: arXiv 2505.18028 (camera of the top view, colours).

After a change run `pytest tests/rendering/test_picture.py`: the perspective camera must be the
published one, and beads be drawn where they are projected.
"""

import math
from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, PositiveFloat

from knotgym.common import Array, InvalidInput, choice, configuration

RGB = tuple[int, int, int]
Level = Annotated[int, Field(ge=0, le=255)]
Colour = tuple[Level, Level, Level]  # an RGB in a configuration

# Each is a rotation (determinant +1): a reflection would exchange the signs of all crossings.
# view -> world axes that point right, up and towards the camera, and their signs
_AXES = {
    "top": ((0, 1, 2), (1.0, 1.0, 1.0)),
    "left": ((1, 2, 0), (-1.0, 1.0, -1.0)),
    "front": ((0, 2, 1), (1.0, 1.0, -1.0)),
}
NEAR = 0.01  # near plane of cameras whose rays aren't parallel, metres
USUAL_BEADS = 100  # of the rope that `PictureConfig.view` shows whole


def _known(views: tuple[str, ...]) -> tuple[str, ...]:
    if not views or not set(views) <= set(_AXES) or len(set(views)) < len(views):
        raise InvalidInput(f"must be a list of {', '.join(_AXES)}, at least one, each at most once")
    return views


class Camera(NamedTuple):
    """How a picture is projected.

    Attributes:
        says: what it is, for help.
        fovy: field of view, degrees; None for parallel rays.
    """

    says: str
    fovy: float | None


# Every picture, environment and renderer knows a camera by its record here.
CAMERAS = {
    "orthographic": Camera("parallel rays: the top view shows the crossings of the code", None),
    "perspective": Camera("published", 45.0),
}


def _camera_help() -> str:
    """Return the help of a setting that names a camera."""
    return f"{', '.join(f'{name} ({value.says})' for name, value in CAMERAS.items())}."


CameraName = Annotated[str, choice(growing=CAMERAS, help=_camera_help)]
Views = Annotated[tuple[str, ...], AfterValidator(_known)]  # in a configuration


def require(met: bool, rule: str, given: object) -> None:
    """Raise InvalidInput, with the rule and the given value, unless the rule is met."""
    if not met:
        raise InvalidInput(f"{rule}, got {given!r}")


@configuration
class PictureConfig:
    """Settings of a picture; with the points they determine every byte of it.

    Attributes:
        size: side of each view, pixels, 16 to 4096.
        views: "top", "left" and "front", each at most once; stacked vertically in the picture.
        depth: whether to add a depth channel: 0 for background, else 1 to 255, larger values
            nearer to the camera. 128 is the rope's centre of mass; one level is view / 254,
            2.6 mm. Depths more than view / 2 from the centre are clipped.
        view: side of the square that the orthographic picture shows, metres.
        camera: one of CAMERAS.
        camera_height: distance of a camera whose rays aren't parallel from the centre of mass,
            metres.
        turn: rotation of the camera about its line of sight, radians, anticlockwise seen from
            behind it; the rope appears rotated the other way.
        zoom: magnification about the picture's centre.
        rope_radius: radius of the rope, metres.
        width: factor on the rope's radius, in the picture only.
        background: RGB.
        renderer: "opencv" (needs no GL), "mujoco" (the same picture by OpenGL, without depth), or
            "auto", the same as "opencv".

    Raises:
        InvalidInput: a value is out of range.
    """

    size: Annotated[int, Field(ge=16, le=4096)] = 128
    views: Views = ("top",)
    depth: bool = False
    view: PositiveFloat = 0.66
    camera: CameraName = "orthographic"
    camera_height: PositiveFloat = 0.8
    turn: float = 0.0
    zoom: PositiveFloat = 1.0
    rope_radius: PositiveFloat = 0.005
    width: PositiveFloat = 1.0
    background: Colour = (0, 0, 0)
    renderer: Literal["auto", "opencv", "mujoco"] = "auto"

    def __post_init__(self) -> None:
        if self.depth and self.renderer == "mujoco":
            raise InvalidInput("depth needs renderer 'opencv' or 'auto'; 'mujoco' doesn't draw it")

    @staticmethod
    @lru_cache(maxsize=64)
    def of(beads: int, **settings: Any) -> "PictureConfig":
        """Return the usual picture of a rope of so many beads; of 200 it shows 1.32 m, not 0.66."""
        share = beads / USUAL_BEADS
        view, height = share * DEFAULT.view, share * DEFAULT.camera_height
        return PictureConfig(view=view, camera_height=height, **settings)

    @property
    def fovy(self) -> float | None:
        """Field of view of the camera, degrees; None for parallel rays."""
        return CAMERAS[self.camera].fovy

    @property
    def pixels_per_metre(self) -> float:
        """Scale of the picture; in perspective, at the height of the centre of mass."""
        if self.fovy is None:
            return self.zoom * self.size / self.view
        # pictures are square, so one angle holds for both axes
        visible = 2.0 * self.camera_height * math.tan(math.radians(self.fovy) / 2.0)  # metres
        return self.zoom * self.size / visible

    @property
    def channels(self) -> int:
        """3, or 4 with depth."""
        return 3 + self.depth

    @property
    def drawn_radius(self) -> float:
        """Radius of the rope as drawn, metres."""
        return self.rope_radius * self.width


DEFAULT = PictureConfig()


def bead_colours(beads: int) -> NDArray[np.uint8]:
    """Return the published colours: a colour circle along the rope, with a white base bead.

    Returns:
        uint8, shape (beads, 3), RGB: 255 (0.5 + 0.5 sin(2 pi (i / beads + (0, 0.33, 0.67)))),
        rounded.

    >>> bead_colours(100)[[0, 25]].tolist()  # the base bead; red, a quarter of the way along
    [[255, 255, 255], [255, 66, 66]]
    """
    phase = np.arange(beads)[:, None] / beads
    wave = 0.5 + 0.5 * np.sin(2.0 * np.pi * (phase + np.array([0.0, 0.33, 0.67])))
    colours: NDArray[np.uint8] = np.rint(255.0 * wave).astype(np.uint8)
    # where the code begins; the circle of colours has no beginning of its own
    colours[:1] = 255
    return colours


def seen_from(view: str, points: Array) -> Array:
    """Rotate points (n, 3) so that their top view is `view`; "top" returns the same array.

    >>> seen_from("left", np.array([[1.0, 2.0, 3.0]])).tolist()
    [[-2.0, 3.0, -1.0]]
    """
    axes, signs = _AXES[view]
    return points if view == "top" else np.ascontiguousarray(points[..., axes] * np.array(signs))


def project(
    points: ArrayLike, config: PictureConfig = DEFAULT, center: ArrayLike | None = None
) -> Array:
    """Project points of the world into the top view.

    Args:
        points: float, shape (n, 3), metres, world frame.
        center: shape (3,), metres: the world point in the middle of the picture; by default the
            mean of the points. If the points aren't the whole rope, pass the rope's mean.

    Returns:
        float64, shape (n, 2): pixel coordinates (x right, y down; see the module), which may be
        outside the view. They are NaN for points behind the perspective camera or less than 1 cm
        in front of it.
    """
    points = np.asarray(points, dtype=np.float64)
    return np.ascontiguousarray(in_picture(points, config, center)[0][..., :2])


def in_picture(
    points: Array, config: PictureConfig, center: ArrayLike | None = None
) -> tuple[Array, tuple[float, float]]:
    """Project ropes (..., beads, 3), metres, for `picture.paint`; see `project`.

    Returns:
        float64 (..., beads, 4): pixel coordinates, height and radius of the rope, pixels; and the
        height of the centre of mass with the range of heights that a picture's depth shows. In
        perspective, heights are the negative distance to the camera at the scale of the centre.
    """
    middle = points.mean(axis=-2, keepdims=True) if center is None else np.asarray(center)
    offset, at_centre, central = points - middle, config.pixels_per_metre, 0.0
    right, up, height = offset[..., 0], offset[..., 1], offset[..., 2]
    # The camera turns anticlockwise, so the picture turns the other way: a rotation by -turn.
    if config.turn != 0.0:
        cos, sin = math.cos(config.turn), math.sin(config.turn)
        right, up = cos * right + sin * up, cos * up - sin * right
    scale = np.full(height.shape, at_centre)
    if config.fovy is not None:
        # Similar triangles: at half the centre's distance from the camera the scale is twice that.
        # Each vertex has a radius of its own, as perspective widens what is near.
        away = config.camera_height - height
        scale = at_centre * config.camera_height / np.where(away > NEAR, away, np.nan)
        # negative, so that nearer is higher under both cameras
        height = -np.linalg.norm(offset - np.array([0.0, 0.0, config.camera_height]), axis=-1)
        central = -config.camera_height
    x, y = 0.5 * config.size + scale * right, 0.5 * config.size - scale * up
    ropes = np.stack([x, y, at_centre * height, config.drawn_radius * scale], axis=-1)
    return ropes, (at_centre * central, at_centre * config.view)


def checked_points(points: ArrayLike, *axes: int) -> Array:
    """Return one rope (2 axes) or many (3) to draw as float64, or raise InvalidInput.

    They are rounded to float32, as datasets hold them, so that a rope and what was stored of it
    have the same picture.
    """
    from knotgym.topology import same_spot  # here, since help needs the cameras and no numba

    with np.errstate(over="ignore"):  # what float32 can't hold is refused below
        points = np.asarray(points, dtype=np.float32).astype(np.float64)
    forms = " or ".join("(beads, 3)" if count == 2 else "(m, beads, 3)" for count in axes)
    fits = points.ndim in axes and points.shape[-1] == 3 and points.shape[-2] >= 3
    require(fits, f"points must have shape {forms}, at least 3 beads", points.shape)
    bad = int((~np.isfinite(points)).sum())
    if bad:
        raise InvalidInput(f"points must be finite, got {bad} coordinates that are not")
    if (again := same_spot(points)).any():
        raise InvalidInput(
            f"point {int(again.nonzero()[-1][0])} and the next are on one spot; leave out points"
            " that are repeated, the first at the end, too"
        )
    return points
