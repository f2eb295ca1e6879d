"""Write a dataset as a LeRobot dataset (v3.0), with LeRobot's own writer and statistics.

    pip install lerobot
    python examples/learners/to_lerobot.py knotgym/unknot-nx2/expert-v0 --out unknot-lerobot

A frame is a state in which a pull was made: the picture of the rope and of the goal, the vertices
of rope and goal relative to the rope's centre, and the pull; LeRobot keeps no last state. The task
is the goal's Gauss code.
"""

import argparse
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from knotgym.datasets.episode_dataset import columns_of
from knotgym.loaders import arrays

FPS = 5  # an action takes 0.192 s


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", help="Minari id or folder")
    parser.add_argument("--id", default="knotgym/unknot-nx2", help="LeRobot's repository id")
    parser.add_argument("--videos", action="store_true", help="encode pictures as films, lossy")
    parser.add_argument("--out", type=Path, required=True, help="folder to create")
    given = parser.parse_args()
    columns = arrays(given.data, observation="both")
    pixels, states = columns["observations"]["pixels"], columns["observations"]["state"]
    opened = columns_of(given.data)
    size = pixels.shape[1]
    picture = {"dtype": "video" if given.videos else "image", "shape": (size, size, 3)}
    features = {
        "observation.images.rope": picture | {"names": ["height", "width", "channels"]},
        "observation.images.goal": picture | {"names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": states.shape[1:], "names": None},
        "action": {"dtype": "float32", "shape": (6,), "names": ["x", "y", "z", "fx", "fy", "fz"]},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }
    made = LeRobotDataset.create(
        given.id, FPS, features, root=given.out, robot_type="rope", use_videos=given.videos
    )
    row = 0
    for length, visits in zip(
        opened.episodes.episodes["length"], opened.episodes.episodes["goal_visits"], strict=True
    ):
        goal = ",".join(f"{abs(v)}{'+' if v > 0 else '-'}" for v in visits[visits != 0].tolist())
        for _ in range(int(length)):
            done = columns["terminals"][row] or columns["timeouts"][row]
            made.add_frame(
                {
                    "observation.images.rope": pixels[row][:, :size],
                    "observation.images.goal": pixels[row][:, size:],
                    "observation.state": np.asarray(states[row], dtype=np.float32),
                    "action": np.asarray(columns["actions"][row], dtype=np.float32),
                    "next.reward": np.array([columns["rewards"][row]], dtype=np.float32),
                    "next.done": np.array([bool(done)]),
                    "task": f"reach the Gauss code {goal or 'of the plain loop'}",
                }
            )
            row += 1
        made.save_episode()
    made.finalize()
    print(f"{given.out}: {opened.episodes.episodes.rows} episodes, {row} frames")


if __name__ == "__main__":
    main()
