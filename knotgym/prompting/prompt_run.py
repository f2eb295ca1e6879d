"""Run prompts against a server and write their transcripts; an interrupted run can be resumed."""

import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import knotgym
from knotgym.prompting.chat import Chat
from knotgym.prompting.prompt_config import PromptConfig
from knotgym.prompting.prompted_episodes import flat, packed, play, read, unpacked
from knotgym.prompting.prompts import as_text
from knotgym.prompting.transcripts import FILE, line, reading_scores, summarize
from knotgym.runs import Progress, Recipe, Result, RunOptions, identity, run

_RESULT = "result.json"
_FREE = ("timeout", "attempts")  # settings of the client that don't change a request


def run_prompts(
    config: PromptConfig,
    out: Path,
    options: RunOptions,
    *,
    rows: Sequence[Mapping[str, Any]] = (),
    progress: Progress | None = None,
) -> Path:
    """Ask a model and write the transcripts and totals to the new folder `out`.

    Args:
        config: settings, which are written to `out`.
        out: folder.
        options: of the run.
        rows: pictures to read, rows of a perception table; in mode read only.
        progress: where to show progress.

    Raises:
        Occupied, InvalidInput, InvalidFile: as `runs.runner`; or the key is missing or invalid.
        InvalidInput, Failed: as `Chat.ask`; replies are kept for `--resume`.
    """
    settings, stop = flat(config), threading.Event()
    chat = Chat(config.chat, stop)

    def ask(messages: list[dict[str, Any]]) -> Result:
        return packed(chat.ask(messages))

    def recipe(place: Path) -> Recipe[str]:
        told = yield from (read(config, rows, ask) if rows else play(config, ask))
        result = {"version": knotgym.__version__, **summarize(told), "settings": settings}
        result["identity"] = run_identity
        if rows:
            result["scores"] = reading_scores(told)
        place.mkdir(parents=True)
        (place / FILE).write_text("".join(map(line, told)), encoding="utf-8")
        (place / _RESULT).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        return f"{FILE}, {_RESULT}"

    @contextmanager
    def pool() -> Iterator[Executor]:
        try:
            yield _Requests(config.side_by_side, stop)
        finally:
            stop.set()

    asked = {**settings, "chat": {k: v for k, v in settings["chat"].items() if k not in _FREE}}
    run_identity = identity(config, fields=asked)
    return run(
        recipe,
        out,
        run_identity,
        options,
        progress,
        pool=pool,
        count=lambda kept: {"retries": sum(unpacked(kept)["retries"].values())},
        identity_in=_RESULT,
    )


def sample_prompt(
    config: PromptConfig, rows: Sequence[Mapping[str, Any]] = ()
) -> tuple[str, dict[str, bytes]]:
    """Return a run's first request as text for people, and its pictures, by name, as PNG."""

    def ask(messages: list[dict[str, Any]]) -> Result:
        raise AssertionError("a sample is never sent")

    (asked,) = next(read(config, rows[:1], ask) if rows else play(config, ask))[0].arguments
    return as_text(asked)


class _Requests(Executor):
    """Threads that mostly wait for a server; after an error, the others are stopped.

    They are daemons, so that one that waits doesn't keep an interrupted run alive.
    """

    def __init__(self, count: int, stop: threading.Event) -> None:
        self.workers, self._slots, self._stop = count, threading.Semaphore(count), stop

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        promise: Future[Any] = Future()

        def work() -> None:
            with self._slots:
                try:
                    promise.set_result(function(*arguments, **named))
                except BaseException as error:
                    self._stop.set()
                    promise.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        return promise
