"""The recipe of prompts: several requests at a time; an interrupted run can be resumed.

Replies are logged in the staging folder as they arrive; `--resume` reuses them and requests only
the rest.
"""

import json
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import knotgym
from knotgym.common.configuration import read_json
from knotgym.common.errors import Failed, InvalidInput
from knotgym.prompting.chat import Chat
from knotgym.prompting.kept_replies import Asking, KeptReplies
from knotgym.prompting.prompted_episodes import PromptConfig, flat
from knotgym.prompting.reading_scores import ReadingScores
from knotgym.prompting.summary import summarize
from knotgym.prompting.transcripts import FILE, line
from knotgym.runs.engine import LISTED, Batch, Recipe
from knotgym.runs.engine import run as run_recipe
from knotgym.runs.pools import AHEAD, Pool, ordered
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import RunOptions
from knotgym.states.state_file import read_states, ships, states_file

_REPLIES, _RESULT = "replies.jsonl", "result.json"

Transcript = dict[str, Any]
Ask = Callable[[int, Asking], Transcript]  # from a number and the function that sends requests


def run(
    config: PromptConfig,
    ask: Ask,
    count: int,
    out: Path,
    options: RunOptions,
    *,
    side_by_side: int,
    progress: Progress,
) -> Path:
    """Make transcripts 0 to count - 1 and write them to the new folder `out`.

    Args:
        config: settings, which are written to `out`.
        ask: makes one transcript, in one of several threads.
        side_by_side: transcripts made at a time, at least 1.

    Raises:
        Occupied, InvalidInput: as in `runs.engine.run`; or `side_by_side` is less than 1.
        InvalidInput, Failed: as raised by `Chat`; replies are kept for `--resume`.
    """
    recipe = PromptRecipe(config, ask, count, side_by_side)
    return run_recipe(recipe, out, options, progress, made_by=_request_in)


class PromptRecipe(Recipe):
    """Recipe for transcripts, see `runs.engine.Recipe`. The replies are the checkpoint."""

    flexible = "chat.timeout", "chat.attempts", "chat.backoff"  # they don't change any request

    def __init__(self, config: PromptConfig, ask: Ask, count: int, side_by_side: int) -> None:
        if side_by_side < 1:
            raise InvalidInput(f"side_by_side must be at least 1, got {side_by_side}")
        if not ships(config.task.states):
            read_states(states_file(config.task.states), images=False)
        self.config, self.engine = config, config.task.engine
        self._ask, self._count, self._side_by_side = ask, count, side_by_side
        self._stop = threading.Event()
        self._done: list[Transcript] = []

    def request(self) -> dict[str, Any]:
        return {"config": flat(self.config), "source": None}

    @contextmanager
    def pool(self, options: RunOptions) -> Iterator[Pool]:
        try:
            yield _Threads(self._side_by_side, self._stop)
        finally:
            self._stop.set()

    def batches(self, folder: Path) -> Iterator[Batch]:
        chat, kept = Chat(self.config.chat, self._stop), KeptReplies(folder / _REPLIES)
        before = f", {len(kept)} replies are already there" if len(kept) else ""

        def work(number: int) -> Transcript:
            return self._ask(number, kept.asking(number, chat))

        def absorb(number: int, made: Transcript) -> None:
            self._done.append(made)

        try:
            yield Batch(work, range(self._count), absorb, f"asking the model{before}")
        finally:
            kept.close()

    def status(self) -> Status:
        facts = summarize(self._done) if self._done else {"retries": {}}
        shown = {"successes": str(facts["successes"])} if "successes" in facts else {}
        shown["retries"] = str(sum(facts["retries"].values()))
        counted = "pictures" if "pictures" in facts else "episodes"
        return Status(len(self._done), self._count, counted, shown, even=True)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        result: dict[str, Any] = {
            "version": knotgym.__version__,
            **summarize(self._done),
            "settings": request["config"],
            "request": {name: request[name] for name in LISTED if name != "config"},
        }
        if "read" in self._done[0]:
            result["scores"] = ReadingScores.of(self._done).as_json()
        folder.mkdir()
        (folder / FILE).write_text("".join(map(line, self._done)), encoding="utf-8")
        (folder / _RESULT).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        return folder

    def summary(self) -> str:
        return f"{FILE}, {_RESULT}"


def _request_in(out: Path) -> dict[str, Any] | None:
    """Return the request of the run that made a folder; None if none did."""
    try:
        result = read_json(out / _RESULT)
        return {"config": result["settings"], **result["request"]}
    except (OSError, ValueError, KeyError, TypeError):
        return None


class _Threads:
    """A pool of threads that mostly wait for the server; the first error stops all of them.

    They are daemons, so that one that waits doesn't keep an interrupted run alive.
    """

    def __init__(self, count: int, stop: threading.Event) -> None:
        self._count, self._slots, self._stop = count, threading.Semaphore(count), stop
        self._failure: Exception | None = None

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterator[Any]:
        def submit(piece: Any) -> Future[Any]:
            promise: Future[Any] = Future()
            arguments = function, piece, promise
            threading.Thread(target=self._work, args=arguments, daemon=True).start()
            return promise

        try:
            yield from ordered(submit, work, AHEAD * self._count)
        except Failed as error:
            raise self._failure or error from None

    def _work(self, function: Callable[[Any], Any], piece: Any, promise: Future[Any]) -> None:
        with self._slots:
            try:
                promise.set_result(function(piece))
            except Exception as error:
                if not isinstance(error, Failed):
                    self._failure = self._failure or error
                self._stop.set()
                promise.set_exception(error)
