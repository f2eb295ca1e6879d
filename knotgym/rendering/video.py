"""Videos of a rope with its code under the picture, as mp4 or gif."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from knotgym.atomic_files import atomic_write
from knotgym.errors import KnotgymError

FRAMES_PER_SECOND = 5  # an action lasts 0.192 s
_TEXT = 18  # pixels a line of caption
_FONT, _LETTERS, _WHITE = cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225)


class UnknownFilm(KnotgymError, ValueError):
    """A kind of video that can't be written."""


def captioned(frame: NDArray[np.uint8], lines: Sequence[str], scale: int = 3) -> NDArray[np.uint8]:
    """Enlarge a picture, uint8 (height, width, 3), and write lines of text below it."""
    large = np.repeat(np.repeat(frame, scale, axis=0), scale, axis=1)
    high, wide = large.shape[:2]
    # an even height in all, as mp4 wants it
    below = np.zeros((_TEXT * len(lines) + 8 + (high + _TEXT * len(lines)) % 2, wide, 3), np.uint8)
    for number, line in enumerate(lines):
        wide_at_full = cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0]
        letters = min(_LETTERS, _LETTERS * (wide - 12) / max(1, wide_at_full))
        at = (6, _TEXT * (number + 1) - 2)
        cv2.putText(below, line, at, _FONT, letters, _WHITE, 1, cv2.LINE_AA)
    return np.concatenate([large, below])


def write_film(path: str | os.PathLike[str], frames: Sequence[NDArray[np.uint8]]) -> None:
    """Write frames of one size, RGB, as .gif or .mp4; the file appears whole or not at all.

    Raises:
        UnknownFilm: another ending, or no encoder on this machine.
    """
    kind = Path(path).suffix.lower()
    if kind not in (".gif", ".mp4"):
        raise UnknownFilm(f"a video ends in .gif or .mp4, got {os.fspath(path)!r}")
    with atomic_write(path) as temporary:
        if kind == ".gif":
            images = [Image.fromarray(frame) for frame in frames]
            images[0].save(
                temporary,
                save_all=True,
                append_images=images[1:],
                duration=1000 // FRAMES_PER_SECOND,
                loop=0,
            )
            return
        height, width = frames[0].shape[:2]
        writer = cv2.VideoWriter(
            str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_SECOND, (width, height)
        )
        if not writer.isOpened():
            raise UnknownFilm("this build of OpenCV has no mp4 encoder; write a .gif")
        for frame in frames:
            writer.write(frame[..., ::-1])
        writer.release()
