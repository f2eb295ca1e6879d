"""Contact sheets."""

import numpy as np

from knotgym.datasets.png import Tile, contact_sheet, decode
from knotgym.rendering import Film


def test_a_contact_sheet_holds_every_picture_unchanged_in_a_frame_of_its_colour() -> None:
    images = np.random.default_rng(0).integers(0, 255, (5, 16, 16, 3), dtype=np.uint8)
    colour = Film.OUTCOMES["failed"]
    tiles = [Tile(image, ("a", "b"), colour) for image in images]
    sheet = decode(contact_sheet(tiles, columns=2))
    assert sheet.shape == (3 * 58, 2 * 28, 3)
    for k, image in enumerate(images):
        top, left = k // 2 * 58 + 6, k % 2 * 28 + 6
        assert np.array_equal(sheet[top : top + 16, left : left + 16], image)
        assert (sheet[top - 1, left : left + 16] == colour).all()
