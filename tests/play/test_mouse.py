"""Goals tied in a real browser by mouse events alone: `pytest -m slow tests/play/test_mouse.py`.

Not in CI: without a GPU the browser draws a few frames a second, and then some drags miss.
"""

import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import arrays
from knotgym.play.page import Page, PlayConfig, Player
from knotgym.play.recorder import Recorder
from knotgym.play.scene import SCALE
from knotgym.play.session import Session

from ..chromium import Chromium
from .test_page import browser, free_port, until

__all__ = ["browser"]  # the fixture
pytestmark = pytest.mark.slow
SO3 = pytest.importorskip("viser.transforms").SO3
TASK = TaskConfig(task="tie", nx=2, observation="state", engine="chain")


def pixel(player: Player, point: Any) -> tuple[float, float]:
    """Where a point, metres, is seen by the tab's camera, of OpenCV's conventions."""
    camera = player._client.camera
    turn = SO3(np.asarray(camera.wxyz)).as_matrix()  # columns: right, down and ahead
    right, down, ahead = turn.T @ (SCALE * np.asarray(point) - camera.position)
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / ahead
    return (
        float(camera.image_width / 2 + scale * right),
        float(camera.image_height / 2 + scale * down),
    )


def drag_along(browser: Chromium, player: Player, bead: int, path: Any) -> None:
    """Drag a bead along a path, with shift where it lies above the rope and alt below."""
    session = player.session
    code = str(session.episodes.codes[0])
    browser.mouse("mousePressed", pixel(player, session.points[bead] + [0, 0, 0.005]), 0)
    time.sleep(0.6)
    for point in path:
        level = point[2] - session.points[:, 2].mean()
        held = 8 if level > 0.01 else 1 if level < -0.01 else 0
        for share in (0.5, 1.0):
            there = (1 - share) * session.points[bead] + share * point
            browser.mouse("mouseMoved", pixel(player, there), held)
            time.sleep(0.1)
        taken = len(session.actions)
        time.sleep(0.25)
        while len(session.actions) > taken and not session.ended:
            taken = len(session.actions)
            time.sleep(0.25)
        if session.ended or str(session.episodes.codes[0]) != code:
            break
    browser.mouse("mouseReleased", pixel(player, session.points[bead]), 0)
    time.sleep(0.3)


def ask_for_the_next(browser: Chromium, player: Player) -> None:
    """Press the key again if nothing happens: a browser that draws slowly may lose it."""
    asked, tries = player.session.number, 0
    while player.session.number == asked:
        assert (tries := tries + 1) < 10, "the key N has no effect"
        browser.press("n")
        with suppress(AssertionError):
            until(partial(has_moved_on, player, asked), 12)


def has_moved_on(player: Player, number: int) -> bool:
    return player.session.number != number


def test_goals_are_tied_with_the_mouse_and_recorded(browser: Chromium, tmp_path: Path) -> None:
    port, identifier = free_port(), "knotgym/tie-nx2/human-v0"
    with (
        Recorder(TASK, 0, identifier, "a test", tmp_path) as recorder,
        Page(PlayConfig(task=TASK, port=port), recorder) as page,
    ):
        browser.visit(page.address)
        until(lambda: page.players)
        player = page.players[0]
        time.sleep(3)
        tied = 0
        for _ in range(3):
            session: Session = player.session
            for attempt in range(10):
                if session.ended:
                    break
                seen = session.foresee("expert")
                # where another strand hides the bead, a neighbour is taken, as a hand would
                bead = (seen.bead + (0, 1, -1, 2)[attempt % 4]) % len(session.points)
                drag_along(browser, player, bead, seen.path[1:])
            tied += session.success
            ask_for_the_next(browser, player)
            time.sleep(3)
        assert tied >= 1
        assert browser.faults == [one for one in browser.faults if "error" not in one.lower()]
    assert verify_episodes(recorder.folder, act_out=True) == []
    reader = EpisodeReader(recorder.folder)
    assert sum(bool(episode.is_success[-1]) for episode in reader) == tied
    assert len(arrays(recorder.folder, observation="state")["actions"]) == reader.lengths.sum()
