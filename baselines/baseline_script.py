"""What the scripts of the baselines share: options, refusals in one line, the folder of a training,
and what a learner is tried at.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from knotgym.cli.options import words
from knotgym.common.atomic_files import atomic_write, require_writable
from knotgym.common.configuration import differences
from knotgym.common.errors import KnotgymError, one_line
from knotgym.control.policies import PolicyConfig
from knotgym.envs.episode_batch import state_origins
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.evaluate import EvaluateConfig

PROGRESS = "progress.json"


class InvalidBaseline(KnotgymError, ValueError):
    """A training that can't be done as asked."""


class _OneLine(argparse.ArgumentParser):
    """Says in one line what is wrong."""

    def error(self, message: str) -> NoReturn:
        raise InvalidBaseline(f"{message}; see --help")


def parser(description: str, steps: str) -> argparse.ArgumentParser:
    """The options of every script; `steps` says where --steps ends."""
    options = _OneLine(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--task", default="unknot", help="unknot, tie or convert")
    options.add_argument("--nx", type=int, default=2)
    options.add_argument("--states", help="readable (default), random-walk or a state file")
    options.add_argument("--image-size", type=int, default=128)
    options.add_argument("--steps", type=int, default=1_000_000, help=steps)
    options.add_argument("--out", type=Path, required=True, help="folder to make")
    options.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    options.add_argument("--split", default="train,test", help="to be tried on")
    options.add_argument("--episodes", type=int, default=384, help="tried of each split; 0: not")
    options.add_argument("--quiet", action="store_true")
    return options


def run(train: Callable[[argparse.Namespace], None], options: argparse.ArgumentParser) -> None:
    """Train as the command line asks; what can't be had ends it with status 2 and one line."""
    try:
        train(options.parse_args())
    except KnotgymError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped; --resume goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)


def trials(given: argparse.Namespace, task: TaskConfig) -> dict[str, Any] | None:
    """What the learner will be tried at, once all states for it are found; None for nothing.

    Raises:
        InvalidSetting, InvalidEvaluation: something that can't be had.
    """
    state_origins(task)
    if given.episodes == 0:
        return None
    settings: dict[str, Any] = {
        "tasks": (task.task,),
        "nx": (task.nx,),
        "splits": words(given.split),
        "episodes": given.episodes,
        "task": task,
    }
    for _, setup in EvaluateConfig(policies=(PolicyConfig(),), **settings).setups():
        state_origins(setup)
    return settings


def require_folder(out: Path, name: str, request: dict[str, Any], resume: bool) -> None:
    """Refuse a folder that holds something already, or, to resume, no training asked for alike.

    Raises:
        InvalidBaseline, Unwritable: so it is.
    """
    if not resume:
        require_writable(out / name)
        if out.is_file() or (out.is_dir() and any(out.iterdir())):
            raise InvalidBaseline(
                f"{out} holds something already; name a new folder, or --resume a training in it"
            )
        return
    try:
        before = json.loads((out / name).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidBaseline(
            f"no training of this script in {out}; leave --resume out to begin one"
        ) from error
    if found := list(differences(before, request)):
        raise InvalidBaseline(f"{out} was begun otherwise: {'; '.join(found)}")


def write_json(path: Path, told: dict[str, Any]) -> None:
    """Write all of it or nothing; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


class Progress:
    """How far a training is and what it took, of all its runs, in `progress.json`.

    Attributes:
        steps: made, as of the last time it was written.
        resumed_at: steps at which an earlier run was gone on with.
    """

    def __init__(self, folder: Path, resume: bool) -> None:
        self._path = folder / PROGRESS
        told: dict[str, Any] = {"steps": 0, "resumed_at": [], "seconds": 0.0, "cpu_seconds": 0.0}
        if resume and self._path.exists():
            try:
                told |= json.loads(self._path.read_text(encoding="utf-8"))
            except (OSError, ValueError, TypeError) as error:
                raise InvalidBaseline(f"{self._path} can't be gone on from") from error
        self.steps = int(told["steps"])
        self.resumed_at = [int(one) for one in told["resumed_at"]]
        self._began = time.perf_counter() - float(told["seconds"])
        self._spent = time.process_time() - float(told["cpu_seconds"])

    def gone_on(self, goal: int) -> None:
        """A run goes on from here, unless it has nothing to do."""
        if 0 < self.steps < goal:
            self.resumed_at = [one for one in self.resumed_at if one < self.steps] + [self.steps]

    def write(self, steps: int) -> None:
        """So many steps are made, and could be gone on from."""
        self.steps = steps
        write_json(self._path, self.told())

    def told(self) -> dict[str, Any]:
        """All of it, as JSON."""
        return {
            "steps": self.steps,
            "resumed_at": self.resumed_at,
            "seconds": round(time.perf_counter() - self._began, 1),
            "cpu_seconds": round(time.process_time() - self._spent, 1),
        }
