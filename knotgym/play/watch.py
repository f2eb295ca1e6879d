"""Watch the episodes of a dataset in the same scene, with a time line."""

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.play.page import FRAMES, Page, PlayConfig, number
from knotgym.play.scene import RopeScene
from knotgym.rendering.diagram import draw_diagram


class Viewer:
    """One tab that watches."""

    def __init__(self, client: Any, source: Any) -> None:
        """Open the dataset; each tab reads for itself."""
        self._reader = EpisodeReader(source)
        self._episode = self._reader.episode(0)
        rope = self._reader.task.rope
        self._lasts = rope.timestep * rope.frame_skip
        self._scene = RopeScene(client, self._episode.points[0], rope)
        gui, last = client.gui, len(self._reader) - 1
        self._status = gui.add_markdown("")
        self._goal = gui.add_image(self._drawn_goal())
        self._number = gui.add_slider("Episode", 0, max(1, last), 1, 0, disabled=not last)
        self._time = gui.add_slider("Pull", 0.0, float(len(self._episode)), 0.05, 0.0)
        self._playing = gui.add_checkbox("Play", True)
        self._speed = gui.add_slider("Times real time", 0.25, 4.0, 0.25, 1.0)
        self._closed, self._shown = threading.Event(), -1
        self._opened = 0
        self._scene.look_from_above(self._episode.points[0])
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the tab's thread and close the file."""
        self._closed.set()
        self._thread.join(timeout=10)
        self._reader.close()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._closed.wait(1 / FRAMES):
            now = time.monotonic()
            elapsed, before = now - before, now
            wanted = abs(int(number(self._number.value, len(self._reader) - 1)))
            if wanted != self._opened:
                self._open(wanted)
            last = float(len(self._episode))
            place = abs(number(self._time.value, last))
            if self._playing.value and place < last:
                place = min(last, place + elapsed * number(self._speed.value, 4.0) / self._lasts)
                self._time.value = max(0.0, place)
            self._show(place)

    def _open(self, wanted: int) -> None:
        self._opened, self._shown = wanted, -1
        self._episode = self._reader.episode(wanted)
        self._goal.image = self._drawn_goal()
        self._time.value, self._time.max = 0.0, float(len(self._episode))
        self._scene.look_from_above(self._episode.points[0])

    def _drawn_goal(self) -> NDArray[np.uint8]:
        return draw_diagram(self._episode.goal_points, self._scene.goal_size)

    def _show(self, place: float) -> None:
        episode = self._episode
        step = min(max(int(place), 0), len(episode))
        share, after = place - step, min(step + 1, len(episode))
        self._scene.move((1 - share) * episode.points[step] + share * episode.points[after])
        if step == self._shown:
            return
        self._shown = step
        self._scene.mark(episode.points[step])
        move = "" if episode.move is None else str(episode.move[after])
        pull = f"pull {after}: bead {episode.bead[after]}, {move}" if after > step else "the end"
        reached = ", **the goal**" if episode.is_success[step] else ""
        self._status.content = "\n\n".join(
            (
                f"episode {self._opened} of {len(self._reader)}, played by {episode.policy}",
                f"now `{episode.gauss_code[step] or 'plain loop'}`{reached}",
                f"goal `{episode.goal_gauss_code or 'plain loop'}`",
                f"step {step} of {len(episode)}; {pull}",
            )
        )


class WatchPage(Page):
    """A page on which every tab watches a dataset."""

    def __init__(self, config: PlayConfig, source: Any) -> None:
        """Serve the page.

        Raises:
            MissingFile, InvalidFile: there is no such dataset.
            Failed: as for `Page`.
        """
        EpisodeReader(source).close()
        self._source = source
        super().__init__(config)

    def _open(self, client: Any) -> Viewer:
        return Viewer(client, self._source)
