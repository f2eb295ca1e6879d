"""The engine of long runs, which executes a recipe for states, episodes or pictures.

A run works in a hidden staging folder beside its output (see `staging`), and only a finished folder
gets the final name. The staging folder holds the *request*: everything that determines the output,
with configuration and versions. A killed run can be resumed from its last checkpoint if the request
is the same; otherwise the error names the differences.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor as Pool
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import mujoco
import numpy as np

import knotgym
from knotgym.common.atomic_files import atomic_write, move_into_place, remove, require_output
from knotgym.common.configuration import differences, read_json
from knotgym.common.errors import InvalidInput, Occupied
from knotgym.rope.model import RopeConfig
from knotgym.runs.compilation import compile_first
from knotgym.runs.executors import executor
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import Existing, RunOptions
from knotgym.runs.shards import Shard
from knotgym.runs.staging import (
    discard,
    has_work,
    is_held,
    may_be_finished,
    require_no_interrupted_run,
    staging,
    staging_folder,
)

REQUEST = "request.json"
LISTED = ("config", "source", "shard", "versions", "rope")  # fields of a request, in manifests too


@dataclass(frozen=True)
class Batch:
    """Independent units of work."""

    # function of one unit, at the top level of a module so that it can be pickled
    work: Callable[[Any], Any]
    units: Sequence[Any]  # arguments of `work`; iterated once
    # called in this process with each unit and its result, in the order of the units
    absorb: Callable[[Any, Any], None]
    name: str = "working"  # description shown as progress

    def follow(self, pool: Pool) -> Iterator[None]:
        """Run the work on a pool; yield after each absorbed unit."""
        for unit, result in zip(self.units, pool.map(self.work, self.units), strict=True):
            self.absorb(unit, result)
            yield


CHECKPOINT = Batch(
    work=id, units=(), absorb=max, name="saving"
)  # no work; a recipe yields it when `save` may be called


class Recipe(Protocol):
    """One kind of run. Its methods run in the main process, only `Batch.work` runs on workers.

    `flexible` names the fields of the configuration that may change when a run is resumed.
    `engine` is the simulation engine, whose kernels are compiled before the workers start, and
    `draws` tells whether the kernels that draw states are, too.
    `begin`, `load` and `save` do nothing by default, for recipes whose units write their own files.
    """

    flexible: tuple[str, ...] = ()
    engine: str
    draws: bool = False

    def request(self) -> dict[str, Any]:
        """Return the configuration and sources as JSON: `{"config": {...}, "source": ...}`."""

    def begin(self) -> None:
        """Prepare a new run before anything is written; raise if it can't be done."""
        return

    def load(self, folder: Path) -> bool:
        """Restore a checkpoint from the staging folder; return False if there is none."""
        return False

    def save(self, folder: Path) -> None:
        """Write a checkpoint to the staging folder."""
        return

    def pool(self, options: RunOptions) -> AbstractContextManager[Pool]:
        """Return the pool that runs the work."""
        return executor(options.workers, options.scheduler)

    def batches(self, folder: Path) -> Iterator[Batch]:
        """Yield the remaining work, chosen as results come in; `folder` is the staging folder."""

    def status(self) -> Status:
        """Return the progress of the run."""

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        """Write the output below the new folder `folder`; return the folder to move into place."""

    def summary(self) -> str:
        """Return a one-line description of the output."""


def run(
    recipe: Recipe,
    out: Path,
    options: RunOptions,
    progress: Progress | None = None,
    *,
    is_folder: bool = True,
    made_by: Callable[[Path], dict[str, Any] | None] | None = None,
) -> Path:
    """Execute a recipe and return its output.

    Args:
        recipe: what to make.
        is_folder: whether `out` is a folder.
        made_by: path of an output -> the request of its run, or None; by default `request_of`.

    Raises:
        Occupied: the output exists, another run holds its staging folder, or that was removed.
        Failed: the output can't be written.
        InvalidInput: the run to resume had another request.
        KnotgymError: the recipe can't be executed, or its budget is used up.
    """
    if progress is None:
        with Progress(options.quiet) as progress:
            return run(recipe, out, options, progress, is_folder=is_folder, made_by=made_by)
    began = time.perf_counter()
    request = whole_request(recipe.request(), options.shard)
    if is_finished(out, request, options, recipe.flexible, made_by):
        discard(out)  # left if the run was killed after moving its output into place
        progress.say(f"{out} is finished already")
        return out
    require_output(out, folder=is_folder, overwrite=options.overwrite)
    require_startable(out, request, options, recipe.flexible, progress)
    compile_first(progress, recipe.engine, options.workers, draws=recipe.draws)
    if not (options.resume and recipe.load(staging_folder(out))):
        recipe.begin()
    with _staging(out, options, request) as folder:
        lock = os.stat(folder / "lock")
        with recipe.pool(options) as pool:
            for batch in recipe.batches(folder):
                progress.stage(batch.name, 0, len(batch.units))
                progress.show(recipe.status)
                for done, _ in enumerate(batch.follow(pool), 1):
                    progress.stage(batch.name, done, len(batch.units))
                    progress.show(recipe.status)
                # If the folder was removed, writing would create it again without its lock.
                if not is_held(folder, lock):
                    raise Occupied(f"{folder} was removed during the run; start the run again")
                if batch is CHECKPOINT:
                    recipe.save(folder)
            progress.show(recipe.status, last=True)
        progress.stage("writing")
        remove(folder / "made")
        made = recipe.finish(folder / "made", request)
        move_into_place(made, out, overwrite=options.overwrite)
    shutil.rmtree(staging_folder(out))
    seconds = time.perf_counter() - began
    progress.say(f"{out}: {recipe.summary()}; {seconds:.0f} s")
    return out


@contextmanager
def _staging(out: Path, options: RunOptions, request: dict[str, Any]) -> Iterator[Path]:
    """Hold the staging folder with a request in it; remove it after a failure without any work."""
    with staging(out, options) as folder:
        with atomic_write(folder / REQUEST) as temporary:
            temporary.write_text(json.dumps(request, indent=1, sort_keys=True), encoding="utf-8")
        try:
            yield folder
        except BaseException:
            if folder.is_dir() and {path.name for path in folder.iterdir()} <= {"lock", REQUEST}:
                shutil.rmtree(folder)
            raise


def is_finished(
    out: Path,
    requested: dict[str, Any],
    existing: Existing,
    flexible: tuple[str, ...] = (),
    made_by: Callable[[Path], dict[str, Any] | None] | None = None,
) -> bool:
    """Whether `out` is already the finished output of the run to resume.

    Raises:
        InvalidInput: it is the output of another request, and `existing` doesn't overwrite it.
    """
    there = (made_by or request_of)(out) if may_be_finished(out, existing) else None
    if there is None:
        return False
    if not existing.overwrite:
        require_same(there, requested, flexible, out)
        return True
    return not differing(there, requested, flexible)


def require_startable(
    out: Path,
    requested: dict[str, Any],
    existing: Existing,
    flexible: tuple[str, ...],
    progress: Progress,
) -> None:
    """Require that a run can start, or that the run to resume had the same request.

    Raises:
        InvalidInput: the run to resume had another request.
        Occupied: another run holds the staging folder, or an interrupted one left work.
    """
    require_no_interrupted_run(out, existing)
    left_in = staging_folder(out)
    if existing.resume and left_in.exists():
        require_resumable(left_in, request_of(left_in), requested, flexible)
    elif existing.resume:
        progress.say(f"{out}: there is nothing to resume, starting from the beginning")


def whole_request(requested: dict[str, Any], shard: Shard) -> dict[str, Any]:
    """Return everything that determines the output of a run, as JSON; `requested` is the recipe's
    part.
    """
    request = {
        **requested,
        "shard": {"number": shard.number, "of": shard.of},
        "versions": versions(),
        "rope": RopeConfig().fingerprint,
    }
    found: dict[str, Any] = json.loads(json.dumps(request))
    return found


def versions() -> dict[str, str]:
    """Return the versions of everything that could change the output.

    `code` is a digest of this package's modules, to distinguish edits within a version.
    """
    return {
        "knotgym": knotgym.__version__,
        "code": _code_sha256(),
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


@cache
def _code_sha256() -> str:
    """Return the SHA-256 of this package's modules, except `cli`, which can't affect the output."""
    root, digest = Path(knotgym.__file__).parent, hashlib.sha256()
    modules = {path.relative_to(root).as_posix(): path for path in root.rglob("*.py")}
    for name in sorted(modules):
        if not name.startswith("cli/"):
            digest.update(f"{name}\0".encode() + modules[name].read_bytes() + b"\0")
    return digest.hexdigest()


def request_of(folder: Path) -> dict[str, Any] | None:
    """Return the request of the run that made a folder or is making it; None if unknown."""
    for name in (REQUEST, "manifest.json", "data/collection.json", "collection.json"):
        try:
            content = read_json(folder / name)
            return {key: content[key] for key in LISTED}
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return None


def require_resumable(
    folder: Path, left: dict[str, Any] | None, requested: dict[str, Any], flexible: tuple[str, ...]
) -> None:
    """Require that a staging folder with work belongs to this request; raise InvalidInput
    otherwise.
    """
    if left is not None:
        require_same(left, requested, flexible, folder)
    elif has_work(folder):
        raise InvalidInput(
            f"{folder} can't be resumed, its {REQUEST} is missing or corrupted; --restart deletes"
            " it and starts again"
        )


def require_same(
    there: dict[str, Any], requested: dict[str, Any], flexible: tuple[str, ...], folder: Path
) -> None:
    """Require that two requests agree, apart from the `flexible` fields of the configuration."""
    if found := differing(there, requested, flexible):
        raise InvalidInput(
            f"{folder} belongs to a different run: {'; '.join(found[:3])}; give the same options"
            " again, or --restart to delete an interrupted run, --overwrite to replace a finished"
            " one"
        )


def differing(
    there: dict[str, Any], requested: dict[str, Any], flexible: tuple[str, ...]
) -> list[str]:
    """Return the differences of two requests, without `flexible` fields of the configuration."""
    return [
        difference
        for difference in differences(there, requested)
        if not difference.startswith(tuple(f"config.{name} is " for name in flexible))
    ]
