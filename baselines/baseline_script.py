"""Shared by the baseline scripts: options, one-line errors, folders and progress of trainings."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from knotgym.common.atomic_files import atomic_write, require_writable
from knotgym.common.configuration import differences
from knotgym.common.errors import InvalidInput, KnotgymError, one_line
from knotgym.control.policy_config import PolicyConfig
from knotgym.envs.task_states import state_origins
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.evaluate_config import EvaluateConfig

PROGRESS = "progress.json"


class _OneLine(argparse.ArgumentParser):
    """Raise usage errors as InvalidInput, for one line of output."""

    def error(self, message: str) -> NoReturn:
        raise InvalidInput(f"{message}; see --help")


def parser(description: str, steps: str) -> argparse.ArgumentParser:
    """Return the options of every script; `steps` is the help text of --steps."""
    options = _OneLine(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--task", default="unknot", help="unknot, tie or convert")
    options.add_argument("--nx", type=int, default=2)
    options.add_argument("--states", help="readable (default), random-walk or a state file")
    options.add_argument("--image-size", type=int, default=128)
    options.add_argument("--steps", type=int, default=1_000_000, help=steps)
    options.add_argument("--out", type=Path, required=True, help="folder to create")
    options.add_argument("--resume", action="store_true", help="continue from the last checkpoint")
    options.add_argument("--split", default="train,test", help="splits to evaluate on")
    options.add_argument(
        "--episodes", type=int, default=384, help="evaluated per split; 0 for none"
    )
    options.add_argument("--quiet", action="store_true")
    return options


def run(train: Callable[[argparse.Namespace], None], options: argparse.ArgumentParser) -> None:
    """Train with the options of the command line; exit with status 2 and one line on an error."""
    try:
        train(options.parse_args())
    except KnotgymError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped; --resume continues from the last checkpoint", file=sys.stderr)
        sys.exit(130)


def evaluation_settings(given: argparse.Namespace, task: TaskConfig) -> dict[str, Any] | None:
    """Return the settings of the evaluation after training; None if there is none.

    Raises:
        InvalidInput, InvalidInput: a setting is invalid or its states are missing.
    """
    state_origins(task)
    if given.episodes == 0:
        return None
    settings: dict[str, Any] = {
        "tasks": (task.task,),
        "nx": (task.nx,),
        "splits": tuple(given.split.split(",")),
        "episodes": given.episodes,
        "task": task,
    }
    for _, setup in EvaluateConfig(policies=(PolicyConfig(),), **settings).setups():
        state_origins(setup)
    return settings


def require_folder(out: Path, name: str, request: dict[str, Any], resume: bool) -> None:
    """Check that a folder is empty, or, to resume, that it holds a training with these settings.

    Raises:
        InvalidInput: it isn't, or it doesn't.
        Failed: nothing can be written there.
    """
    if not resume:
        require_writable(out / name)
        if out.is_file() or (out.is_dir() and any(out.iterdir())):
            raise InvalidInput(
                f"{out} isn't empty; name a new folder, or --resume the training in it"
            )
        return
    try:
        before = json.loads((out / name).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"no training of this script in {out}; leave out --resume to begin one"
        ) from error
    if found := list(differences(before, request)):
        raise InvalidInput(f"the training in {out} has other settings: {'; '.join(found)}")


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON file atomically, creating its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


class Progress:
    """Steps and time spent by a training over all its runs, kept in `progress.json`.

    Attributes:
        steps: environment steps when the file was last written.
        resumed_at: steps at which the training was resumed.
    """

    def __init__(self, folder: Path, resume: bool) -> None:
        self._path = folder / PROGRESS
        fields: dict[str, Any] = {"steps": 0, "resumed_at": [], "seconds": 0.0, "cpu_seconds": 0.0}
        if resume and self._path.exists():
            try:
                fields |= json.loads(self._path.read_text(encoding="utf-8"))
            except (OSError, ValueError, TypeError) as error:
                raise InvalidInput(f"{self._path} is corrupted") from error
        self.steps = int(fields["steps"])
        self.resumed_at = [int(one) for one in fields["resumed_at"]]
        self._began = time.perf_counter() - float(fields["seconds"])
        self._spent = time.process_time() - float(fields["cpu_seconds"])

    def resume(self, goal: int) -> None:
        """Note that the training is resumed here, unless it has reached `goal` steps."""
        if 0 < self.steps < goal:
            self.resumed_at = [one for one in self.resumed_at if one < self.steps] + [self.steps]

    def write(self, steps: int) -> None:
        """Write the file once a checkpoint of `steps` steps exists."""
        self.steps = steps
        write_json(self._path, self.as_json())

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the file."""
        return {
            "steps": self.steps,
            "resumed_at": self.resumed_at,
            "seconds": round(time.perf_counter() - self._began, 1),
            "cpu_seconds": round(time.process_time() - self._spent, 1),
        }
