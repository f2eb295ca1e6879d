"""Watch the episodes of a dataset in the same scene, with a time line."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from knotgym.datasets.episode_dataset import columns_of
from knotgym.play.page import LOOP, Tab, number
from knotgym.topology.code_arrays import plain_code


class WatchTab(Tab):
    """A tab that shows episodes."""

    def __init__(self, client: Any, source: Any) -> None:
        """Open a dataset; each tab maps the file for itself."""
        dataset = columns_of(source)
        self._all = dataset.episodes
        self._open(0)
        super().__init__(client, self._points[0], dataset.task.rope)
        gui, last = client.gui, self._all.episodes.rows - 1
        self._number = gui.add_slider("Episode", 0, max(1, last), 1, 0, disabled=not last)
        self._time = gui.add_slider("Pull", 0.0, float(self._length), 0.05, 0.0)
        self._playing = gui.add_checkbox("Play", True)
        self._speed = gui.add_slider("Times real time", 0.25, 4.0, 0.25, 1.0)
        self._before = time.monotonic()
        self._begin()
        self.start()

    def _act(self) -> None:
        now = time.monotonic()
        elapsed, self._before = now - self._before, now
        wanted = abs(int(number(self._number.value, self._all.episodes.rows - 1)))
        if wanted != self._opened:
            self._open(wanted)
            self._time.value, self._time.max = 0.0, float(self._length)
            self._begin()
        last = float(self._length)
        place = abs(number(self._time.value, last))
        if self._playing.value and place < last:
            pulls = elapsed * number(self._speed.value, 4.0) / self.seconds_per_pull
            place = min(last, place + pulls)
            self._time.value = max(0.0, place)
        self._show(place)

    def _open(self, wanted: int) -> None:
        first = int(self._all.offsets[wanted])
        self._opened, self._length = wanted, int(self._all.episodes["length"][wanted])
        self._steps = self._all.steps.take(slice(first, first + self._length + 1))
        self._points = self._steps["observation"].astype(np.float64)

    def _begin(self) -> None:
        goal = self._all.episodes["goal_points"][self._opened].astype(np.float64)
        self.show_start(self._points[0], goal)
        self._shown = -1  # step

    def _show(self, place: float) -> None:
        step = min(max(int(place), 0), self._length)
        share, after = place - step, min(step + 1, self._length)
        self.scene.move((1 - share) * self._points[step] + share * self._points[after])
        if step == self._shown:
            return
        self._shown = step
        self.scene.mark(self._points[step])
        row = self._all.episodes.take(slice(self._opened, self._opened + 1))
        code = plain_code(self._steps["visits"][step])
        goal = plain_code(row["goal_visits"][0])
        pull = f"bead {self._steps['bead'][step]} is pulled next" if after > step else "the end"
        reached = ", **the goal**" if code == goal else ""
        self.say(
            f"episode {self._opened} of {self._all.episodes.rows}, played by {row['policy'][0]}",
            f"now `{code or LOOP}`{reached}",
            f"goal `{goal or LOOP}`",
            f"step {step} of {self._length}; {pull}",
        )


def watching(source: Any) -> Callable[[Any], WatchTab]:
    """Return what opens a tab on a dataset, for `Page`.

    Raises:
        MissingFile, InvalidFile: there is no such dataset.
    """
    columns_of(source)
    return lambda client: WatchTab(client, source)
