"""Check of pictures against crossings: which strand a picture shows on top at each crossing."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidInput
from knotgym.rendering.camera import DEFAULT, PictureConfig, checked_points, rope_colours
from knotgym.rendering.picture import crossing_pixels
from knotgym.topology.crossings import Crossings


def shown_strands(
    image: NDArray[np.uint8],
    crossings: Crossings,
    points: ArrayLike,
    config: PictureConfig = DEFAULT,
    *,
    colours: NDArray[np.uint8] | None = None,
    window: float = 2.0,
    colour_gap: float = 25.0,
) -> NDArray[np.str_]:
    """Find the strand that a picture shows on top at each crossing.

    The colour of the pixel at the crossing is compared with the colours of the two beads that cross
    and of their neighbours along the rope. Blends of two neighbours count as well, because a pixel
    can straddle a joint. The strand with the nearer colour is the one shown.

    Args:
        image: uint8, drawn from points with config and colours, orthographic; only its top view is
            used.
        crossings: the crossings of points.
        points: float64, shape (beads, 3), metres.
        config: settings that the image was drawn with.
        colours: colours that the image was drawn with, uint8 (beads, 3); by default config's.
        window: beads along the rope, either way, that count as the same strand.
        colour_gap: RGB levels (Euclidean) below which two colours are too similar to tell apart;
            beads 1, 2, 3 apart along a published rope of 100 differ by 10, 20, 29.

    Returns:
        str, shape (n,): "over" (the picture is right), "under" (it is wrong), or "ambiguous" if
        the pixel is outside the picture; if the two beads' colours are within colour_gap; or if a
        third strand above the over strand may cover the pixel, because its axis comes within the
        drawn radius and half a pixel's diagonal of the crossing.

    Raises:
        InvalidInput: the camera is not orthographic or there is no top view, so that the picture
            shows other crossings; or pixels are larger than 1.1 drawn radii, so that the over
            strand need not fill most of a crossing's pixel.
    """
    if config.camera != "orthographic":
        raise InvalidInput(
            "only an orthographic picture shows the crossings of the code, got camera"
            f" {config.camera!r}"
        )
    if "top" not in config.views:
        raise InvalidInput(
            "only the top view shows the crossings of the code, got views"
            f" {', '.join(config.views)}"
        )
    first = config.size * config.views.index("top")
    image = image[first : first + config.size, :, :3]
    pixel = 1.0 / config.pixels_per_metre
    if pixel > 1.1 * config.drawn_radius:
        raise InvalidInput(
            f"pixels of {1e3 * pixel:.1f} mm are too coarse to read a rope drawn"
            f" {1e3 * config.drawn_radius:.1f} mm in radius; draw it with size at least"
            f" {math.ceil(config.size * pixel / (1.1 * config.drawn_radius))}"
        )
    points = checked_points(points, 2)
    palette = (rope_colours(len(points), config) if colours is None else colours).astype(np.float64)
    reach = config.drawn_radius + math.sqrt(0.5) * pixel
    shown = np.full(len(crossings.position), "ambiguous", dtype="<U9")
    pixels = np.floor(crossing_pixels(crossings, points, config)).astype(int)
    for k, (column, row) in enumerate(pixels):
        over = float(crossings.over_place[k]) % len(points)
        under = float(crossings.under_place[k]) % len(points)
        if not (0 <= row < config.size and 0 <= column < config.size):
            continue
        if np.linalg.norm(palette[int(over)] - palette[int(under)]) < colour_gap:
            continue
        third = _third_strand_height(points, crossings.position[k], (over, under), reach, window)
        if third > crossings.over_z[k]:
            continue
        seen = image[row, column].astype(np.float64)
        to_over = _distance_to_strand(seen, palette, int(over))
        to_under = _distance_to_strand(seen, palette, int(under))
        shown[k] = "over" if to_over < to_under else "under"
    return shown


def _third_strand_height(
    points: NDArray[np.float64],
    position: NDArray[np.float64],
    own: tuple[float, float],
    reach: float,
    window: float,
) -> float:
    """Return the greatest height of another strand within reach of a position; -inf if none.

    Stretches of the rope within window of the two crossing strands are left out.

    Args:
        points: float64 (beads, 3), metres.
        position: float64 (2,), the crossing, metres.
        own: positions of the two crossing strands along the rope, beads.
        reach: distance in the picture, metres.
        window: distance along the rope, beads.
    """
    beads = len(points)
    # four samples per bead; distances along the rope are cyclic
    fraction = np.linspace(0.0, 1.0, 5)[:-1]
    along = (np.arange(beads)[:, None] + fraction).ravel()
    away = np.min([np.abs((along - one + beads / 2) % beads - beads / 2) for one in own], axis=0)
    samples = (
        points[:, None] + fraction[:, None] * (np.roll(points, -1, axis=0) - points)[:, None]
    ).reshape(-1, 3)
    near = (np.hypot(*(samples[:, :2] - position).T) < reach) & (away > window)
    return float(samples[near, 2].max()) if near.any() else -math.inf


def _distance_to_strand(
    seen: NDArray[np.float64], palette: NDArray[np.float64], bead: int
) -> float:
    """Return the RGB distance of a colour from the path through a bead's and its neighbours'."""
    # distance of a point from two segments in RGB space
    path = palette[np.arange(bead - 1, bead + 2) % len(palette)]
    step = np.diff(path, axis=0)
    fraction = np.clip(
        np.sum((seen - path[:-1]) * step, axis=1) / np.maximum(np.sum(step * step, axis=1), 1e-9),
        0.0,
        1.0,
    )
    return float(np.linalg.norm(seen - path[:-1] - fraction[:, None] * step, axis=1).min())
