"""A run of prompts: several at a time, every reply kept as it comes.

Until all are there the replies stand in the staging folder; `--resume` takes them from there and
asks what is left.
"""

from __future__ import annotations

import json
import queue
import shutil
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import knotgym
from knotgym.atomic_files import atomic_write, require_output
from knotgym.configuration import differences, read_json
from knotgym.datasets.states import read_states, ships, states_file
from knotgym.prompting.chat import Chat, Stopped
from knotgym.prompting.kept_replies import Asking, KeptReplies
from knotgym.prompting.prompted_episodes import PromptConfig, flat
from knotgym.prompting.reading_scores import ReadingScores
from knotgym.prompting.tally import tally
from knotgym.prompting.transcripts import FILE, line
from knotgym.runs.progress import Progress, Status, compile_first
from knotgym.runs.run_options import Existing, InvalidRun
from knotgym.runs.staging import may_be_finished, require_no_interrupted_run, staging

# may differ when a run is gone on with: they change no question
_FLEXIBLE = ("timeout", "attempts", "backoff")
_REPLIES, _REQUEST = "replies.jsonl", "request.json"
_RESULT = "result.json"

Transcript = dict[str, Any]
Ask = Callable[[int, Asking], Transcript]  # a number, and how it asks


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
    """Ask for transcripts 0 to count - 1 and write them to the new folder `out`; the result.

    Raises:
        Occupied: `out` exists, an interrupted run left replies, or another run is at it.
        InvalidRun: what is resumed was asked for differently, or nothing is to be done at a time.
        InvalidChat, Unanswered: as `Chat`; the replies stay for `resume`.
    """
    if side_by_side < 1:
        raise InvalidRun(f"at least 1 must be asked for at a time, got {side_by_side}")
    settings = json.loads(json.dumps(flat(config)))
    done_already = _finished(out, settings, existing, progress)
    if done_already is not None:
        return done_already
    require_output(out, folder=True, overwrite=existing.overwrite)
    require_no_interrupted_run(out, existing)
    if config.task is not None and not ships(config.task.states):
        read_states(states_file(config.task.states), images=False)
    compile_first(progress)
    with staging(out, existing) as folder:
        _require_same(folder, settings)
        stop = threading.Event()
        chat = Chat(config.chat, stop)
        with atomic_write(folder / _REQUEST) as temporary:
            temporary.write_text(json.dumps(settings), encoding="utf-8")
        kept, done = KeptReplies(folder / _REPLIES), {}
        if existing.resume:
            progress.say(f"{out}: {len(kept)} replies are there")
        progress.stage("asking the model")
        try:
            for one in _asked(ask, count, chat, kept, side_by_side, stop):
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
    """The result of a finished run that is resumed; None if the model is to be asked.

    Raises:
        InvalidRun: it was asked for differently, and is not to be overwritten.
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


def _require_same(folder: Path, settings: dict[str, Any]) -> None:
    """Refuse to go on with what was asked for differently."""
    if not (folder / _REQUEST).is_file():
        return
    left = read_json(folder / _REQUEST)
    _refuse_other(left, settings)


def _refuse_other(there: Any, here: dict[str, Any]) -> None:
    if not isinstance(there, dict) or not isinstance(there.get("chat"), dict):
        raise InvalidRun(
            "what is there doesn't say what was asked for, so it can't be gone on with"
        )
    fixed = [
        {**one, "chat": {name: one["chat"][name] for name in one["chat"] if name not in _FLEXIBLE}}
        for one in (there, here)
    ]
    apart = list(differences(fixed[0], fixed[1]))
    if apart:
        raise InvalidRun(f"the run to resume was asked for differently: {'; '.join(apart)}")


def _asked(
    ask: Ask,
    count: int,
    chat: Chat,
    kept: KeptReplies,
    side_by_side: int,
    stop: threading.Event,
) -> Iterable[Transcript]:
    """Transcripts as they come. Threads: all they do is wait for the server."""
    work: queue.SimpleQueue[int] = queue.SimpleQueue()
    came: queue.SimpleQueue[Transcript | Exception] = queue.SimpleQueue()
    waiting = count
    for number in range(count):
        work.put(number)

    def labour() -> None:
        while not stop.is_set():
            try:
                number = work.get_nowait()
            except queue.Empty:
                return
            try:
                came.put(ask(number, kept.asking(number, chat)))
            except Stopped:
                return
            except Exception as error:
                came.put(error)
                return

    for _ in range(min(side_by_side, count)):
        # one that waits for a server keeps no interrupted run from ending
        threading.Thread(target=labour, daemon=True).start()
    trouble: Exception | None = None
    while waiting and not (trouble and came.empty()):  # what came beside a trouble isn't lost
        found = came.get()
        waiting -= 1
        if isinstance(found, Exception):
            trouble = trouble or found
            stop.set()
        else:
            yield found
    if trouble is not None:
        raise trouble


def _finish(
    out: Path, settings: dict[str, Any], transcripts: list[Transcript], overwrite: bool
) -> dict[str, Any]:
    """Write the folder: transcripts in the order of their numbers, and the result."""
    result: dict[str, Any] = {
        "version": knotgym.__version__,
        **tally(transcripts),
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
    facts = tally(list(done.values()))
    successes = {"successes": str(facts["successes"])} if "successes" in facts else {}
    retried = sum(facts["retries"].values())
    return Status(
        len(done),
        count,
        "pictures" if "pictures" in facts else "episodes",
        {**successes, "retries": str(retried)},
        even=True,
    )
