"""The page that `knotgym play` serves: each browser tab has a rope and a thread of its own.

A page of another site can't connect: the handshake checks the headers Host and Origin. And viser's
tunnel to a public host, which any tab could ask for, is taken away.
"""

import hmac
import io
import logging
import re
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from typing import Any, Self

import numpy as np

from knotgym.common.errors import Failed, KnotgymError, one_line
from knotgym.play.page_config import PageConfig
from knotgym.play.scene import RopeScene
from knotgym.rendering.diagram import draw_diagram
from knotgym.rope.model import Array, RopeConfig

FRAMES = 30  # shown per second
LOOP = "plain loop"  # for an empty code
_MOST_TABS = 16  # ropes at a time
_TRIES = 5  # wrong tokens before a tab is left alone
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d+)?", re.IGNORECASE)


class Tab:
    """One tab: a rope's scene, a line of status, the goal's picture, and a thread that acts.

    Attributes:
        scene: the rope.
        seconds_per_pull: how long a pull lasts in rope time.
    """

    def __init__(self, client: Any, points: Array, rope: RopeConfig) -> None:
        self._client, self._closed = client, threading.Event()
        self.scene = RopeScene(client, points, rope)
        self.seconds_per_pull = rope.timestep * rope.frame_skip
        self._status = client.gui.add_markdown("")
        self._goal = client.gui.add_image(np.zeros((64, 64, 3), dtype=np.uint8))
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Start to act, `FRAMES` times a second."""
        self._thread.start()

    def close(self) -> None:
        """Stop acting."""
        self._closed.set()
        self._thread.join(timeout=10)

    def say(self, *lines: str) -> None:
        """Show paragraphs of Markdown."""
        self._status.content = "\n\n".join(lines)

    def show_start(self, points: Array, goal: Array) -> None:
        """Show an episode's goal, and its start from above; both float64 (beads, 3), metres."""
        self._goal.image = draw_diagram(goal, self.scene.goal_size)
        self.scene.look_from_above(points)

    def _run(self) -> None:
        while not self._closed.is_set():
            began = time.monotonic()
            try:
                self._act()
            except (KnotgymError, OSError) as error:  # such as a full disk
                self._client.add_notification("knotgym", one_line(error), auto_close_seconds=10)
                self._failed()
            self._closed.wait(max(0.0, 1 / FRAMES - (time.monotonic() - began)))
        self._end()

    def _act(self) -> None:
        """Do what is due in a frame."""
        raise NotImplementedError

    def _failed(self) -> None:
        """React to an error of `_act`, which was shown."""

    def _end(self) -> None:
        """Do what is due when the tab is closed."""


class Page:
    """A running server; a context manager.

    Attributes:
        address: what to open.
        token: what a tab must give first; "" on the loopback.
        players: the tabs that play, by viser's number of the client.
    """

    def __init__(self, config: PageConfig, open_tab: Callable[[Any], Tab]) -> None:
        """Serve the page.

        Args:
            config: where.
            open_tab: from viser's client, which a browser has opened, to its tab.

        Raises:
            Failed: the port is taken, or viser isn't installed.
        """
        require_port(config.host, config.port)
        import viser

        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # garbage needs no traceback
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a tab that left
        self._open_tab = open_tab
        self.token = "" if config.host in _LOOPBACK else secrets.token_urlsafe(12)
        self.players: dict[int, Any] = {}
        self._lock = threading.Lock()

        class LocalServer(viser.ViserServer):
            """A server that never opens a tunnel, even on request."""

            def request_share_url(self, verbose: bool = True) -> None:
                return None

        # viser prints its address, which the command says too
        with redirect_stdout(io.StringIO()), _guarded_handshakes(config.host):
            self._server = LocalServer(
                host=config.host, port=config.port, label="knotgym play", verbose=False
            )
        # before a tab connects: a camera that is set while the world turns is lost
        self._server.scene.set_up_direction("+y")
        start = self._server.initial_camera
        start.position, start.look_at, start.up = (0.0, 0.0, 4.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
        self._server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium"
        )
        anywhere = config.host in ("0.0.0.0", "::")  # no address that a browser could open
        host = socket.gethostname() if anywhere else config.host
        self.address = f"http://{host}:{self._server.get_port()}"
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for number in list(self.players):
            self._leave(number)
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _connected(self, client: Any) -> None:
        if not self.token:
            self._join(client)
            return
        left = [_TRIES]
        field = client.gui.add_text("Token", "")

        def answer(_: Any) -> None:
            if left[0] and hmac.compare_digest(
                str(field.value)[:100].encode(), self.token.encode()
            ):
                left[0] = 0
                field.remove()
                self._join(client)
            left[0] = max(0, left[0] - 1)

        field.on_update(answer)

    def _join(self, client: Any) -> None:
        with self._lock:
            if len(self.players) >= _MOST_TABS:
                client.add_notification("knotgym", f"{_MOST_TABS} ropes are being played already")
                return
            self.players[client.client_id] = self._open_tab(client)

    def _gone(self, client: Any) -> None:
        self._leave(client.client_id)

    def _leave(self, number: int) -> None:
        with self._lock:
            player = self.players.pop(number, None)
        if player is not None:
            player.close()


@contextmanager
def _guarded_handshakes(host: str) -> Iterator[None]:
    """Let a server that is started in the block refuse the handshakes of other sites' pages."""
    import websockets.asyncio.server as module

    whole = module.serve

    def serve(handler: Any, *given: Any, process_request: Any = None, **named: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if is_own_page(request.headers, host):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, "not from this page\n")

        return whole(handler, *given, process_request=checked, **named)

    module.serve = serve
    try:
        yield
    finally:
        module.serve = whole


def is_own_page(headers: Mapping[str, str], host: str) -> bool:
    """Whether a request was made by a page that this server served, or by no page at all.

    The Origin is that of the page that asks; other sites can't forge it. The Host is what the
    browser takes this server for; it is another site's where that site's name leads here.

    >>> is_own_page({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, "127.0.0.1")
    True
    >>> is_own_page({"Host": "localhost:8080", "Origin": "https://evil.example"}, "127.0.0.1")
    False
    >>> is_own_page({"Host": "evil.example:8080"}, "127.0.0.1")
    False
    """
    named = headers.get("Host", "")
    # another host's page has names that aren't known here, and a token that other sites don't know
    if host in _LOOPBACK and not _OWN_HOST.fullmatch(named):
        return False
    return headers.get("Origin", f"http://{named}") in (f"http://{named}", f"https://{named}")


def number(value: object, most: float) -> float:
    """Read a number that a browser sent: 0 for anything else, clipped to [-most, most].

    >>> number("0.5", 1.0), number(7, 1.0), number("x", 1.0), number(float("nan"), 1.0)
    (0.5, 1.0, 0.0, 0.0)
    """
    try:
        read = float(str(value)[:40])
    except ValueError:
        return 0.0
    return min(max(read, -most), most) if read == read else 0.0


def require_port(host: str, port: int) -> None:
    """Require that a port is free.

    Raises:
        Failed: it isn't, or the host isn't this machine's.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise Failed(
            f"can't serve on {host} port {port}: {one_line(error)}; choose another with --port"
        ) from error
