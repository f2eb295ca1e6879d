"""The page that `knotgym play` serves: each browser tab has a rope of its own.

A tab's events (drags, buttons, keys) only leave a wish in its `Tab`, and one thread per tab acts
on the latest wish. So a tab that sends thousands of messages a second delays nobody else's rope,
and nothing that a browser sends is used as a path, a name to import, or a size.

A page of another site can't connect: the handshake checks the headers Host and Origin. And viser's
tunnel to a public host, which any tab could ask for, is taken away.
"""

from __future__ import annotations

import hmac
import io
import logging
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from knotgym.common.errors import Failed, KnotgymError, one_line
from knotgym.play.page_config import PageConfig
from knotgym.play.recorder import Recorder
from knotgym.play.scene import SCALE, RopeScene
from knotgym.play.session import Session
from knotgym.rendering.diagram import draw_diagram
from knotgym.rope.model import Array

FRAMES = 30  # shown per second
_LIFT = 0.03  # metres above or below the rope's middle height at which a drag leads a bead
_FARTHEST = 100.0  # scene units from the origin at which a drag is read
_WALK = 25.0  # beads per second of the walker
_MOST_TABS = 16  # ropes at a time
_TRIES = 5  # wrong tokens before a tab is left alone
_LOOP = "plain loop"  # for an empty code
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_KEYS = """
**Drag** a bead to pull it; **shift**: over, **alt**: under what lies in the way. Drag the
background to turn, scroll to zoom.

| key | | key | |
| --- | --- | --- | --- |
| `Z` | undo | `H` | hint |
| `R` | reset | `P` | one pull by the policy |
| `N` | next start | `V` | view from above |
| `B` `F` | select the bead before, after | `I` `J` `K` `L` | pull it up, left, down, right |
| `O` `U` | pull it over, under | `C` | walk the code |

`W` `A` `S` `D` and the arrows move the camera.
"""


class Tab:
    """One tab: its session, its scene and its panel."""

    def __init__(self, client: Any, config: PageConfig, recorder: Recorder | None) -> None:
        self._client, self._config, self._recorder = client, config, recorder
        self.wish: Callable[[], None] | None = None
        self._drag: tuple[int, Array] | None = None  # bead, and where to, metres
        self._closed = threading.Event()
        self._selected, self._walk_from = 0, 0.0
        self._forget: Callable[[], None] = lambda: None
        self._kept: set[int] = set()  # episodes that are recorded
        self.session = Session(config.task, config.seed, recorder.next_number() if recorder else 0)
        rope = self.session.task.rope
        self._lasts = rope.timestep * rope.frame_skip  # seconds of rope time of a pull
        self.scene = RopeScene(client, self.session.points, self.session.task.rope)
        self._panel()
        self._show_start()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the tab's thread; an episode with pulls is recorded as abandoned."""
        self._closed.set()
        self._thread.join(timeout=10)

    # what the panel offers ---------------------------------------------------------------

    def _panel(self) -> None:
        gui = self._client.gui
        self._status = gui.add_markdown("")
        self._goal = gui.add_image(np.zeros((64, 64, 3), dtype=np.uint8))
        self._lift = gui.add_slider("Height of drags", -1.0, 1.0, 0.1, 0.0)
        row = (
            ("Undo", "Z", lambda: self._after(self.session.undo)),
            ("Reset", "R", lambda: self._after(self._start_again)),
            ("Next start", "N", self._next),
            ("Hint", "H", self._foresee),
            ("Let it pull once", "P", self._policy_pull),
            ("View from above", "V", lambda: self.scene.look_from_above(self.session.points)),
            ("Walk the code", "C", self._start_walk),
        )
        for label, key, wish in row:
            self._client.gui.add_button(label).on_click(self._wanting(wish))
            self._hotkey(label, key, wish)
        self._auto = gui.add_checkbox(f"Let {self._config.policy} play", False)
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown(_KEYS)
        for key, label, wish in (
            ("B", "Select the bead before", lambda: self._select(-1)),
            ("F", "Select the bead after", lambda: self._select(1)),
            ("I", "Pull up", lambda: self._push(0, 1, 0)),
            ("J", "Pull left", lambda: self._push(-1, 0, 0)),
            ("K", "Pull down", lambda: self._push(0, -1, 0)),
            ("L", "Pull right", lambda: self._push(1, 0, 0)),
            ("O", "Pull over", lambda: self._push(0, 0, 1)),
            ("U", "Pull under", lambda: self._push(0, 0, -1)),
        ):
            self._hotkey(label, key, wish)
        for modifier, lift in ((None, None), ("shift", 1.0), ("alt", -1.0)):
            self.scene.grips.on_drag("left", modifier=modifier)(self._dragging(lift))

    def _hotkey(self, label: str, key: str, wish: Callable[[], None]) -> None:
        command = self._client.gui.add_command(label, hotkey=key)
        command.on_trigger(self._wanting(wish))

    def _dragging(self, lift: float | None) -> Callable[[Any], None]:
        def drag(event: Any) -> None:
            bead, place = event.instance_index, event.end_position
            if event.phase == "end" or type(bead) is not int or len(place) != 3:
                self._drag = None
                return
            target = np.array([number(one, _FARTHEST) for one in place]) / SCALE
            points = self.session.points
            height = number(self._lift.value, 1.0) if lift is None else lift
            if height:
                target[2] = points[:, 2].mean() + _LIFT * height
            self._drag = bead % len(points), target

        return drag

    def _wanting(self, wish: Callable[[], None]) -> Callable[[Any], None]:
        """Return what leaves a wish; the latest one counts."""

        def leave(_: Any) -> None:
            self.wish = wish

        return leave

    # the tab's thread --------------------------------------------------------------------

    def _run(self) -> None:
        while not self._closed.is_set():
            began = time.monotonic()
            try:
                self._act()
            except (KnotgymError, OSError) as error:  # such as a full disk
                self._client.add_notification("knotgym", one_line(error), auto_close_seconds=10)
                self._auto.value = False
            self._closed.wait(max(0.0, 1 / FRAMES - (time.monotonic() - began)))
        self._keep()

    def _act(self) -> None:
        wish, self.wish = self.wish, None
        if wish is not None:
            wish()
        elif self._drag is not None:
            bead, target = self._drag
            self._pull(lambda: self.session.pull_towards(bead, target))
        elif self._auto.value and not self.session.ended:
            self._policy_pull()
        if self._walk_from:
            place = _WALK * (time.monotonic() - self._walk_from)
            over = place >= len(self.session.points)
            self.scene.walk(self.session.points, None if over else place)
            self._walk_from = 0.0 if over else self._walk_from

    def _pull(self, pull: Callable[[], object]) -> None:
        """Pull, then show the way there for as long as the pull lasts in rope time."""
        before, taken = self.session.points.copy(), len(self.session.pulls)
        began = time.monotonic()
        pull()
        if len(self.session.pulls) == taken:
            return
        after, lasts = self.session.points.copy(), self._lasts
        self._forget_path()
        while (share := (time.monotonic() - began) / lasts) < 1 and not self._closed.is_set():
            shown = time.monotonic()
            self.scene.move((1 - share) * before + share * after)
            self._closed.wait(max(0.0, 1 / FRAMES - (time.monotonic() - shown)))
        self._show()
        self._note()

    def _policy_pull(self) -> None:
        self._pull(lambda: self.session.let_act(self._config.policy))

    def _push(self, x: float, y: float, z: float) -> None:
        self._pull(lambda: self.session.pull(self._selected, (x, y, z)))

    def _after(self, change: Callable[[], None]) -> None:
        change()
        self._note()
        self._show()

    def _start_again(self) -> None:
        self.session.begin(self.session.number)

    def _next(self) -> None:
        self._keep()
        number = self._recorder.next_number() if self._recorder else self.session.number + 1
        self.session.begin(number)
        self._show_start()

    def _note(self) -> None:
        """Note what was pulled so far, or record the episode if it is over."""
        if self.session.ended:
            self._keep()
        elif self._recorder is not None:
            self._recorder.note(self.session.number, self.session.pulls)

    def _keep(self) -> None:
        """Record the episode, unless it was recorded already or a policy helped."""
        session = self.session
        if self._recorder is not None and session.number not in self._kept:
            self._kept.add(session.number)
            self._recorder.finish(session.number, session.pulls)

    def _foresee(self) -> None:
        self._say("thinking ...")
        seen = self.session.foresee(self._config.policy)
        self._forget_path()
        self._forget = self.scene.draw_path(seen.path)
        line = f"**{self._config.policy}** pulls bead {seen.bead}, to `{seen.code or _LOOP}`"
        self._show(line + (" (the goal)" if seen.success else ""), keep=True)

    def _select(self, step: int) -> None:
        self._selected = (self._selected + step) % len(self.session.points)
        self.scene.walk(self.session.points, float(self._selected))

    def _start_walk(self) -> None:
        self._walk_from = time.monotonic()

    # what the tab shows ------------------------------------------------------------------

    def _show_start(self) -> None:
        self._goal.image = draw_diagram(self.session.batch.goal_points(0), self.scene.goal_size)
        self.scene.look_from_above(self.session.points)
        self._show()

    def _show(self, line: str = "", keep: bool = False) -> None:
        if not keep:
            self._forget_path()
        points = self.session.points
        self.scene.move(points)
        self.scene.mark(points)
        self._say(line)

    def _forget_path(self) -> None:
        forget, self._forget = self._forget, lambda: None
        forget()

    def _say(self, line: str) -> None:
        session, rope = self.session, np.zeros(1, dtype=np.int64)
        (code,), (goal,) = session.batch.codes_of(rope), session.batch.goals_of(rope)
        state = "**the goal is reached**" if session.success else f"{session.left} pulls left"
        if session.ended and not session.success:
            state = "**over**: no pulls left"
        recorded = "" if self._recorder is None else f", recorded in `{self._recorder.folder.name}`"
        if self._recorder is not None and session.helped:
            recorded = ", not recorded, because a policy helped"
        self._status.content = "\n\n".join(
            (
                f"**{session.task.task}**, {session.task.nx} crossings, {session.task.split}"
                f" episode {session.number} ({session.task.engine}){recorded}",
                f"now `{str(code) or _LOOP}`",
                f"goal `{str(goal) or _LOOP}`",
                f"{state}; reward {session.reward:g}",
                line,
            )
        )


class Page:
    """A running server; a context manager.

    Attributes:
        address: what to open.
        token: what a tab must give first; "" on the loopback.
        players: the tabs that play, by viser's number of the client.
    """

    def __init__(self, config: PageConfig, recorder: Recorder | None = None) -> None:
        """Serve the page.

        Raises:
            Failed: the port is taken, or viser isn't installed.
        """
        require_port(config.host, config.port)
        import viser

        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # garbage needs no traceback
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a tab that left
        self._config, self._recorder = config, recorder
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

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *error: object) -> None:
        for number in list(self.players):
            self._leave(number)
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _open(self, client: Any) -> Any:
        return Tab(client, self._config, self._recorder)

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
            self.players[client.client_id] = self._open(client)

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
    try:
        name = (urlsplit(f"//{named}").hostname or "").lower()
    except ValueError:
        return False
    own = {*_LOOPBACK, host}
    if host not in _LOOPBACK:
        own |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    if name not in own and (host in _LOOPBACK or not _is_address(name)):
        return False
    return headers.get("Origin", f"http://{named}") in (f"http://{named}", f"https://{named}")


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


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
