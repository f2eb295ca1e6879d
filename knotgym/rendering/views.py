"""The views of a rope that a picture can show, and the settings of pictures that go with them."""

from __future__ import annotations

from collections.abc import Sequence

from knotgym.common.errors import KnotgymError

VIEWS = ("top", "left", "front")  # see `rendering.camera`


def checked_views(views: Sequence[str], error: type[KnotgymError]) -> tuple[str, ...]:
    """Views as a tuple (JSON has lists); raise error unless each is of VIEWS and named once."""
    named = tuple(views) if isinstance(views, (tuple, list)) else ()
    if not named or any(view not in VIEWS for view in named) or len({*named}) < len(named):
        raise error(
            f"views must be a list of {', '.join(VIEWS)}, each at most once, one at least; got"
            f" {views!r}"
        )
    return named


def check_depth(depth: object, renderer: str, error: type[KnotgymError]) -> None:
    """Raise error unless depth is a bool, and drawn by a renderer that draws it."""
    if not isinstance(depth, bool):
        raise error(f"depth must be true or false, got {depth!r}")
    if depth and renderer == "mujoco":
        raise error("depth is drawn by renderer 'opencv' (or 'auto', the same), not by 'mujoco'")
