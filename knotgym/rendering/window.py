"""Window of `render_mode="human"`: the rope beside its goal, as in videos, shown by pygame."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Failed
from knotgym.rendering.video import film_frame, film_side

Array = NDArray[np.float64]


class PictureWindow:
    """A window that opens with the first frame and doesn't zoom in during an episode.

    Raises:
        Failed: pygame isn't installed; from `show`, there is no display.
    """

    def __init__(self, frames_per_second: int) -> None:
        try:
            import pygame
        except ModuleNotFoundError as error:
            raise Failed(
                "render_mode 'human' needs pygame, which isn't installed: pip install pygame"
            ) from error
        self._pygame: Any = pygame
        self._rate, self._side = frames_per_second, 0.0
        self._screen: Any = None
        self._clock: Any = None

    def show(
        self,
        points: Array,
        goal: Array,
        step: int,
        horizon: int,
        outcome: str,
        views: Sequence[str],
    ) -> None:
        """Draw a state beside its goal, and wait to keep the frame rate.

        Args:
            points, goal: float64 (beads, 3), metres.
            step: actions taken in the episode; 0 starts a new episode.
            horizon: length of the episode.
            outcome, views: as in `film_frame`.
        """
        needed = film_side([points, goal], views)
        self._side = max(needed, self._side if step else 0.0)
        heading = f"step {step} of {horizon}"
        frame = film_frame(points, goal, heading, None, outcome, views, self._side)
        if self._screen is None:
            self._open(frame.shape[1::-1])
        picture = self._pygame.surfarray.make_surface(frame.swapaxes(0, 1))
        self._screen.blit(picture, (0, 0))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(self._rate)

    def close(self) -> None:
        """Close the window; a later frame opens a new one."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None

    def _open(self, size: tuple[int, int]) -> None:
        # A window that SDL fills by OpenGL holds this thread's context: beside it MuJoCo's renderer
        # could make none by EGL, and would crash by OSMesa.
        os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
        try:
            self._pygame.display.init()
            self._screen = self._pygame.display.set_mode(size)
        except self._pygame.error as error:
            raise Failed(
                f"render_mode 'human' needs a display ({error}); use 'rgb_array' without one"
            ) from error
        self._pygame.display.set_caption("knotgym")
        self._clock = self._pygame.time.Clock()
