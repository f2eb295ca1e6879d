"""Check of pictures against crossings: which strand a picture shows on top at each crossing."""

import math

import numpy as np
from numpy.typing import NDArray

from knotgym.rendering import PictureConfig, bead_colours, project
from knotgym.topology import Crossings

_WINDOW = 2.0  # beads along the rope, either way, that count as the same strand
# RGB levels (Euclidean) below which two colours are too similar to tell apart; beads 1, 2, 3 apart
# along a rope of 100 differ by 10, 20, 29
_COLOUR_GAP = 25.0


def shown_strands(
    image: NDArray[np.uint8],
    crossings: Crossings,
    points: NDArray[np.float64],
    config: PictureConfig,
) -> NDArray[np.str_]:
    """Find the strand that a picture shows on top at each crossing.

    The colour of the pixel at the crossing is compared with the colours of the two beads that cross
    and of their neighbours along the rope. Blends of two neighbours count as well, because a pixel
    can straddle a joint. The strand with the nearer colour is the one shown. In a picture of 64
    pixels a pixel is as wide as the rope, so that the over strand need not fill a crossing's pixel.

    Args:
        image: uint8, drawn from points with config, orthographic; only its top view is used.
        crossings: the crossings of points.
        points: float64, shape (beads, 3), metres.
        config: settings that the image was drawn with.

    Returns:
        str, shape (n,): "over" (the picture is right), "under" (it is wrong), or "ambiguous" if
        the pixel is outside the picture; if the two beads' colours are too similar; or if a third
        strand above the over strand may cover the pixel, because its axis comes within the drawn
        radius and half a pixel's diagonal of the crossing.
    """
    first = config.size * config.views.index("top")
    image = image[first : first + config.size, :, :3]
    pixel = 1.0 / config.pixels_per_metre
    palette = bead_colours(len(points)).astype(np.float64)
    reach = config.drawn_radius + math.sqrt(0.5) * pixel
    shown = np.full(len(crossings.position), "ambiguous", dtype="<U9")
    pixels = np.floor(project(crossings.over_points, config, points.mean(axis=0))).astype(int)
    for k, (column, row) in enumerate(pixels):
        over = float(crossings.over_place[k]) % len(points)
        under = float(crossings.under_place[k]) % len(points)
        if not (0 <= row < config.size and 0 <= column < config.size):
            continue
        if np.linalg.norm(palette[int(over)] - palette[int(under)]) < _COLOUR_GAP:
            continue
        third = _third_strand_height(points, crossings.position[k], (over, under), reach)
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
) -> float:
    """Return the greatest height of another strand within reach of a position; -inf if none.

    Stretches of the rope within _WINDOW of the two crossing strands are left out.

    Args:
        points: float64 (beads, 3), metres.
        position: float64 (2,), the crossing, metres.
        own: positions of the two crossing strands along the rope, beads.
        reach: distance in the picture, metres.
    """
    beads = len(points)
    # four samples per bead; distances along the rope are cyclic
    fraction = np.linspace(0.0, 1.0, 5)[:-1]
    along = (np.arange(beads)[:, None] + fraction).ravel()
    away = np.min([np.abs((along - one + beads / 2) % beads - beads / 2) for one in own], axis=0)
    samples = (
        points[:, None] + fraction[:, None] * (np.roll(points, -1, axis=0) - points)[:, None]
    ).reshape(-1, 3)
    near = (np.hypot(*(samples[:, :2] - position).T) < reach) & (away > _WINDOW)
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
