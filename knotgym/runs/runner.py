"""A run is a pure function of its configuration and seed, with a memo on disk.

A recipe is a generator: it yields batches of calls and is sent their results, in the order of the
calls. Which calls it makes depends on earlier results alone.

    def recipe(place):
        parts = yield [Call(f"parts {i}", part, (config, i)) for i in range(10)]
        write(place, joined(parts))
        return f"{len(parts)} parts"

`run` drives it in a hidden folder `.NAME.partial` beside the output and keeps each result in a
journal there (`journal`); only a finished output gets the final name. To resume is to run again:
what the journal holds isn't computed again. Shard i of n computes every n-th call and leaves
`NAME-shard-i-of-n.journal` beside the output; to merge is to run the command once more, without
run.shard, where the journals of the shards lie. The output is the same, byte for byte, however a
run was interrupted, divided and merged, and whatever executed it.
"""

import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from glob import escape
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from knotgym.common import (
    Counts,
    Failed,
    InvalidInput,
    Occupied,
    differences,
    move_into_place,
    remove,
    require_output,
    require_own,
    sweep,
)
from knotgym.runs.executors import InProcess, compile_first, executor
from knotgym.runs.identities import Identity, identity_of
from knotgym.runs.journal import CHECKPOINT, LEFT, Journal, Result, has_work
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import WHOLE, RunOptions, Shard

Output = TypeVar("Output")

_STARTING = 4.0  # seconds until workers have started, which only the first calls wait for
_AHEAD = 4  # calls in progress for each worker, so that one slow call doesn't leave others idle


class Call(NamedTuple):
    """A piece of work.

    Attributes:
        key: its name, unique in the run. With the identity of the run it must say everything that
            determines the result. All but its last word names the stage that progress shows, such
            as "episodes 0-63".
        function: a function at the top level of a module; it returns arrays by name.
        arguments: what it is called with; they travel to other processes.
        items: how many things it makes, such as episodes; progress counts these.
    """

    key: str
    function: Callable[..., Result]
    arguments: tuple[Any, ...] = ()
    items: int = 1


Recipe = Generator[Sequence[Call], list[Result], Output]
Count = Callable[[Result], Mapping[str, int]]  # what progress adds up of a result
# call, how many items of its stage are done by now, their total, new result
OnProgress = Callable[[Call, Callable[[], float], int, Result | None], None]


def compute(
    recipe: Recipe[Output],
    memo: Journal | dict[str, Result] | None = None,
    pool: Executor | None = None,
    shard: Shard = WHOLE,
    progress: Progress | None = None,
    count: Count | None = None,
) -> Output:
    """Drive a recipe to its end and return its output.

    Args:
        recipe: a new generator.
        memo: results by key that are there already; it gets the others. By default they are
            forgotten at the end.
        pool: executes the calls; by default they are executed in this process.
        shard: which share of the calls of each batch is computed.
        progress: shows the stage, and how many of its items are done.
        count: result -> numbers to add up and show, such as {"reached the goal": 3}.

    Raises:
        Failed: results of other shards are missing.
    """
    memo, pool = {} if memo is None else memo, pool or InProcess()
    progress, totals = progress or Progress(quiet=True), Counter[str]()

    def _show(call: Call, done: Callable[[], float], total: int, result: Result | None) -> None:
        if count is not None and result is not None:
            totals.update(count(result))
        starts = results is None and not isinstance(pool, InProcess)
        progress.stage(_stage(call), done, total, totals, starts * _STARTING)

    results: list[Result] | None = None
    while True:
        try:
            calls = next(recipe) if results is None else recipe.send(results)
        except StopIteration as end:
            return end.value
        totals.clear()  # they stand beside how many of these calls are done
        _complete(calls[shard.number - 1 :: shard.of], memo, pool, _show)
        missing = [index for index, call in enumerate(calls) if call.key not in memo]
        if missing:
            recipe.close()
            others = sorted({index % shard.of + 1 for index in missing})
            raise _Missing(
                f"{len(missing)} of {len(calls)} results of {_stage(calls[0])!r} are missing: run"
                f" shard {', '.join(f'{number}/{shard.of}' for number in others)}"
            )
        results = [memo[call.key] for call in calls]


class _Missing(Failed):
    """A shard has computed its share, and the recipe can't go on without the others'."""


def run(
    recipe: Callable[[Path], Recipe[Any]],
    out: Path,
    identity: Identity,
    options: RunOptions,
    progress: Progress | None = None,
    *,
    is_folder: bool = True,
    compiles: Mapping[str, Any] | None = None,
    pool: Callable[[], AbstractContextManager[Executor]] | None = None,
    count: Count | None = None,
    identity_in: str | Callable[[Path], Any] = "manifest.json",
) -> Path:
    """Make an output and return it; a shard returns its journal.

    Args:
        recipe: where to write the output -> generator, which writes it at its end. If it returns a
            text, that is the summary to show. Nothing else may be done there; files that later
            calls need may be written beside it.
        identity: everything that determines the output, see `identities.identity`; none of the
            files that are read is ever replaced, and a change of one stops the publication.
        compiles: keywords of `compile_first`, which is called before the work; None for nothing.
        pool: opens the executor; by default that of the options.
        count: as in `compute`.
        identity_in: the JSON file in a folder that holds the identity of its run, or what reads
            that from the path of an output.

    Raises:
        Occupied: the output exists, another run is making it, or an interrupted one left work.
        InvalidInput: the run to resume had another identity, or a source has changed.
        InvalidFile: its journal, or that of a shard, isn't one.
        Failed: something could not be made.
    """
    began, shard = time.perf_counter(), options.shard
    with Progress(options.quiet) if progress is None else nullcontext(progress) as shown:
        if shard.is_whole and _is_finished(out, identity, options, identity_in):
            if _staging_folder(out).exists():  # it was killed after moving its output into place
                with staged(out, identity, options) as (folder, _):
                    remove(folder)
            sweep(_staging_folder(out))
            shown.say(f"{out} is finished already")
            return out
        replaces, reads = options.overwrite or not shard.is_whole, identity.reads
        free = partial(require_output, out, folder=is_folder, overwrite=replaces, reads=reads)
        free()
        with staged(out, identity, options) as (folder, journal):
            free()  # another may have made it before this one had the lock
            if options.resume and journal.is_empty:
                shown.say(f"{out}: there is nothing to resume, starting from the beginning")
            place = folder / "made" / out.name
            with (pool or partial(executor, options.workers, options.scheduler))() as workers:
                if compiles is not None:
                    compile_first(shown, workers, **compiles)
                try:
                    summary = compute(recipe(place), journal, workers, shard, shown, count)
                except _Missing as missing:
                    summary = f"{shard} is done as far as it can be; {missing}"
                    if journal.is_empty:
                        summary = f"shard {shard} has nothing to do: the run has fewer parts"
            if not journal.is_held:
                raise Occupied(f"{journal.path} was removed during the run; start the run again")
            if shard.is_whole:
                identity.require_unchanged()
                shown.stage("writing")
                move_into_place(place, out, overwrite=options.overwrite)
            remove(folder)
        text = f": {summary}" if isinstance(summary, str) else ""
        made, seconds = out if shard.is_whole else journal.path, time.perf_counter() - began
        shown.say(f"{made}{text}; {seconds:.0f} s")
        if shard.is_whole:
            if merged := _shards(out):
                shown.say(f"merged, and not needed any more: {', '.join(map(str, merged))}")
            return out
        shown.say("to merge, run the same command without a shard where all shards' journals lie")
        return journal.path


@contextmanager
def staged(
    out: Path, identity: Mapping[str, Any], options: RunOptions
) -> Iterator[tuple[Path, Journal]]:
    """Hold the staging folder of an output and its journal; yield both.

    The journal is locked, and with it the folder: only who holds the lock removes anything. At the
    end both are removed if the journal is empty; otherwise they stay, for the next run.

    Raises:
        Occupied: another run holds it, or it has the work of an interrupted run and `options`
            says neither resume nor restart, or a link or another user's file is in its place.
        InvalidFile, InvalidInput: as `Journal` raises.
    """
    shard, path = options.shard, options.shard.journal(out)
    folder = _staging_folder(out if shard.is_whole else path)
    others = [other for other in _shards(out) if other != path]
    path = folder / "journal" if shard.is_whole else path
    for place in (folder, path):
        require_own(place)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # so that nobody plants files in it
    try:
        goes_on, begins = options.resume, options.restart
        with Journal(path, identity, others, resume=goes_on, restart=begins) as journal:
            try:
                for left in folder.iterdir():
                    if left != path:
                        remove(left)
                (folder / "made").mkdir()
                yield folder, journal
            finally:
                if journal.is_held and journal.is_empty:
                    for place in (path, folder):
                        remove(place)
    finally:
        with suppress(OSError):
            folder.rmdir()  # only if nobody has begun in it


def _shards(out: Path) -> list[Path]:
    """Return the journals of shards that lie beside the output of a whole run."""
    beside = sorted(out.parent.glob(f"{escape(out.name)}-shard-*-of-*.journal"))
    return [journal for journal in beside if journal.is_dir()]


def _staging_folder(out: Path) -> Path:
    """Return the folder `.NAME.partial` beside `out`, which holds a run until it is finished."""
    return out.parent / f".{out.name}.partial"


def checkpoint_of(place: Path) -> Path:
    """Return the one file that a recipe may keep, and replace, until its output is in place.

    For work that isn't a function of a call, such as a training; a resumed run finds it again.
    """
    return place.parents[1] / "journal" / CHECKPOINT


def require_free(out: Path, options: RunOptions, hint: str) -> None:
    """Raise Occupied if the folder `out`, or the work of an interrupted run, is in the way.

    Args:
        out: what a run would make.
        options: of the run, which may say what to do with what is there.
        hint: added to what is said of the folder.
    """
    shard = options.shard
    if not options.resume and shard.is_whole:
        try:
            require_output(out, folder=True, overwrite=options.overwrite, reads=[])
        except Occupied as error:
            raise Occupied(f"{error}{hint}") from None
    path = _staging_folder(out) / "journal" if shard.is_whole else shard.journal(out)
    if not (options.resume or options.restart) and has_work(path):
        raise Occupied(LEFT.format(path))


def _is_finished(
    out: Path,
    identity: Mapping[str, Any],
    options: RunOptions,
    identity_in: str | Callable[[Path], Any],
) -> bool:
    """Whether `out` is already the finished output of the run to resume.

    Raises:
        InvalidInput: it is the output of another run, and `options` doesn't overwrite it.
    """
    # A run that was interrupted while it replaced an older output isn't finished.
    replaces = options.overwrite and has_work(_staging_folder(out) / "journal")
    there = identity_of(out, identity_in) if options.resume and not replaces else None
    if there is None:
        return False
    unlike = list(differences(dict(there), dict(identity)))
    if unlike and not options.overwrite:
        raise InvalidInput(
            f"{out} belongs to a different run: {'; '.join(unlike[:3])}; give the same options"
            " again, or --overwrite to replace it"
        )
    return not unlike


def _complete(
    calls: Sequence[Call], memo: Journal | dict[str, Result], pool: Executor, show: OnProgress
) -> None:
    """Compute the calls whose results aren't in the journal; keep each as soon as it is there."""
    left, done, total = [], 0, sum(call.items for call in calls)
    ended, remembered, begun = Counts.from_now(pool=pool), 0, 0

    def _by_now() -> float:
        # calls may count the items that they have ended, and a call that is finished counts as all
        finished = done - remembered
        return done + max(0, min(begun, ended()) - finished)

    for call in calls:
        if call.key in memo:
            done, remembered = done + call.items, remembered + call.items
            show(call, _by_now, total, memo[call.key])
        else:
            left.append(call)
    waiting, running = iter(left), dict[Future[Result], Call]()
    ahead = _AHEAD * int(getattr(pool, "workers", 4)) if not isinstance(pool, InProcess) else 1
    if left:
        show(left[0], _by_now, total, None)
    while True:
        for call in islice(waiting, ahead - len(running)):
            begun += call.items
            running[pool.submit(call.function, *call.arguments)] = call
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            call, result = running.pop(future), future.result()
            memo[call.key] = result
            done += call.items
            show(call, _by_now, total, result)


def _stage(call: Call) -> str:
    """Return the stage of a call, its key without the last word.

    >>> _stage(Call("episodes 0-63", dict))
    'episodes'
    """
    return call.key.rpartition(" ")[0] or call.key
