"""One environment step on one core, ours against a plain Gymnasium loop over the published
settings.

    apt-get install libegl1 libosmesa6   # for MuJoCo's classic renderer in software GL
    python benchmarks/published.py [--out published.json] [--steps 20] [--repeats 7]

The plain loop: seven sub-chains rooted at their ends, `mujoco.mj_step` 24 times an action, our
label; for pixels MuJoCo's classic renderer at its default quality (multisampling, shadows of one
light, tessellation), the goal drawn once. Ours comes as it is, with 24 integrator steps an action,
and with `integrator_steps=20`. All sides take the same actions from the same kind of start, in
turn, on one pinned core, in CPU seconds of the process with all its threads; medians over the
repeats. Bars: 1.5 times as many steps with state observations, 15 times with pixels.
"""

import argparse
import json
import os
import platform
import statistics
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("LP_NUM_THREADS", "0")  # llvmpipe: draw in the thread that asks

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import knotgym
from knotgym.rope.model import Rope, RopeConfig
from knotgym.states.state_file import read_states, shipped
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

BARS = {"state": 1.5, "pixels": 15.0}
SIZE = 128


class Published(gym.Env[Any, NDArray[np.float32]]):
    """The published environment as one would write it down."""

    def __init__(self, observation: str) -> None:
        self.rope = Rope(RopeConfig(rooted="start"))
        self.data = mujoco.MjData(self.rope.model)
        pixels = gym.spaces.Box(0, 255, (SIZE, 2 * SIZE, 3), np.uint8)
        self.observation_space = (
            pixels
            if observation == "pixels"
            else gym.spaces.Box(-np.inf, np.inf, (600,), np.float32)
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
        states = read_states(shipped(), images=False)
        self.starts, self.goals = states.points[states.nx == 0], states.points[states.nx == 2]
        self.renderer = (
            mujoco.Renderer(self.rope.model, SIZE, SIZE) if observation == "pixels" else None
        )
        self.camera = mujoco.MjvCamera()
        self.camera.distance, self.camera.azimuth, self.camera.elevation = 0.8, 90.0, -90.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.goal = self.goals[self.np_random.integers(len(self.goals))]
        if self.renderer:
            self._lay(self.goal)
            self.goal_picture = self._picture()
        self._lay(self.starts[self.np_random.integers(len(self.starts))])
        self.goal_code = label(self.goal)
        return self._observation(), {"gauss_code": str(label(self._points()))}

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        config, points = self.rope.config, self._points()
        bead = int(np.argmin(((points - config.reach * action[:3]) ** 2).sum(axis=1)))
        self.data.xfrc_applied[self.rope.bodies[bead], :3] = config.max_force * action[3:]
        mujoco.mj_step(self.rope.model, self.data, config.frame_skip)
        self.data.xfrc_applied[:] = 0.0
        code: GaussCode = label(self._points())
        reached = code.matches(self.goal_code)
        info = {
            "gauss_code": str(code),
            "goal_gauss_code": str(self.goal_code),
            "crossings": code.nx,
            "is_success": reached,
        }
        return self._observation(), 5.0 * reached, reached, False, info

    def _lay(self, points: NDArray[np.float64]) -> None:
        mujoco.mj_resetData(self.rope.model, self.data)
        self.data.qpos[:] = self.rope.qpos(points)
        mujoco.mj_forward(self.rope.model, self.data)

    def _points(self) -> NDArray[np.float64]:
        return np.asarray(self.data.xpos[self.rope.bodies])

    def _observation(self) -> Any:
        if self.renderer:
            return np.concatenate([self._picture(), self.goal_picture], axis=1)
        return np.concatenate([self._points().ravel(), self.goal.ravel()]).astype(np.float32)

    def _picture(self) -> NDArray[np.uint8]:
        assert self.renderer is not None
        self.camera.lookat[:] = self._points().mean(axis=0)
        self.renderer.update_scene(self.data, self.camera)
        scene = self.renderer.scene
        lamp = scene.lights[scene.nlight]
        lamp.pos, lamp.dir, lamp.headlight, lamp.castshadow = (
            [0.0, 0.0, 3.0],
            [0.0, 0.0, -1.0],
            0,
            1,
        )
        lamp.diffuse, lamp.attenuation, lamp.cutoff = [0.7, 0.7, 0.7], [1.0, 0.0, 0.0], 45.0
        scene.nlight += 1
        picture: NDArray[np.uint8] = self.renderer.render()
        return picture


def seconds(env: gym.Env[Any, Any], actions: NDArray[np.float32]) -> float:
    """CPU seconds of a step."""
    env.reset(seed=0)
    began = time.process_time()
    for action in actions:
        env.step(action)
    return (time.process_time() - began) / len(actions)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20, help="actions an episode")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--modes", nargs="+", choices=tuple(BARS), default=list(BARS))
    parser.add_argument("--out", type=Path, default=Path("published.json"))
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rng = np.random.default_rng(0)
    rows: dict[str, dict[str, dict[str, float]]] = {}
    table = Table("observation", "side", "ms a step", "times as many steps", "bar")
    for mode in args.modes:
        # no episode ends early
        settings = {
            "nx": 2,
            "horizon": args.steps + 1,
            "hold": args.steps + 1,
        }
        sides: dict[str, gym.Env[Any, Any]] = {"published": Published(mode)}
        for steps in (24, 20):
            kind = {"observation": mode, "integrator_steps": steps, "disable_env_checker": True}
            sides[f"ours, {steps} steps"] = gym.make("knotgym/Tie-v0", **kind, **settings)
        taken: dict[str, list[float]] = {name: [] for name in sides}
        for repeat in range(args.repeats + 1):
            actions = rng.uniform(-1, 1, (args.steps, 6)).astype(np.float32)
            for name, env in sides.items():
                spent = seconds(env, actions)
                if repeat:  # the first warms up
                    taken[name].append(spent)
        rows[mode] = {}
        for name, times in taken.items():
            ratio = statistics.median(
                theirs / own for theirs, own in zip(taken["published"], times, strict=True)
            )
            rows[mode][name] = {"ms": 1000 * statistics.median(times), "times_as_many": ratio}
            table.add_row(
                mode, name, f"{rows[mode][name]['ms']:.2f}", f"{ratio:.2f}", f"{BARS[mode]:g}"
            )
    Console().print(table)
    about = {
        "knotgym": knotgym.__version__,
        "mujoco": mujoco.__version__,
        "python": platform.python_version(),
        "gl": os.environ.get("MUJOCO_GL"),
    }
    args.out.write_text(
        json.dumps(
            {
                "about": about,
                "steps": args.steps,
                "repeats": args.repeats,
                "modes": rows,
                "bars": BARS,
            },
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
