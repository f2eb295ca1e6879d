"""Pictures of strangers: turned as they were held, bounded, and refused in one line."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from knotgym.common import InvalidFile
from knotgym.photos import is_picture, open_picture

LEFT = np.zeros((4, 6, 3), np.uint8)
LEFT[:, 0] = 250  # white on the left


def test_a_photo_is_turned_as_its_camera_was_held(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # the first row is the right side
    Image.fromarray(LEFT).save(tmp_path / "held.png", exif=exif)
    seen = open_picture(tmp_path / "held.png")
    assert seen.shape == (6, 4, 3) and (seen[0] == 250).all() and not seen[1:].any()


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "1", "CMYK", "I;16", "F"])
def test_pictures_of_any_kind_are_read_in_three_colours(mode: str, tmp_path: Path) -> None:
    path = tmp_path / ("one.png" if mode not in ("CMYK", "F") else "one.tiff")
    grey = LEFT[..., 0]
    if mode == "I;16":
        Image.fromarray(grey.astype(np.uint16) * 200).save(path)
    else:
        Image.fromarray(LEFT).convert("L" if mode == "F" else "RGB").convert(mode).save(path)
    seen = open_picture(path)
    assert seen.shape == LEFT.shape and seen.dtype == np.uint8
    assert seen[:, 0].min() > 240 and seen[:, 1:].max() < 10


def huge() -> bytes:
    """Return a PNG file of 50,000 x 50,000 pixels that never come."""
    found = b"\x89PNG\r\n\x1a\n"
    size = struct.pack(">IIBBBBB", 50_000, 50_000, 8, 2, 0, 0, 0)
    for chunk in (b"IHDR" + size, b"IDAT"):
        check = struct.pack(">I", zlib.crc32(chunk))
        found += struct.pack(">I", len(chunk) - 4) + chunk + check
    return found


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.png", huge(), "pixels"),
        ("a.jpg", b"no picture", "isn't a picture that can be read"),
        ("a.eps", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "isn't a picture"),
        ("a.png", None, "no picture"),
    ],
)
def test_what_is_no_picture_is_refused_in_a_line(
    name: str, content: bytes | None, said: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InvalidFile, match=said) as caught:
        open_picture(path)
    assert "\n" not in str(caught.value)
    assert is_picture(path) == (path.suffix != ".eps")


def test_a_truncated_photo_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.jpg"
    Image.fromarray(np.random.default_rng(0).integers(255, size=(64, 64, 3), dtype=np.uint8)).save(
        path
    )
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(InvalidFile, match="truncated"):
        open_picture(path)
