"""Contact sheets."""

import numpy as np
import pytest

from knotgym.datasets.gallery import Tile, _contact_sheet, _state_tiles
from knotgym.rendering import Film
from knotgym.states import read_states


def test_a_contact_sheet_holds_every_picture_unchanged_in_a_frame_of_its_colour() -> None:
    images = np.random.default_rng(0).integers(0, 255, (5, 16, 16, 3), dtype=np.uint8)
    colour = Film.OUTCOMES["failed"]
    sheet = _contact_sheet([Tile(image, ("a", "b"), colour) for image in images], columns=2)
    assert sheet.shape == (3 * 58, 2 * 28, 3)
    for k, image in enumerate(images):
        top, left = k // 2 * 58 + 6, k % 2 * 28 + 6
        assert np.array_equal(sheet[top : top + 16, left : left + 16], image)
        assert (sheet[top - 1, left : left + 16] == colour).all()


def test_of_many_states_a_sheet_shows_some_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("knotgym.datasets.gallery.MOST_STATES", 12)
    tiles = _state_tiles(read_states("bench", images=False))
    kinds = [tile.captions[1].rpartition("  row")[0] for tile in tiles]
    assert len(kinds) == 12 == len(set(kinds)) and kinds[:2] == ["nx 0  train", "nx 0  test"]
