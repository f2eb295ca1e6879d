"""What follows from a configuration: the columns of its row, computed and compared.

Whoever makes a row computes them here, and `verify` computes them again from the stored points.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.quality import measure, noise_survival
from knotgym.rendering import draw, picture_of
from knotgym.rope import Rope
from knotgym.topology import dt_text, find_crossings, knot_type, pd_text, pyknotid_code

# tolerance of a measure, relative to 1 + its modulus: other processors round differently
_ROUNDING = 1e-9


def derived_row(points: ArrayLike) -> dict[str, Any]:
    """Compute the columns of a row that follow from its points, float64 (beads, 3), metres.

    Returns:
        Values by the column's name in `schema.STATES`: codes, knot, nx, quality, and image.
    """
    p = np.asarray(points, dtype=np.float64)
    crossings = find_crossings(p)
    code = crossings.code
    quality = {**asdict(measure(p, crossings)), "noise_survival": noise_survival(p)}
    return {
        "gauss_code": str(code),
        "gauss_code_chiral": code.chiral,
        "pd_code": pd_text(code),
        "dt_code": dt_text(code),
        "nx": code.nx,
        "knot": knot_type(code),
        **{f"quality/{name}": value for name, value in quality.items()},
        "image": draw(p, picture_of(len(p))),
    }


def row_faults(
    stored: Mapping[str, Any],
    rope: Rope,
    derive: Callable[[NDArray[np.float64]], Mapping[str, Any]] = derived_row,
) -> Iterator[str]:
    """Yield how a row differs from what follows from its points, and from the second labeller.

    Args:
        stored: values by column name, `points` among them; columns that are missing aren't checked.
        rope: the rope; what is wider than it is long can't be measured.
        derive: points -> the columns that follow from them.
    """
    points = stored["points"]
    across = float(np.ptp(points, axis=0).max())
    if not across <= rope.config.length:
        yield f"points are {across:.3g} m apart, the rope is {rope.config.length:g} m long"
        return
    for name, right in derive(points).items():
        yield from _unlike(name, stored.get(name, right), right)
    code, second = find_crossings(points).code, pyknotid_code(points)
    if second != code:
        yield f"pyknotid reads {second.chiral}, our labeller reads {code.chiral}"


def _unlike(name: str, found: Any, right: Any) -> Iterator[str]:
    """Yield how a value differs from the right one; numbers may differ by rounding."""
    if isinstance(right, dict):
        for inner, one in right.items():
            yield from _unlike(f"{name}.{inner}", found[inner], one)
    elif isinstance(right, (bytes, np.ndarray)):
        same = found == right if isinstance(right, bytes) else np.array_equal(found, right)
        if not same:
            yield f"{name} is not the picture of points"
    elif isinstance(right, float):
        if found != right and not abs(found - right) <= _ROUNDING * (1 + abs(right)):
            yield f"{name} is {found}, recomputed {right}"
    elif found != right:
        yield f"{name} is {found}, recomputed {right}"
