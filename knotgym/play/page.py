"""The page that `knotgym play` serves: each browser tab has a rope and a thread of its own.

It is on the loopback alone, and its address has a token, without which no other user of the machine
can connect. A page of another site can't connect either: the handshake checks the headers Host and
Origin. And viser's tunnel to a public host, which any tab could ask for, is taken away.
"""

import io
import logging
import re
import secrets
import socket
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any, Self

from knotgym.common import Failed, one_line
from knotgym.play.hand import HandTab
from knotgym.play.page_config import PageConfig
from knotgym.play.recorder import Recorder

_MOST_TABS = 16  # ropes at a time
_HOST = "127.0.0.1"
# what a browser on this machine, or at the other end of a tunnel, may be told to open
_OWN_HOST = re.compile(r"(127(\.\d+){3}|0\.0\.0\.0|\[::1\]|localhost)(:\d+)?", re.IGNORECASE)
_REFUSAL = """\
Open the address that knotgym play printed, with all that follows the port.
From another machine use a tunnel, ssh -L 8080:127.0.0.1:8080 HOST, and the same address.
"""


class Page:
    """A running server; a context manager, which raises Failed if a tab couldn't store an episode.

    Attributes:
        address: what to open, with the token.
        players: the tabs that play, by viser's number of the client.
    """

    def __init__(self, config: PageConfig, open_tab: Callable[[Any], Any]) -> None:
        """Serve the page.

        Args:
            config: the port.
            open_tab: from viser's client, which a browser has opened, to its tab, which is closed
                when the browser leaves.

        Raises:
            Failed: the port is taken, or viser isn't installed.
        """
        _require_port(config.port)
        import viser

        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # garbage needs no traceback
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a tab that left
        self._open_tab = open_tab
        self.players: dict[int, Any] = {}
        self._failures = list[str]()  # of tabs that were closed
        self._lock, token = threading.Lock(), secrets.token_urlsafe(12)

        class LocalServer(viser.ViserServer):
            """A server that never opens a tunnel, even on request."""

            def request_share_url(self, verbose: bool = True) -> None:
                return None

        # viser prints its address, which the command says too
        with redirect_stdout(io.StringIO()), _guarded_handshakes(token):
            self._server = LocalServer(
                host=_HOST, port=config.port, label="knotgym play", verbose=False
            )
        # before a tab connects: a camera that is set while the world turns is lost
        self._server.scene.set_up_direction("+y")
        start = self._server.initial_camera
        start.position, start.look_at, start.up = (0.0, 0.0, 4.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
        self._server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium"
        )
        self.address = f"http://{_HOST}:{self._server.get_port()}/{token}/"
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(lambda client: self._leave(client.client_id))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for number in list(self.players):
            self._leave(number)
        with redirect_stdout(io.StringIO()):
            self._server.stop()
        if self._failures:
            raise Failed("; ".join(self._failures))

    def _connected(self, client: Any) -> None:
        with self._lock:
            if len(self.players) >= _MOST_TABS:
                client.add_notification("knotgym", f"{_MOST_TABS} ropes are being played already")
                return
            self.players[client.client_id] = self._open_tab(client)

    def _leave(self, number: int) -> None:
        with self._lock:
            player = self.players.pop(number, None)
        if player is not None:
            self._failures += filter(None, [player.close()])


@contextmanager
def serve(
    config: PageConfig, say: Callable[[str], None], record: str = "", root: Path | None = None
) -> Iterator[Page]:
    """Serve the page of a task, on which the rope is pulled by hand, until the block ends.

    Args:
        config: task, seed, policy and port.
        say: gets the lines that tell where episodes are recorded.
        record: id of the dataset in which episodes are recorded; "" for none.
        root: folder of datasets; None for Minari's own.

    Raises:
        Failed, InvalidInput, InvalidFile: as `Page` and `Recorder`.
    """
    with ExitStack() as stack:
        recorder = None
        if record:
            recorder = Recorder(config.task, config.seed, record, config.player, root)
            stack.enter_context(recorder)
            say(f"episodes are recorded in {recorder.folder}")
            if recorder.recovered:
                say(f"stored {recorder.recovered} episodes of an interrupted session")
        tab = partial(HandTab, config=config, recorder=recorder)
        yield stack.enter_context(Page(config, tab))


@contextmanager
def _guarded_handshakes(token: str) -> Iterator[None]:
    """Let a server that is started in the block refuse requests without its token or of others."""
    import websockets.asyncio.server as module

    whole = module.serve

    def _serve(handler: Any, *given: Any, process_request: Any = None, **named: Any) -> Any:
        def _checked(connection: Any, request: Any) -> Any:
            # the page asks at its own address, of which viser knows no token
            first, _, rest = request.path.removeprefix("/").partition("/")
            has_token = secrets.compare_digest(first.encode(errors="replace"), token.encode())
            if has_token and _is_own_page(request.headers):
                return process_request(connection, replace(request, path=f"/{rest}"))
            return connection.respond(HTTPStatus.FORBIDDEN, _REFUSAL)

        return whole(handler, *given, process_request=_checked, **named)

    module.serve = _serve
    try:
        yield
    finally:
        module.serve = whole


def _is_own_page(headers: Mapping[str, str]) -> bool:
    """Whether a request was made by a page that this server served, or by no page at all.

    The Origin is that of the page that asks; other sites can't forge it. The Host is what the
    browser takes this server for; it is another site's where that site's name leads here.

    >>> _is_own_page({"Host": "localhost:8080", "Origin": "http://localhost:8080"})
    True
    >>> _is_own_page({"Host": "[::1]:8080", "Origin": "http://[::1]:8080"})
    True
    >>> _is_own_page({"Host": "localhost:8080", "Origin": "https://evil.example"})
    False
    >>> _is_own_page({"Host": "evil.example:8080"})
    False
    """
    named = headers.get("Host", "")
    is_own = _OWN_HOST.fullmatch(named) is not None
    return is_own and headers.get("Origin", f"http://{named}") == f"http://{named}"


def _require_port(port: int) -> None:
    """Raise Failed unless a port is free."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((_HOST, port))
    except OSError as error:
        fault = f"can't serve on port {port}: {one_line(error)}"
        raise Failed(f"{fault}; choose another with --port") from error
