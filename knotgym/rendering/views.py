"""Types of the settings `views` and `depth`, shared by pictures and tasks."""

from typing import Annotated

from pydantic import AfterValidator

from knotgym.common.configuration import ListToo
from knotgym.common.errors import InvalidInput

VIEWS = ("top", "left", "front")  # see `rendering.camera`


def _known(views: tuple[str, ...]) -> tuple[str, ...]:
    if not views or not set(views) <= set(VIEWS) or len(set(views)) < len(views):
        raise InvalidInput(f"must be a list of {', '.join(VIEWS)}, at least one, each at most once")
    return views


Views = Annotated[tuple[str, ...], ListToo, AfterValidator(_known)]


def require_depth(depth: bool, renderer: str) -> None:
    """Raise InvalidInput if the renderer can't draw depth and should."""
    if depth and renderer == "mujoco":
        raise InvalidInput("depth needs renderer 'opencv' or 'auto'; 'mujoco' doesn't draw it")
