"""The page as a person sees it, at the width of a desktop and of a phone, and under a finger.

The pictures of docs/play.md are made by

    pytest -m slow tests/play/test_pictures.py --basetemp pictures
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from knotgym.control.old_policies import make_policy
from knotgym.control.policies import PolicyConfig
from knotgym.control.rollouts import EVALUATION, rollout
from knotgym.play.page import Page, PlayConfig
from knotgym.play.recorder import Recorder
from knotgym.play.watch import WatchPage

from .. import chromium
from ..chromium import Chromium
from .test_mouse import TASK, pixel
from .test_page import free_port, until

pytestmark = pytest.mark.slow
PHONE = (390, 844)
PANEL = 0.4  # of a phone's height, below which viser lays the panel
WARNING = """
document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())
"""  # that WebGL is drawn without a GPU
# what viser's page says on the console in any case
TOLD = (
    "Detected chrome",
    "WebGL support",
    "THREE.Clock",
    "Tried to send ViewerCameraMessage",
    "Unable to preventDefault",
    "[Performance]",
)


@contextmanager
def opened(tmp_path: Path, phone: bool) -> Iterator[Chromium]:
    if not chromium.FOUND:
        pytest.skip("no chromium")
    with Chromium(tmp_path / "profile", *(PHONE if phone else (1200, 800))) as browser:
        if phone:
            browser.resize(*PHONE, mobile=True)
            browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=5)
        yield browser
        assert [one for one in browser.faults if not any(told in one for told in TOLD)] == []


@pytest.fixture(params=["desktop", "phone"])
def browser(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Chromium]:
    with opened(tmp_path, request.param == "phone") as browser:
        yield browser


def taken(browser: Chromium, path: Path) -> None:
    """Take a picture once the page has settled."""
    browser.ask(WARNING)
    time.sleep(5)
    browser.picture(path)


def test_play_and_hint_are_seen(browser: Chromium, tmp_path: Path) -> None:
    with Page(PlayConfig(task=TASK, port=free_port())) as page:
        browser.visit(page.address)
        until(lambda: page.players)
        player = page.players[0]
        taken(browser, tmp_path / "play.png")
        shown = np.array([pixel(player, point) for point in player.session.points])
        wide, high = player._client.camera.image_width, player._client.camera.image_height
        assert (shown > 0).all()
        assert (shown < (wide, high * (PANEL if player.scene.narrow else 1.0))).all()
        player._wants(lambda: player._foresee(["expert"]))
        until(lambda: "pulls bead" in player._status.content)
        taken(browser, tmp_path / "hint.png")


def test_a_finger_pulls_the_rope_and_turns_it(tmp_path: Path) -> None:
    with (
        Page(PlayConfig(task=TASK, port=free_port())) as page,
        opened(tmp_path, phone=True) as browser,
    ):
        browser.visit(page.address)
        until(lambda: page.players)
        player = page.players[0]
        time.sleep(5)
        browser.ask(WARNING)
        ratio = player._client.camera.image_width / PHONE[0]
        x, y = (float(one) / ratio for one in pixel(player, player.session.points[30]))
        before = player.session.points[30].copy()
        browser.touch([(x, y + 8 * step) for step in range(12)], pause=0.5)
        until(lambda: len(player.session.actions) >= 1)
        assert player.session.points[30][1] < before[1]
        facing = np.array(player._client.camera.position)
        browser.touch([(20.0 + 8 * step, 20.0) for step in range(12)], pause=0.5)
        until(lambda: np.abs(player._client.camera.position - facing).max() > 0.5)


def test_a_dataset_is_seen(browser: Chromium, tmp_path: Path) -> None:
    policy = make_policy(PolicyConfig(policy="expert"))
    actions = rollout(TASK, policy, [0], 0, streams=EVALUATION)[0].episode.actions
    with Recorder(TASK, 0, "knotgym/tie-nx2/human-v0", "Ann", tmp_path) as recorder:
        recorder.finish(0, list(actions))
    with WatchPage(PlayConfig(task=TASK, port=free_port()), recorder.folder) as page:
        browser.visit(page.address)
        until(lambda: page.players)
        viewer = page.players[0]
        viewer._playing.value = False
        viewer._time.value = len(actions) - 1.5
        until(lambda: f"step {len(actions) - 2} of" in viewer._status.content)
        taken(browser, tmp_path / "watch.png")
