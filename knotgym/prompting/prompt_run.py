"""Run prompts: several requests at a time; an interrupted run can be resumed.

Replies are logged in the staging folder as they arrive; `--resume` reuses them and requests only
the rest.
"""

import json
import queue
import shutil
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import knotgym
from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.common.configuration import differences, read_json
from knotgym.prompting.chat import Chat, Stopped
from knotgym.prompting.kept_replies import Asking, KeptReplies
from knotgym.prompting.prompted_episodes import PromptConfig, flat
from knotgym.prompting.reading_scores import ReadingScores
from knotgym.prompting.summary import summarize
from knotgym.prompting.transcripts import FILE, line
from knotgym.rope.engines import MUJOCO
from knotgym.runs.progress import Progress, Status, compile_first
from knotgym.runs.run_options import Existing, InvalidRun
from knotgym.runs.staging import may_be_finished, require_no_interrupted_run, staging
from knotgym.states.state_file import read_states, ships, states_file

# settings that may differ when a run is resumed, because they don't change any request
_FLEXIBLE = ("timeout", "attempts", "backoff")
_REPLIES, _REQUEST = "replies.jsonl", "request.json"
_RESULT = "result.json"

Transcript = dict[str, Any]
Ask = Callable[[int, Asking], Transcript]  # from a number and the function that sends requests


def run(
    config: PromptConfig,
    ask: Ask,
    count: int,
    out: Path,
    *,
    side_by_side: int,
    existing: Existing,
    progress: Progress,
) -> dict[str, Any]:
    """Make transcripts 0 to count - 1, write them to the new folder `out`, and return the result.

    Args:
        config: settings, which are written to `out`.
        ask: makes one transcript, in one of several threads.
        count: number of transcripts.
        out: folder to create.
        side_by_side: transcripts made at a time, at least 1.
        existing: what to do with an earlier run in `out`.
        progress: where to show progress.

    Raises:
        Occupied: `out` exists, holds an interrupted run, or is used by another process.
        InvalidRun: the run to resume has other settings, or `side_by_side` is less than 1.
        InvalidPrompting, Unanswered: as raised by `Chat`; replies are kept for `--resume`.
    """
    if side_by_side < 1:
        raise InvalidRun(f"side_by_side must be at least 1, got {side_by_side}")
    settings = json.loads(json.dumps(flat(config)))
    done_already = _finished(out, settings, existing, progress)
    if done_already is not None:
        return done_already
    require_output(out, folder=True, overwrite=existing.overwrite)
    require_no_interrupted_run(out, existing)
    if config.task is not None and not ships(config.task.states):
        read_states(states_file(config.task.states), images=False)
    compile_first(progress, config.task.engine if config.task else MUJOCO)
    with staging(out, existing) as folder:
        if (folder / _REQUEST).is_file():
            _refuse_other(read_json(folder / _REQUEST), settings)
        stop = threading.Event()
        chat = Chat(config.chat, stop)
        with atomic_write(folder / _REQUEST) as temporary:
            temporary.write_text(json.dumps(settings), encoding="utf-8")
        kept, done = KeptReplies(folder / _REPLIES), {}
        if existing.resume:
            progress.say(f"{out}: {len(kept)} replies are already there")
        progress.stage("asking the model")
        try:
            for one in _transcripts(ask, count, chat, kept, side_by_side, stop):
                done[one["number"]] = one
                progress.show(lambda: _status(done, count), last=len(done) == count)
        finally:
            stop.set()
            kept.close()
        transcripts = [done[number] for number in range(count)]
        result = _finish(out, settings, transcripts, existing.overwrite)
        shutil.rmtree(folder, ignore_errors=True)
    return result


def _finished(
    out: Path, settings: dict[str, Any], existing: Existing, progress: Progress
) -> dict[str, Any] | None:
    """Return the result of a run that is finished already, or None.

    Raises:
        InvalidRun: it has other settings, and `existing` doesn't allow overwriting it.
    """
    if not may_be_finished(out, existing) or not (out / _RESULT).is_file():
        return None
    made = read_json(out / _RESULT)
    try:
        _refuse_other(made.get("settings") if isinstance(made, dict) else None, settings)
    except InvalidRun:
        if existing.overwrite:
            return None
        raise
    progress.say(f"{out} is finished already")
    return dict(made)


def _refuse_other(there: Any, here: dict[str, Any]) -> None:
    """Raise InvalidRun if two runs' settings differ in more than _FLEXIBLE."""
    if not isinstance(there, dict) or not isinstance(there.get("chat"), dict):
        raise InvalidRun("the run can't be resumed: its settings are missing or corrupted")
    fixed = [
        {**one, "chat": {name: one["chat"][name] for name in one["chat"] if name not in _FLEXIBLE}}
        for one in (there, here)
    ]
    apart = list(differences(fixed[0], fixed[1]))
    if apart:
        raise InvalidRun(f"the run to resume has other settings: {'; '.join(apart)}")


def _transcripts(
    ask: Ask,
    count: int,
    chat: Chat,
    kept: KeptReplies,
    side_by_side: int,
    stop: threading.Event,
) -> Iterable[Transcript]:
    """Yield transcripts as they are finished, made by threads that mostly wait for the server."""
    pending: queue.SimpleQueue[int] = queue.SimpleQueue()
    finished: queue.SimpleQueue[Transcript | Exception] = queue.SimpleQueue()
    waiting = count
    for number in range(count):
        pending.put(number)

    def work() -> None:
        while not stop.is_set():
            try:
                number = pending.get_nowait()
            except queue.Empty:
                return
            try:
                finished.put(ask(number, kept.asking(number, chat)))
            except Stopped:
                return
            except Exception as error:
                finished.put(error)
                return

    for _ in range(min(side_by_side, count)):
        # daemons, so that one that waits for a server doesn't keep an interrupted run alive
        threading.Thread(target=work, daemon=True).start()
    failure: Exception | None = None
    # after a failure, transcripts that are finished already are still yielded
    while waiting and not (failure and finished.empty()):
        found = finished.get()
        waiting -= 1
        if isinstance(found, Exception):
            failure = failure or found
            stop.set()
        else:
            yield found
    if failure is not None:
        raise failure


def _finish(
    out: Path, settings: dict[str, Any], transcripts: list[Transcript], overwrite: bool
) -> dict[str, Any]:
    """Write the folder, with transcripts in order and the result; return the result."""
    result: dict[str, Any] = {
        "version": knotgym.__version__,
        **summarize(transcripts),
        "settings": settings,
    }
    if "read" in transcripts[0]:
        result["scores"] = ReadingScores.of(transcripts).as_json()
    with atomic_write(out, overwrite=overwrite) as folder:
        folder.mkdir()
        (folder / FILE).write_text("".join(map(line, transcripts)), encoding="utf-8")
        text = json.dumps(result, indent=1) + "\n"
        (folder / _RESULT).write_text(text, encoding="utf-8")
    return result


def _status(done: dict[int, Transcript], count: int) -> Status:
    facts = summarize(list(done.values()))
    successes = {"successes": str(facts["successes"])} if "successes" in facts else {}
    retried = sum(facts["retries"].values())
    return Status(
        len(done),
        count,
        "pictures" if "pictures" in facts else "episodes",
        {**successes, "retries": str(retried)},
        even=True,
    )
