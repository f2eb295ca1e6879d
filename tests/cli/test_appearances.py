"""A new appearance or camera is one record, and is known everywhere."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from pytest_types import Patch

from knotgym.cli.options import field_help
from knotgym.common import InvalidInput
from knotgym.datasets import decode, read_rows
from knotgym.envs import TaskConfig
from knotgym.generate import ImagesConfig, make_images
from knotgym.generate import faults as dataset_faults
from knotgym.rendering import (
    APPEARANCES,
    CAMERAS,
    AppearanceConfig,
    AppearanceKind,
    Drawer,
    PictureConfig,
)
from knotgym.runs import RunOptions


class Negative(Drawer):
    """The published pictures with black and white exchanged."""

    def image(self, points: Any, look: Any) -> Any:
        return 255 - super().image(points, look)


def test_an_appearance_is_added_by_one_record(tmp_path: Path, monkeypatch: Patch) -> None:
    with pytest.raises(InvalidInput, match="must be one of published, line, photo"):
        AppearanceConfig(name="negative")
    kind = AppearanceKind(says="on white", drawer=f"{__name__}:Negative", vary=("turn",), size=96)
    monkeypatch.setitem(APPEARANCES, "negative", kind)
    # the help
    assert field_help(AppearanceConfig, "name").endswith("negative (on white).")
    assert field_help(TaskConfig, "appearance") == field_help(AppearanceConfig, "name")
    # pictures, their check and their card
    config = ImagesConfig(
        nx=(0, 1), count=2, test_nx=None, engine="chain", pulls=4,
        appearance=AppearanceConfig(name="negative", vary=("all",)),
    )  # fmt: skip
    options = RunOptions(workers=1, quiet=True)
    folder = make_images(config, tmp_path / "table", options)
    for row in read_rows(folder):
        assert row["appearance"]["name"] == "negative" and row["appearance"]["turn"] != 0
        assert decode(row["image"]).shape == (96, 96, 3) and (decode(row["image"])[0] == 255).all()
    assert [*dataset_faults(folder)] == []
    assert "`negative`, on white" in (folder / "README.md").read_text(encoding="utf-8")
    # an environment
    env = gym.make("knotgym/Tie-v0", nx=1, appearance="negative", image_size=64, engine="chain")
    seen = env.reset(seed=0)[0]
    assert seen.shape == (64, 128, 3) and (seen[0] == 255).all()
    with pytest.raises(InvalidInput, match='appearance "negative" is the orthographic top view'):
        gym.make("knotgym/Tie-v0", appearance="negative", depth=True)


def test_a_camera_is_added_by_one_record(monkeypatch: Patch) -> None:
    with pytest.raises(InvalidInput, match="must be one of orthographic, perspective"):
        PictureConfig(camera="tele")
    monkeypatch.setitem(CAMERAS, "tele", CAMERAS["perspective"]._replace(says="far", fovy=20.0))
    assert field_help(TaskConfig, "camera").endswith("tele (far).")
    near, far = (
        gym.make("knotgym/Tie-v0", nx=1, camera=camera, image_size=64, engine="chain")
        for camera in ("perspective", "tele")
    )
    shown = [(env.reset(seed=0)[0][:, :64] > 0).any(axis=2).mean() for env in (near, far)]
    assert shown[1] > 2 * shown[0] > 0, "the rope fills more of a narrower view"


@pytest.mark.parametrize(
    "changed", [{"tilt": 3.0}, {"marked": 0.5}, {"noise": 1.0}, {"name": "photo", "width": (1, 2)}]
)
def test_a_setting_that_no_picture_shows_is_refused(changed: Any, tmp_path: Path) -> None:
    config = ImagesConfig(nx=(0,), count=1, appearance=AppearanceConfig(**changed))
    with pytest.raises(InvalidInput, match="doesn't show"):
        make_images(config, tmp_path / "table", RunOptions(workers=1, quiet=True))
