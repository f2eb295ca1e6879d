"""`knotgym generate` from end to end: one run to a folder, saved after every cycle, resumed after
any kill.
"""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console

from knotgym.atomic_files import atomic_write
from knotgym.generate.states import state_folder as output
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.curation_run import GenerateConfig, InvalidJob, Job, run
from knotgym.runs.executors import engine
from knotgym.runs.progress import Progress
from knotgym.runs.staging import Occupied, lock_folder, staging, staging_folder


def generate(
    config: GenerateConfig,
    out: Path,
    *,
    archive: Path | None,
    workers: int,
    resume: bool,
    quiet: bool,
    console: Console,
    scheduler: str = "",
) -> None:
    """Make curated states in the new folder `out`.

    While it runs, everything stands in the hidden folder `.NAME.partial` beside `out`; only a
    finished run takes the name.

    Args:
        config: what is wanted.
        out: the folder; with `resume` it may be there already, finished.
        archive: of another run, to go on from.
        workers: processes, 0 for one a core.
        resume: go on from the last cycle that was saved.
        quiet: show nothing.
        console: to show progress on.
        scheduler: address of a Dask cluster's, to work there.

    Raises:
        Occupied: there is something in the way, or another run is at it.
        InvalidJob: nothing of the kind can be made, or what is resumed was another job.
    """
    if workers < 0:
        raise InvalidJob(f"workers must be at least 0, got {workers}")
    partial = staging_folder(out)
    if out.exists():
        if resume and _finished(out) == json.loads(json.dumps(asdict(config))):
            # left if it was killed right after the renaming
            shutil.rmtree(partial, ignore_errors=True)
            if not quiet:
                console.print(f"{out} is finished already", soft_wrap=True)
            return
        raise Occupied(f"{out} is there already; choose another --out, or remove it")
    if partial.exists():
        with lock_folder(partial):
            pass  # nobody is at it
    job = _resumed(partial / "job.pickle", config) if resume else None
    # before anything is written: it may be refused
    job = job or Job.begin(config, Archive.load(archive) if archive else None)
    job.config = replace(job.config, attempts=config.attempts, cycles=config.cycles)
    with staging(out, resume):

        def each_cycle(job: Job) -> None:
            with atomic_write(partial / "job.pickle") as temporary:
                temporary.write_bytes(pickle.dumps(job))
            progress.cycle(job)

        with engine(workers, scheduler) as pool, Progress(console, quiet) as progress:
            run(job, pool, each_cycle)
        shutil.rmtree(partial / out.name, ignore_errors=True)
        output.write(job, partial / out.name)
        (partial / out.name).rename(out)
    shutil.rmtree(partial)
    if not quiet:
        total = sum(len(candidates) for candidates in job.accepted.values())
        codes = len({one.code.plain for candidates in job.accepted.values() for one in candidates})
        console.print(
            f"{out}: {total} states of {codes} codes in {job.seconds:.0f} s",
            soft_wrap=True,
            highlight=False,
        )


def _finished(out: Path) -> object:
    try:
        return json.loads((out / "manifest.json").read_text())["config"]
    except (OSError, ValueError, KeyError):
        return None


def _resumed(path: Path, config: GenerateConfig) -> Job | None:
    """The job saved at `path`, None if nothing is; only ever a file that this program wrote."""
    if not path.is_file():
        return None
    try:
        job = pickle.loads(path.read_bytes())
    except Exception as error:  # whatever pickle says to bytes that aren't its own
        raise InvalidJob(
            f"{path} can't be read, the disk has spoilt it; start without --resume"
        ) from error
    if (
        not isinstance(job, Job)
        or replace(job.config, attempts=config.attempts, cycles=config.cycles) != config
    ):
        raise InvalidJob(
            f"{path.parent} holds another job than the one asked for; give the same options again,"
            " or start without --resume"
        )
    return job
