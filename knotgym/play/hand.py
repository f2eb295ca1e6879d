"""A tab in which the rope is pulled by hand.

What a browser sends (drags, buttons, keys) only leaves a wish, and the tab's thread acts on the
latest one. So a tab that sends thousands of messages a second delays nobody else's rope, and
nothing that a browser sends is used as a path, a name to import, or a size.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from knotgym.play.page import FRAMES, LOOP, Tab, number
from knotgym.play.page_config import PageConfig
from knotgym.play.recorder import Recorder
from knotgym.play.scene import SCALE
from knotgym.play.session import Session
from knotgym.rope.model import Array

_LIFT = 0.03  # metres above or below the rope's middle height at which a drag leads a bead
_FARTHEST = 100.0  # scene units from the origin at which a drag is read
_WALK = 25.0  # beads per second of the walker
_NO_PATH = np.empty((0, 3))
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


class HandTab(Tab):
    """A tab with a session of its own.

    Attributes:
        session: the episode.
        wish: what to do next, or None.
    """

    def __init__(self, client: Any, config: PageConfig, recorder: Recorder | None = None) -> None:
        self._config, self._recorder = config, recorder
        self.wish: Callable[[], None] | None = None
        self._drag: tuple[int, Array] | None = None  # bead, and where to, metres
        self._selected, self._walk_from = 0, 0.0
        self._kept: set[int] = set()  # episodes that are recorded
        self.session = Session(config.task, config.seed, recorder.next_number() if recorder else 0)
        super().__init__(client, self.session.points, config.task.rope)
        self._panel()
        self._show_start()
        self.start()

    # what the panel offers ---------------------------------------------------------------

    def _panel(self) -> None:
        gui = self._client.gui
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

    def _failed(self) -> None:
        self._auto.value = False

    def _end(self) -> None:
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
        after, lasts = self.session.points.copy(), self.seconds_per_pull
        self.scene.draw_path(_NO_PATH)
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
        line = f"**{self._config.policy}** pulls bead {seen.bead}, to `{seen.code or LOOP}`"
        self._show(line + (" (the goal)" if seen.success else ""), seen.path)

    def _select(self, step: int) -> None:
        self._selected = (self._selected + step) % len(self.session.points)
        self.scene.walk(self.session.points, float(self._selected))

    def _start_walk(self) -> None:
        self._walk_from = time.monotonic()

    # what the tab shows ------------------------------------------------------------------

    def _show_start(self) -> None:
        self.show_start(self.session.points, self.session.batch.goal_points(0))
        self._show()

    def _show(self, line: str = "", path: Array = _NO_PATH) -> None:
        self.scene.draw_path(path)
        points = self.session.points
        self.scene.move(points)
        self.scene.mark(points)
        self._say(line)

    def _say(self, line: str) -> None:
        session, rope = self.session, np.zeros(1, dtype=np.int64)
        (code,), (goal,) = session.batch.codes_of(rope), session.batch.goals_of(rope)
        state = "**the goal is reached**" if session.success else f"{session.left} pulls left"
        if session.ended and not session.success:
            state = "**over**: no pulls left"
        recorded = "" if self._recorder is None else f", recorded in `{self._recorder.folder.name}`"
        if self._recorder is not None and session.helped:
            recorded = ", not recorded, because a policy helped"
        self.say(
            f"**{session.task.task}**, {session.task.nx} crossings, {session.task.split}"
            f" episode {session.number} ({session.task.engine}){recorded}",
            f"now `{str(code) or LOOP}`",
            f"goal `{str(goal) or LOOP}`",
            f"{state}; reward {session.reward:g}",
            line,
        )
