"""The page in a real browser: pulled by mouse alone, attacked, and left."""

import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.errors import KnotgymError
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import arrays
from knotgym.play.page import Page, PlayConfig, PlayError, Player, require_port
from knotgym.play.recorder import Recorder
from knotgym.play.scene import SCALE
from knotgym.play.watch import WatchPage

from .. import chromium
from ..chromium import Chromium

pytestmark = pytest.mark.clients
pytest.importorskip("viser")
TASK = TaskConfig(task="tie", nx=2, observation="state", engine="chain")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(condition: Any, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "never true"
        time.sleep(0.02)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Chromium]:
    if not chromium.FOUND:
        pytest.skip("no chromium")
    with Chromium(tmp_path / "profile", 1300, 900) as browser:
        yield browser


def pixel(player: Player, point: Any) -> tuple[float, float]:
    """Where a point, metres, is seen by a camera that looks straight down."""
    camera = player._client.camera
    across = SCALE * np.asarray(point) - camera.position
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / -across[2]
    return (
        float(camera.image_width / 2 + scale * across[0]),
        float(camera.image_height / 2 - scale * across[1]),
    )


def drag_along(browser: Chromium, player: Player, bead: int, path: Any) -> None:
    """Drag a bead along a path, with shift where it lies above the rope and alt below."""
    session = player.session
    code = str(session.episodes.codes[0])
    browser.mouse("mousePressed", pixel(player, session.points[bead] + [0, 0, 0.005]), 0)
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
        for _ in range(4):
            session = player.session
            while not session.ended:
                seen = session.foresee("planner-hint" if False else "expert")
                drag_along(browser, player, seen.bead, seen.path[1:])
            tied += session.success
            number = session.number
            browser.press("n")
            until(lambda n=number: session.number != n)
        assert tied >= 2
        assert browser.faults == [one for one in browser.faults if "error" not in one.lower()]
    assert verify_episodes(recorder.folder, act_out=True) == []
    reader = EpisodeReader(recorder.folder)
    assert sum(bool(episode.is_success[-1]) for episode in reader) == tied
    assert len(arrays(recorder.folder, observation="state")["actions"]) == reader.lengths.sum()
