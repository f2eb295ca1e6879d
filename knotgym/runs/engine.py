"""The one engine of long runs: states, episodes and pictures are recipes that it follows.

A run works in a hidden folder beside what it makes (`staging`), and only a finished folder takes
the final name. The folder holds the *request*: all that decides the bytes made, versions and
configuration included. A run that was killed is resumed from what its recipe saved there, if it is
asked for the very same; what differs is refused by name.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import mujoco
import numpy as np

import knotgym
from knotgym.atomic_files import Occupied, atomic_write, move_into_place, remove, require_output
from knotgym.configuration import differences, read_json
from knotgym.rope import RopeConfig
from knotgym.runs.executors import executor
from knotgym.runs.pools import Pool
from knotgym.runs.progress import Progress, Status, compile_first
from knotgym.runs.run_options import Existing, InvalidRun, RunOptions
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
LISTED = ("config", "source", "shard", "versions", "rope")  # of a request, and of a manifest


@dataclass(frozen=True)
class Batch:
    """Units of work that do not depend on each other's results.

    Attributes:
        work: a function of a unit alone, at the top level of a module, so that it can be pickled.
        units: what to do; iterated once.
        absorb: takes each unit with its result, in the order of the units.
        name: what it is, for a person who looks on.
    """

    work: Callable[[Any], Any]
    units: Sequence[Any]
    absorb: Callable[[Any, Any], None]
    name: str = "working"

    def follow(self, pool: Pool) -> Iterator[None]:
        """Do the work; yields after every unit absorbed."""
        for unit, result in zip(self.units, pool.map(self.work, self.units), strict=True):
            self.absorb(unit, result)
            yield


CHECKPOINT = Batch(
    work=id, units=(), absorb=max, name="saving"
)  # no work: here a recipe can be saved


class Recipe(Protocol):
    """One kind of run. It may draw and decide, but only `Batch.work` runs elsewhere.

    `flexible` names the fields of the configuration that a resumed run may change.
    """

    flexible: tuple[str, ...]

    def request(self) -> dict[str, Any]:
        """The configuration and source, JSON-able: `{"config": {...}, "source": ...}`."""

    def begin(self) -> None:
        """Prepare from the start, before anything is written; refuse what can't be done."""

    def load(self, folder: Path) -> bool:
        """Take up what `save` left in the staging folder; False if there is nothing."""

    def batches(self, folder: Path) -> Iterator[Batch]:
        """What is left to do, decided as results come in; `folder` is the staging folder."""

    def save(self, folder: Path) -> None:
        """Leave in the staging folder what `load` takes up."""

    def status(self) -> Status:
        """Where the run stands."""

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        """Write all that was asked for below the new folder; return the folder to be renamed."""

    def summary(self) -> str:
        """What was made, in a line."""


def run(recipe: Recipe, out: Path, options: RunOptions, progress: Progress | None = None) -> Path:
    """Follow a recipe until the new folder `out` is there, and return it.

    Raises:
        Occupied: there is something in the way, another run is at it, or it was removed meanwhile.
        Unwritable: nothing can be written there.
        InvalidRun: what is resumed was asked for differently.
        KnotgymError: the recipe refuses, or what was allowed is spent.
    """
    if progress is None:
        with Progress(options.quiet) as progress:
            return run(recipe, out, options, progress)
    began = time.perf_counter()
    request = whole_request(recipe.request(), options.shard)
    if is_finished(out, request, options, recipe.flexible):
        discard(out)  # killed between its last two steps
        progress.say(f"{out} is finished already")
        return out
    require_output(out, folder=True, overwrite=options.overwrite)
    require_startable(out, request, options, recipe.flexible, progress)
    compile_first(progress)
    if not (options.resume and recipe.load(staging_folder(out))):
        recipe.begin()
    with staging(out, options) as folder:
        with atomic_write(folder / REQUEST) as temporary:
            temporary.write_text(json.dumps(request, indent=1, sort_keys=True), encoding="utf-8")
        lock = os.stat(folder / "lock")
        with executor(options.workers, options.scheduler) as pool:
            for batch in recipe.batches(folder):
                progress.stage(batch.name, 0, len(batch.units))
                progress.show(recipe.status)
                for done, _ in enumerate(batch.follow(pool), 1):
                    progress.stage(batch.name, done, len(batch.units))
                    progress.show(recipe.status)
                # else it would be made anew by what is written there, and no other run kept out
                if not is_held(folder, lock):
                    raise Occupied(f"{folder} was removed under the run; begin it anew")
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


def is_finished(
    out: Path, asked: dict[str, Any], existing: Existing, flexible: tuple[str, ...] = ()
) -> bool:
    """Whether `out` is what a resumed run would make: a finished run of the same request.

    Raises:
        InvalidRun: it was made by another request, and is not to be overwritten.
    """
    made_by = request_of(out) if may_be_finished(out, existing) else None
    if made_by is None:
        return False
    if not existing.overwrite:
        require_same(made_by, asked, flexible, out)
        return True
    return not differing(made_by, asked, flexible)


def require_startable(
    out: Path,
    asked: dict[str, Any],
    existing: Existing,
    flexible: tuple[str, ...],
    progress: Progress,
) -> None:
    """Refuse to begin over an interrupted run's work unasked, or to resume another request's.

    Raises:
        InvalidRun: what is to be resumed is of another request.
        Occupied: another run is at it, or an interrupted one left work.
    """
    require_no_interrupted_run(out, existing)
    left_in = staging_folder(out)
    if existing.resume and left_in.exists():
        require_resumable(left_in, request_of(left_in), asked, flexible)
    elif existing.resume:
        progress.say(f"{out}: there is nothing to resume here, so the run begins")


def whole_request(asked: dict[str, Any], shard: Shard) -> dict[str, Any]:
    """All that decides the bytes of a run, as JSON has it; `asked` is a recipe's own request."""
    request = {
        **asked,
        "shard": {"number": shard.number, "of": shard.of},
        "versions": versions(),
        "rope": RopeConfig().fingerprint,
    }
    found: dict[str, Any] = json.loads(json.dumps(request))
    return found


def versions() -> dict[str, str]:
    """Versions of all whose change could change a byte; `code` tells two states of one version of
    this package apart.
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
    """SHA-256 of this package's modules, less the commands, which only print and pass on."""
    root, digest = Path(knotgym.__file__).parent, hashlib.sha256()
    modules = {path.relative_to(root).as_posix(): path for path in root.rglob("*.py")}
    for name in sorted(modules):
        if not name.startswith("cli/"):
            digest.update(f"{name}\0".encode() + modules[name].read_bytes() + b"\0")
    return digest.hexdigest()


def request_of(folder: Path) -> dict[str, Any] | None:
    """What was asked of the run that made a folder, or is making it; None if it doesn't say."""
    for name in (REQUEST, "manifest.json", "data/collection.json", "collection.json"):
        try:
            said = read_json(folder / name)
            return {key: said[key] for key in LISTED}
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return None


def require_resumable(
    folder: Path, left: dict[str, Any] | None, asked: dict[str, Any], flexible: tuple[str, ...]
) -> None:
    """Refuse to go on from a staging folder that isn't of this request, or doesn't say of which.

    Raises:
        InvalidRun: it is such.
    """
    if left is not None:
        require_same(left, asked, flexible, folder)
    elif has_work(folder):
        raise InvalidRun(
            f"{folder} can't be resumed, its {REQUEST} is missing or damaged; --restart throws it"
            " away and begins anew"
        )


def require_same(
    there: dict[str, Any], asked: dict[str, Any], flexible: tuple[str, ...], folder: Path
) -> None:
    """Refuse to go on in a folder with another request than the one that began it.

    Raises:
        InvalidRun: they differ in more than the fields of the configuration named `flexible`.
    """
    if found := differing(there, asked, flexible):
        raise InvalidRun(
            f"{folder} is of another run than the one asked for: {'; '.join(found[:3])}; give the"
            " same again, or --restart to throw an interrupted run away, --overwrite to replace a"
            " finished one"
        )


def differing(there: dict[str, Any], asked: dict[str, Any], flexible: tuple[str, ...]) -> list[str]:
    """In what two requests differ, but for the fields of the configuration named `flexible`."""
    return [
        difference
        for difference in differences(there, asked)
        if not difference.startswith(tuple(f"config.{name} is " for name in flexible))
    ]
