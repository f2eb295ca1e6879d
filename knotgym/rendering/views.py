"""Validation of the settings `views` and `depth`, shared by pictures and tasks."""

from collections.abc import Sequence

from knotgym.common.errors import KnotgymError

VIEWS = ("top", "left", "front")  # see `rendering.camera`


def checked_views(views: Sequence[str], error: type[KnotgymError]) -> tuple[str, ...]:
    """Return views as a tuple (JSON has lists); raise error unless they are unique VIEWS."""
    named = tuple(views) if isinstance(views, (tuple, list)) else ()
    if not named or any(view not in VIEWS for view in named) or len({*named}) < len(named):
        raise error(
            f"views must be a list of {', '.join(VIEWS)}, at least one, each at most once; got"
            f" {views!r}"
        )
    return named


def check_depth(depth: object, renderer: str, error: type[KnotgymError]) -> None:
    """Raise error unless depth is a bool and the renderer supports it."""
    if not isinstance(depth, bool):
        raise error(f"depth must be true or false, got {depth!r}")
    if depth and renderer == "mujoco":
        raise error("depth needs renderer 'opencv' or 'auto'; 'mujoco' doesn't draw it")
