"""Watch the episodes of a dataset in the same scene, with a time line."""

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_dataset import columns_of
from knotgym.play.page import FRAMES, Page, number
from knotgym.play.page_config import PageConfig
from knotgym.play.scene import RopeScene
from knotgym.rendering.diagram import draw_diagram
from knotgym.topology.code_arrays import plain_code


class Viewer:
    """One tab that watches."""

    def __init__(self, client: Any, source: Any) -> None:
        """Open the dataset; each tab maps the file for itself."""
        dataset = columns_of(source)
        self._all, rope = dataset.episodes, dataset.task.rope
        self._open(0)
        self._lasts = rope.timestep * rope.frame_skip
        self._scene = RopeScene(client, self._points[0], rope)
        gui, last = client.gui, self._all.episodes.rows - 1
        self._status = gui.add_markdown("")
        self._goal = gui.add_image(self._drawn_goal())
        self._number = gui.add_slider("Episode", 0, max(1, last), 1, 0, disabled=not last)
        self._time = gui.add_slider("Pull", 0.0, float(self._length), 0.05, 0.0)
        self._playing = gui.add_checkbox("Play", True)
        self._speed = gui.add_slider("Times real time", 0.25, 4.0, 0.25, 1.0)
        self._closed, self._shown = threading.Event(), -1
        self._scene.look_from_above(self._points[0])
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the tab's thread."""
        self._closed.set()
        self._thread.join(timeout=10)

    def _run(self) -> None:
        before = time.monotonic()
        while not self._closed.wait(1 / FRAMES):
            now = time.monotonic()
            elapsed, before = now - before, now
            wanted = abs(int(number(self._number.value, self._all.episodes.rows - 1)))
            if wanted != self._opened:
                self._open(wanted)
                self._goal.image, self._shown = self._drawn_goal(), -1
                self._time.value, self._time.max = 0.0, float(self._length)
                self._scene.look_from_above(self._points[0])
            last = float(self._length)
            place = abs(number(self._time.value, last))
            if self._playing.value and place < last:
                place = min(last, place + elapsed * number(self._speed.value, 4.0) / self._lasts)
                self._time.value = max(0.0, place)
            self._show(place)

    def _open(self, wanted: int) -> None:
        first = int(self._all.offsets[wanted])
        self._opened, self._length = wanted, int(self._all.episodes["length"][wanted])
        self._steps = self._all.steps.take(slice(first, first + self._length + 1))
        self._points = self._steps["observation"].astype(np.float64)

    def _drawn_goal(self) -> NDArray[np.uint8]:
        points = self._all.episodes["goal_points"][self._opened].astype(np.float64)
        return draw_diagram(points, self._scene.goal_size)

    def _show(self, place: float) -> None:
        step = min(max(int(place), 0), self._length)
        share, after = place - step, min(step + 1, self._length)
        self._scene.move((1 - share) * self._points[step] + share * self._points[after])
        if step == self._shown:
            return
        self._shown = step
        self._scene.mark(self._points[step])
        row = self._all.episodes.take(slice(self._opened, self._opened + 1))
        code = plain_code(self._steps["visits"][step])
        goal = plain_code(row["goal_visits"][0])
        pull = f"bead {self._steps['bead'][step]} is pulled next" if after > step else "the end"
        reached = ", **the goal**" if code == goal else ""
        self._status.content = "\n\n".join(
            (
                f"episode {self._opened} of {self._all.episodes.rows}, played by"
                f" {row['policy'][0]}",
                f"now `{code or 'plain loop'}`{reached}",
                f"goal `{goal or 'plain loop'}`",
                f"step {step} of {self._length}; {pull}",
            )
        )


class WatchPage(Page):
    """A page on which every tab watches a dataset."""

    def __init__(self, config: PageConfig, source: Any) -> None:
        """Serve the page.

        Raises:
            MissingFile, InvalidFile: there is no such dataset.
            Failed: as for `Page`.
        """
        columns_of(source)
        self._source = source
        super().__init__(config)

    def _open(self, client: Any) -> Viewer:
        return Viewer(client, self._source)
