"""A tab in which the rope is pulled by hand.

What a browser sends (drags, buttons, keys) only leaves a wish, and the tab's thread acts on the
latest one. So a tab that sends thousands of messages a second delays nobody else's rope, and
nothing that a browser sends is used as a path, a name to import, or a size.
"""

import threading
import time
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from typing import Any

import numpy as np

from knotgym.common import Array, KnotgymError, one_line
from knotgym.play.page_config import PageConfig
from knotgym.play.recorder import Recorder
from knotgym.play.scene import SCALE, RopeScene
from knotgym.play.session import Session
from knotgym.rendering import draw_diagram

_FRAMES = 30  # shown per second
_LOOP = "plain loop"  # for an empty code
_LIFT = 0.03  # metres above or below the rope's middle height at which a drag leads a bead
_FARTHEST = 100.0  # scene units from the origin at which a drag is read
_PATIENCE = 10.0  # seconds in which a closed tab must have stored its episode
_KEYS = (files("knotgym.play") / "keys.md").read_text("utf-8")


class HandTab:
    """A tab: a session of its own, its rope's scene, a panel, and a thread that acts.

    Attributes:
        scene: the rope.
        session: the episode.
        wish: what to do next, or None.
    """

    def __init__(self, client: Any, config: PageConfig, recorder: Recorder | None = None) -> None:
        self._config, self._recorder = config, recorder
        self.wish: Callable[[], None] | None = None
        self._failure = ""
        self._drag: tuple[int, Array] | None = None  # bead, and where to, metres
        self._kept: set[int] = set()  # episodes that are recorded
        self.session = Session(config.task, config.seed, recorder.next_number() if recorder else 0)
        self._client, self._closed, rope = client, threading.Event(), config.task.rope_config
        self.scene = RopeScene(client, self.session.points, rope)
        self._seconds_per_pull = rope.timestep * rope.frame_skip  # in rope time
        self._status = client.gui.add_markdown("")
        self._goal = client.gui.add_image(np.zeros((64, 64, 3), dtype=np.uint8))
        self._panel()
        self._show_start()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> str:
        """Stop acting; say why the episode couldn't be recorded, "" if it was."""
        self._closed.set()
        self._thread.join(_PATIENCE)
        if self._thread.is_alive():
            return f"episode {self.session.number} wasn't stored within {_PATIENCE:.0f} s"
        return self._failure

    # what the panel offers ---------------------------------------------------------------

    def _panel(self) -> None:
        gui = self._client.gui
        self._lift = gui.add_slider("Height of drags", -1.0, 1.0, 0.1, 0.0)
        buttons = (
            ("Z", "Undo", lambda: self._after(self.session.undo)),
            ("R", "Reset", lambda: self._after(partial(self.session.begin, self.session.number))),
            ("N", "Next start", self._next),
            ("P", "Let it pull once", self._policy_pull),
            ("V", "View from above", lambda: self.scene.look_from_above(self.session.points)),
        )
        for key, label, wish in buttons:
            gui.add_button(label).on_click(self._wanting(wish))
            gui.add_command(label, hotkey=key).on_trigger(self._wanting(wish))
        self._auto = gui.add_checkbox(f"Let {self._config.policy.policy} play", False)
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown(_KEYS)
        for modifier, lift in ((None, None), ("shift", 1.0), ("alt", -1.0)):
            self.scene.grips.on_drag("left", modifier=modifier)(self._dragging(lift))

    def _dragging(self, lift: float | None) -> Callable[[Any], None]:
        def _read_drag(event: Any) -> None:
            bead, place = event.instance_index, event.end_position
            if event.phase == "end" or type(bead) is not int or len(place) != 3:
                self._drag = None
                return
            target = np.array([_number(coordinate, _FARTHEST) for coordinate in place]) / SCALE
            points = self.session.points
            height = _number(self._lift.value, 1.0) if lift is None else lift
            if height:
                target[2] = points[:, 2].mean() + _LIFT * height
            self._drag = bead % len(points), target

        return _read_drag

    def _wanting(self, wish: Callable[[], None]) -> Callable[[Any], None]:
        """Return what leaves a wish; the latest one counts."""
        return lambda _: setattr(self, "wish", wish)

    # the tab's thread --------------------------------------------------------------------

    def _run(self) -> None:
        while not self._closed.is_set():
            began = time.monotonic()
            try:
                self._act()
            except (KnotgymError, OSError) as error:  # such as a full disk
                self._client.add_notification("knotgym", one_line(error), auto_close_seconds=10)
                self._auto.value = False
            self._closed.wait(max(0.0, 1 / _FRAMES - (time.monotonic() - began)))
        try:
            self._keep()
        except (KnotgymError, OSError) as error:
            self._failure = (
                f"episode {self.session.number} isn't stored ({one_line(error)}); the pulls that"
                " are in the journal are stored by the next session"
            )

    def _act(self) -> None:
        wish, self.wish = self.wish, None
        if wish is not None:
            wish()
        elif self._drag is not None:
            bead, target = self._drag
            self._pull(lambda: self.session.pull_towards(bead, target))
        elif self._auto.value and not self.session.ended:
            self._policy_pull()

    def _pull(self, pull: Callable[[], object]) -> None:
        """Pull, then show the way there for as long as the pull lasts in rope time."""
        before, taken = self.session.points.copy(), len(self.session.pulls)
        began = time.monotonic()
        pull()
        if len(self.session.pulls) == taken:
            return
        after, lasts = self.session.points.copy(), self._seconds_per_pull
        while (fraction := (time.monotonic() - began) / lasts) < 1 and not self._closed.is_set():
            shown = time.monotonic()
            self.scene.move((1 - fraction) * before + fraction * after)
            self._closed.wait(max(0.0, 1 / _FRAMES - (time.monotonic() - shown)))
        self._show()
        self._note()

    def _policy_pull(self) -> None:
        self._pull(lambda: self.session.let_act(self._config.policy))

    def _after(self, change: Callable[[], None]) -> None:
        change()
        self._note()
        self._show()

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
            self._recorder.finish(session.number, session.pulls)
            # not before, so that an episode that couldn't be stored is tried again
            self._kept.add(session.number)

    # what the tab shows ------------------------------------------------------------------

    def _show_start(self) -> None:
        self._goal.image = draw_diagram(self.session.batch.goal_points(0), self.scene.goal_size)
        self.scene.look_from_above(self.session.points)
        self._show()

    def _show(self) -> None:
        points = self.session.points
        self.scene.move(points, mark=True)
        session, rope = self.session, np.zeros(1, dtype=np.int64)
        (code,), (goal,) = session.batch.codes_of(rope), session.batch.goals_of(rope)
        state = f"{session.task.horizon - len(session.pulls)} pulls left"
        if session.success:
            state = "**the goal is reached**"
        elif session.ended:
            state = "**over**: no pulls left"
        recorded = "" if self._recorder is None else f", recorded in `{self._recorder.folder.name}`"
        if self._recorder is not None and any(pull.helped for pull in session.pulls):
            recorded = ", not recorded, because a policy helped"
        lines = (
            f"**{session.task.task}**, {session.task.nx} crossings, {session.task.split}"
            f" episode {session.number} ({session.task.engine}){recorded}",
            f"now `{str(code) or _LOOP}`",
            f"goal `{str(goal) or _LOOP}`",
            f"{state}; reward {session.reward:g}",
        )
        self._status.content = "\n\n".join(lines)


def _number(value: object, most: float) -> float:
    """Read a number that a browser sent: 0 for anything else, clipped to [-most, most].

    >>> [_number(one, 1.0) for one in ("0.5", 7, "x", float("nan"))]
    [0.5, 1.0, 0.0, 0.0]
    """
    try:
        read = float(str(value)[:40])
    except ValueError:
        return 0.0
    return min(max(read, -most), most) if read == read else 0.0
