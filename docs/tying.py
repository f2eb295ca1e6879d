"""Film two ropes that the expert ties to the code of one goal, for the README.

    python docs/tying.py

Two starts are pulled to the same goal at once; each ends in a shape of its own. Frames between two
states of a rope, which are 0.192 s apart, are interpolated and last 0.32 s.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from knotgym.common import Array
from knotgym.control import PolicyConfig
from knotgym.datasets import Episodes, open_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import CollectConfig, collect
from knotgym.rendering import Film, draw_diagram
from knotgym.rope import CHAIN
from knotgym.runs import Progress, RunOptions
from knotgym.topology import label

Canvas = NDArray[np.uint8]

PAGES = Path(__file__).parent
EPISODES = (20, 36)  # two of the test split that have the same goal
_SIDE, _TEXT, _GAP = 256, 44, 6  # pixels
_BETWEEN, _SECONDS, _PAUSE = 4, 0.08, 3.0  # frames for each pull; seconds a frame, and at the end
_FONT, _WHITE, _GREY = cv2.FONT_HERSHEY_SIMPLEX, (235, 235, 235), (150, 150, 150)


def played() -> Episodes:
    """Let the expert play in the chain engine; return the two episodes."""
    task = TaskConfig(task="tie", nx=3, split="test", states="bench", engine=CHAIN)
    count = max(EPISODES) + 1
    config = CollectConfig(task=task, policy=PolicyConfig(policy="expert"), episodes=count)
    with tempfile.TemporaryDirectory() as room:
        options, progress = RunOptions(workers=1, quiet=True), Progress(quiet=True)
        dataset = collect(config, Path(room), options, progress=progress)
        return open_episodes(dataset).episodes.select(EPISODES)


def frames(episodes: Episodes) -> list[Canvas]:
    """Draw the goal between both ropes: uint8 (height, width, 3) each, RGB."""
    goal = episodes.episodes["goal_points"][0].astype(np.float64)
    columns = [_columns(episodes.select([row]), str(label(goal))) for row in range(2)]
    middle = _panel(goal, None, "goal", str(label(goal)))
    count = max(map(len, columns))
    gap = np.zeros((len(middle), _GAP, 3), np.uint8)
    return [
        np.concatenate(
            [columns[0][min(k, len(columns[0]) - 1)], gap, middle, gap]
            + [columns[1][min(k, len(columns[1]) - 1)]],
            axis=1,
        )
        for k in range(count)
    ]


def _columns(episode: Episodes, goal_code: str) -> list[Canvas]:
    """Draw one rope, from its start to the goal's code."""
    ropes = episode.steps["observation"].astype(np.float64)
    side, length = _side(episode), len(ropes) - 1
    found = list[Canvas]()
    for step in range(length):
        pull = int(episode.steps["bead"][step]), episode.steps["force"][step].astype(np.float64)
        code = str(label(ropes[step])) or "plain loop"
        for part in range(_BETWEEN):
            rope = ropes[step] + part / _BETWEEN * (ropes[step + 1] - ropes[step])
            found.append(_panel(rope, side, f"pull {step + 1} of {length}", code, pull))
    code = str(label(ropes[-1]))
    assert code == goal_code
    return [*found, _panel(ropes[-1], side, "the same code, another shape", code, reached=True)]


def _side(episode: Episodes) -> float:
    """Return the side of a square in which the rope always fits, metres."""
    ropes = episode.steps["observation"].astype(np.float64)
    return 1.2 * float(np.ptp(ropes[..., :2], axis=1).max())


def _panel(
    rope: Array,
    side: float | None,
    heading: str,
    code: str,
    pull: tuple[int, Array] | None = None,
    *,
    reached: bool = False,
) -> Canvas:
    """Draw a rope with the pull as an arrow, and below it what it is and its code."""
    strip = np.zeros((_TEXT, _SIDE, 3), np.uint8)
    colour = Film.OUTCOMES["reached"] if reached else _GREY
    cv2.putText(strip, heading, (6, 16), _FONT, 0.45, colour, 1, cv2.LINE_AA)
    cv2.putText(strip, code, (6, 36), _FONT, 0.45, _WHITE, 1, cv2.LINE_AA)
    picture = np.concatenate([draw_diagram(rope, _SIDE, side=side, pull=pull), strip])
    if reached:
        cv2.rectangle(picture, (1, 1), (_SIDE - 2, len(picture) - 2), colour, 2)
    return picture


def write(path: Path, pictures: list[Canvas]) -> None:
    """Write frames as a GIF with one palette, that of the last frame."""
    palette = Image.fromarray(pictures[-1]).quantize(128)
    images = [
        Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures
    ]
    lasting = [round(1000 * _SECONDS)] * (len(images) - 1) + [round(1000 * _PAUSE)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=lasting, loop=0)


if __name__ == "__main__":
    write(PAGES / "tying.gif", frames(played()))
