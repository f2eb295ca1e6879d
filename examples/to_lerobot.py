"""Write a dataset in LeRobot's format, by LeRobot's own library (0.4 or newer).

    python examples/to_lerobot.py knotgym/tie-nx2/expert-v0 --out tie-lerobot
    python examples/to_lerobot.py knotgym/tie-nx2/expert-v0 --out tie-video --video

A frame holds an observation, the action taken and its outcome. The last state of an episode has no
action and therefore no frame. The task is a sentence with the Gauss code of the goal. LeRobot's
policies need `observation.state`, elsewhere the joints of a robot: here it is the centre of the
rope, on which pictures are centred, so that a place in the picture can be turned into an action.
"""

from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run

try:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
except ModuleNotFoundError as error:
    raise SystemExit("to_lerobot.py needs LeRobot: pip install 'lerobot>=0.4'") from error

from knotgym.loaders import Transitions
from knotgym.topology import CodeArrays

FRAMES_PER_SECOND = 5  # an action takes 0.192 s
NUMBERS = {
    "observation.state": ("float32", 3),
    "observation.environment_state": ("float32", 600),
    "action": ("float32", 6),
    "next.reward": ("float32", 1),
    "next.done": ("bool", 1),
    "next.success": ("bool", 1),
}


def task_text(goal: str) -> str:
    """Describe a goal in words."""
    if not goal:
        return "Untie the rope into a plain loop."
    return f"Move the rope until its Gauss code is {goal}."


def features(shape: tuple[int, ...], video: bool) -> dict[str, Any]:
    """Return LeRobot's description of a frame; `shape` is that of the pictures."""
    kind = "video" if video else "image"
    names = ["height", "width", "channels"]
    found: dict[str, Any] = {"observation.image": {"dtype": kind, "shape": shape, "names": names}}
    for name, (dtype, size) in NUMBERS.items():
        found[name] = {"dtype": dtype, "shape": (size,), "names": None}
    return found


def convert(dataset: str, *, out: Path, video: bool = False) -> None:
    """Write a dataset in LeRobot's format.

    Args:
        dataset: a Minari id, a folder or an episode file.
        out: folder to create.
        video: store pictures as video, which is lossy.
    """
    opened = Transitions(dataset, observation="both", action="pull")
    episodes = opened.dataset.episodes
    reached = episodes.goal_reached(opened.task)
    goals = CodeArrays(episodes.episodes["goal_visits"]).texts()
    shape = opened.observations(0, 0, 1)["pixels"].shape[1:]
    made = LeRobotDataset.create(
        f"knotgym/{out.name}",
        fps=FRAMES_PER_SECOND,
        features=features(shape, video),
        root=out,
        use_videos=video,
    )
    for k, (first, last) in enumerate(zip(opened.starts[:-1], opened.starts[1:], strict=True)):
        seen = opened.observations(k)
        success = reached[episodes.offsets[k] + 1 : episodes.offsets[k + 1]]
        done = opened.terminals[first:last] | opened.timeouts[first:last]
        for t, action in enumerate(opened.actions[first:last]):
            rope = seen["state"][t][:300].reshape(-1, 3)
            frame = {
                "observation.image": seen["pixels"][t],
                "observation.state": rope.mean(axis=0),
                "observation.environment_state": seen["state"][t],
                "action": action,
                "next.reward": np.array([opened.rewards[first + t]], np.float32),
                "next.done": done[t : t + 1],
                "next.success": success[t : t + 1],
                "task": task_text(str(goals[k])),
            }
            made.add_frame(frame)
        made.save_episode()
    made.finalize()
    print(f"{out}: {len(goals)} episodes")


if __name__ == "__main__":
    run(convert)
