"""The page is attacked, and left."""

import http.client
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Patch

from knotgym.common import Failed
from knotgym.envs import TaskConfig
from knotgym.play.hand import HandTab
from knotgym.play.page import Page, serve
from knotgym.play.page_config import PageConfig

from ..small_job import full_disk

pytestmark = pytest.mark.clients
msgspec = pytest.importorskip("msgspec")
pytest.importorskip("viser")
SO3 = pytest.importorskip("viser.transforms").SO3
TASK = TaskConfig(task="tie", nx=2, observation="state", engine="chain")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(condition: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "never true"
        time.sleep(0.02)


class Tab:
    """A client without a browser, which may say anything."""

    def __init__(self, page: Page) -> None:
        import viser
        from websockets.sync.client import connect

        self.socket = connect(
            socket_address(page), subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        )
        self.say(
            "ViewerCameraMessage", wxyz=(1, 0, 0, 0), position=(0, 0, 4), fov=1.0, near=0.01,
            far=9.0, image_height=90, image_width=90, look_at=(0, 0, 0), up_direction=(0, 1, 0),
        )  # fmt: skip

    def say(self, kind: str, **fields: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def drag(self, bead: Any, place: Any, phase: str = "update") -> None:
        self.say(
            "SceneNodeDragMessage", phase=phase, name="/rope", instance_index=bead,
            start_position=place, start_screen_pos=(0.5, 0.5), end_position=place,
            end_screen_pos=(0.5, 0.5), button="left", modifier=None, owner="0",
        )  # fmt: skip


@pytest.fixture
def page() -> Iterator[Page]:
    config = PageConfig(task=TASK, port=free_port())
    with Page(config, partial(HandTab, config=config)) as page:
        yield page


@pytest.fixture
def tab(page: Page) -> Tab:
    """The first tab of the page, whose rope is laid."""
    one = Tab(page)
    until(lambda: page.players)
    return one


def still_plays(player: Any) -> None:
    """Have a rope pulled, as its tab would wish."""
    before = len(player.session.pulls)
    player.wish = lambda: player.session.pull(3, (1, 0, 0))
    until(lambda: len(player.session.pulls) > before)


def port_of(page: Page) -> int:
    return int(page.address.split("/")[2].rpartition(":")[2])


def socket_address(page: Page) -> str:
    """Where the page of a browser connects to, see `getDefaultServerFromUrl` of viser's client."""
    return page.address.replace("http://", "ws://").rstrip("/")


def test_garbage_ends_the_tab_that_sent_it(page: Page, tab: Tab) -> None:
    bad = Tab(page)
    until(lambda: len(page.players) == 2)
    bad.socket.send(bytes(range(256)))
    until(lambda: len(page.players) == 1)
    tab.socket.recv()
    still_plays(next(iter(page.players.values())))


def test_a_flood_delays_nobody_else(page: Page, tab: Tab) -> None:
    player = page.players[0]
    loud = Tab(page)
    until(lambda: len(page.players) == 2)
    for number in range(10_000):
        loud.drag(number % 100, (0.1, 0.1, 0.0))
    still_plays(player)
    other = page.players[max(page.players)]
    assert len(other.session.pulls) <= TASK.horizon
    tab.socket.close()
    loud.socket.close()
    until(lambda: not page.players)  # a closed tab frees its rope


@pytest.mark.parametrize(
    "bead, place",
    [("/etc/passwd", (0, 0, 0)), (1e9, (0, 0, 0)), (5, ("x", "y", "z")), (-7, (1e308, 0, 0))],
)
def test_a_drag_of_nonsense_is_harmless(page: Page, tab: Tab, bead: Any, place: Any) -> None:
    from websockets.exceptions import ConnectionClosed

    player = page.players[0]
    with suppress(ConnectionClosed):  # viser itself may end the tab
        for phase in ("start", "update", "end"):
            tab.drag(bead, place, phase)
    player.wish = lambda: player.session.pull(3, (1, 0, 0))
    until(lambda: player.session.pulls or not page.players)
    assert np.isfinite(player.session.points).all()


@pytest.mark.parametrize(
    "host, path, headers",
    [
        ("127.0.0.1", "", {"Origin": "https://evil.example"}),
        ("evil.example", "", {}),
        ("127.0.0.1", "/", {}),
        ("127.0.0.1", "/another-token", {}),
        ("127.0.0.1", "/%C3%A9", {}),
    ],
    ids=["another site's page", "another site's name", "no token", "another token", "not ASCII"],
)
def test_who_does_not_have_the_address_is_not_let_in(
    page: Page, host: str, path: str, headers: dict[str, str]
) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    protocols: Any = [f"viser-v{viser.__version__}"]
    uri = socket_address(page).replace("127.0.0.1", host)
    uri = f"ws://{host}:{port_of(page)}{path}" if path else uri
    with socket.create_connection(("127.0.0.1", port_of(page))) as wire:
        with pytest.raises(InvalidStatus, match="403") as refused:
            connect(uri, sock=wire, subprotocols=protocols, additional_headers=headers)
    assert b"the address that knotgym play printed" in refused.value.response.body
    Tab(page)
    until(lambda: len(page.players) == 1)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]", "0.0.0.0"])
def test_the_page_is_served_to_whatever_leads_to_the_loopback(page: Page, host: str) -> None:
    wire = http.client.HTTPConnection("127.0.0.1", port_of(page))
    path = "/" + page.address.split("/", 3)[3]
    named = f"{host}:{port_of(page)}"
    wire.request("GET", path, headers={"Host": named, "Origin": f"http://{named}"})
    answer = wire.getresponse()
    assert answer.status == 200 and b"<!doctype html>" in answer.read()


def test_no_tab_opens_a_tunnel_to_a_public_host(page: Page, tab: Tab, monkeypatch: Patch) -> None:
    from viser import _viser

    opened: list[Any] = []
    monkeypatch.setattr(_viser, "ViserTunnel", lambda *given: opened.append(given))
    tab.say("ShareUrlRequest")
    still_plays(page.players[0])
    page._server.request_share_url()
    assert not opened


@pytest.mark.usefixtures("tab")
def test_a_full_disk_is_told_and_the_tab_goes_on(page: Page, monkeypatch: Patch) -> None:
    player, told = page.players[0], list[Any]()
    monkeypatch.setattr(player._client, "add_notification", lambda *said, **_: told.append(said))

    player.wish = full_disk
    until(lambda: told)
    assert "No space left" in told[0][1]
    still_plays(player)


def test_an_episode_that_could_not_be_stored_is_told_at_the_end(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    config = PageConfig(task=TASK, port=free_port())
    with pytest.raises(Failed, match="episode 0 isn.t stored .*No space left"):
        with serve(config, print, "knotgym/tie-nx2/human-v0", tmp_path) as page:
            Tab(page)
            until(lambda: page.players)
            still_plays(page.players[0])
            monkeypatch.setattr("knotgym.play.recorder.publish", full_disk)


def test_a_taken_port_is_one_line(page: Page) -> None:
    with pytest.raises(Failed, match="choose another with --port"):
        Page(PageConfig(port=port_of(page)), lambda client: client)


def test_ctrl_c_right_after_the_address_ends_the_page_with_status_0() -> None:
    words = [sys.executable, "-m", "knotgym", "play", "--port", str(free_port())]
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None and run.stderr is not None
        while "Ctrl-C ends it" not in run.stdout.readline():
            assert run.poll() is None
        run.send_signal(signal.SIGINT)
        assert run.wait(60) == 0
        assert run.stderr.read() == ""
