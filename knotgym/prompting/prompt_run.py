"""Play episodes with a model, or have it read pictures, and write the transcripts.

The model is asked once per action, or in mode open once per episode. Where an answer is invalid, or
the actions of mode open are used up, the step is a no-op: an action without force. So a transcript
always has a full sequence of actions.

Both are recipes, see `knotgym.runs`: all episodes go on side by side, and each round of requests is
a batch of calls. Replies are kept by the digest of their request, so a resumed run asks only for
those that are missing.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import InvalidInput, Stream, as_json
from knotgym.datasets import encode
from knotgym.envs import EpisodeBatch
from knotgym.prompting.answers import read_actions, read_code
from knotgym.prompting.chat import Chat
from knotgym.prompting.prompts import TEXTS, Picture, PromptConfig, Turn, messages, opening, reading
from knotgym.prompting.transcripts import FILE, TOKENS, line, reading_scores, summarize, total
from knotgym.runs import Call, Progress, Recipe, Result, RunOptions, identity, run

Transcripts = Recipe[list[dict[str, Any]]]
Ask = Callable[[list[dict[str, Any]]], Result]  # sends messages; returns a reply, see `_packed`

_NO_OP = (0.0,) * 6  # an action without force
_FIRST = 20  # requests after which a server that rejected them all isn't asked again
_RESULT = "result.json"
_TRUTH = ("gauss_code", "nx", "grade", "accepted")  # columns of pictures that transcripts repeat
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
    settings, stop = _flat(config), threading.Event()
    chat = Chat(config.chat, stop)

    def _ask(messages: list[dict[str, Any]]) -> Result:
        return _packed(chat.ask(messages))

    def _recipe(place: Path) -> Recipe[str]:
        transcripts = yield from (_read(config, rows, _ask) if rows else _play(config, _ask))
        result = {"version": knotgym.__version__, **summarize(transcripts), "settings": settings}
        result["identity"] = run_identity
        if rows:
            result["scores"] = reading_scores(transcripts)
        place.mkdir(parents=True)
        (place / FILE).write_text("".join(map(line, transcripts)), encoding="utf-8")
        (place / _RESULT).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        return f"{FILE}, {_RESULT}"

    asked = {**settings, "chat": {k: v for k, v in settings["chat"].items() if k not in _FREE}}
    told = [(row["image"], [row[name] for name in _TRUTH]) for row in rows]
    # wherever their table lies
    read = {"pictures": hashlib.sha256(repr(told).encode()).hexdigest()} if rows else {}
    run_identity = identity(config, read, fields=asked)
    pool = partial(_Requests, config.side_by_side, stop)
    begin = partial(run, pool=pool, count=_retries, identity_in=_RESULT)
    return begin(_recipe, out, run_identity, options, progress)


def sample_prompt(
    config: PromptConfig, rows: Sequence[Mapping[str, Any]] = ()
) -> tuple[str, dict[str, bytes]]:
    """Return a run's first request as text for people, and its pictures, by name, as PNG."""

    def _ask(messages: list[dict[str, Any]]) -> Result:
        raise AssertionError("a sample is never sent")

    (asked,) = next(_read(config, rows[:1], _ask) if rows else _play(config, _ask))[0].arguments
    lines, pictures = list[str](), dict[str, bytes]()
    for message in asked:
        lines.append(f"--- {message['role']}")
        for part in message["content"]:
            if part["type"] == "text":
                lines.append(part["text"])
            else:
                name = f"picture-{len(pictures) + 1}"
                pictures[name] = base64.b64decode(part["image_url"]["url"].partition(",")[2])
                lines.append(f"[{name}]")
    return "\n".join(lines) + "\n", pictures


def _play(config: PromptConfig, ask: Ask) -> Transcripts:
    """Play all episodes of a run; the recipe returns their transcripts."""
    count, most = config.episodes, config.task.horizon
    ids = np.arange(count)
    seeds = [Stream.EVALUATION_EPISODE.derived_seed(config.seed, k) for k in range(count)]
    batch = EpisodeBatch(config.task, count)
    batch.begin(ids, seeds)
    begun = batch.infos(ids)
    goals = _pictures(batch, ids, config, goal=True)
    befores = [opening(goal) for goal in goals]
    episodes: list[dict[str, Any]] = [
        {
            "number": number,
            "config": _flat(config),
            "seed": seeds[number],
            "start": int(begun["start"][number]),
            "goal": int(begun["goal"][number]),
            "goal_gauss_code": str(begun["goal_gauss_code"][number]),
            "success": False,
            "gauss_code": [str(begun["gauss_code"][number])],
            "actions": [],
            "prompt": [
                part if isinstance(part, str) else {"picture": part.sha256}
                for part in befores[number]
            ],
            "turns": [],
        }
        for number in range(count)
    ]
    windows: list[list[Turn]] = [[] for _ in range(count)]
    queued: list[list[list[float]]] = [[] for _ in range(count)]
    playing, turns = ids, 0
    while len(playing):
        numbers = playing.tolist()
        if config.mode != "open" or not turns:
            nows = _pictures(batch, playing, config)
            requests = [
                (number, messages(befores[number], windows[number], config.mode, most, now))
                for number, now in zip(numbers, nows, strict=True)
            ]
            replies = yield from _replies(requests, turns, ask)
            turns += 1
            for number, now, reply in zip(numbers, nows, replies, strict=True):
                text = "" if reply["fault"] else reply["text"]
                actions, fault = read_actions(text, most if config.mode == "open" else 1)
                turn = {
                    "step": len(episodes[number]["actions"]),
                    "picture": now.sha256,
                    "window": len(windows[number]),
                    **_answer(reply, fault),
                    "actions": actions,
                }
                episodes[number]["turns"].append(turn)
                queued[number] = [*actions]
                if config.mode == "stateful":
                    windows[number] = [*windows[number], Turn(now, reply["text"])][-config.window :]
        # float32, as in policies, so that a replay is the same to the bit
        chosen = [queued[n].pop(0) if queued[n] else _NO_OP for n in numbers]
        pulls = np.array(chosen, dtype=np.float32)
        outcome = batch.act(pulls, playing)
        for number, action, code in zip(numbers, pulls, batch.codes_of(playing), strict=True):
            episodes[number]["actions"].append(action.tolist())
            episodes[number]["gauss_code"].append(str(code))
        playing = playing[~(outcome.terminated | outcome.truncated)]
    for episode, success in zip(episodes, batch.successes(ids).tolist(), strict=True):
        episode["success"] = success
        episode |= {name: total(episode["turns"], name) for name in TOKENS}
    return episodes


def _read(config: PromptConfig, rows: Sequence[Mapping[str, Any]], ask: Ask) -> Transcripts:
    """Ask for the Gauss codes of pictures, rows of a perception table; return the transcripts."""
    pictures = [Picture(row["image"]) for row in rows]
    requests = [*enumerate(map(reading, pictures))]
    replies = yield from _replies(requests, 0, ask)
    transcripts = []
    for number, (row, picture, reply) in enumerate(zip(rows, pictures, replies, strict=True)):
        code, fault = read_code("" if reply["fault"] else reply["text"])
        truth = {name: row[name] for name in _TRUTH}
        request = {"number": number, "config": _flat(config), "picture": picture.sha256}
        read = {"read": None if code is None else str(code)}
        transcripts.append(request | truth | _answer(reply, fault) | read)
    return transcripts


def _packed(reply: Mapping[str, Any]) -> Result:
    """Pack a reply as what a journal keeps: the result of `Chat.ask` as JSON."""
    return {"reply": np.frombuffer(json.dumps(reply).encode(), dtype=np.uint8)}


def _unpacked(packed: Result) -> dict[str, Any]:
    """Unpack a reply that `_packed` packed."""
    return dict(json.loads(bytes(packed["reply"])))


def _retries(packed: Result) -> dict[str, int]:
    return {"retries": sum(_unpacked(packed)["retries"].values())}


def _flat(config: PromptConfig) -> dict[str, Any]:
    """Convert settings to the JSON of a transcript; in mode read, without the task."""
    fields = as_json(config)
    del fields["side_by_side"]
    if config.mode == "read":
        del fields["task"]
    return fields


def _replies(
    requests: Sequence[tuple[int, list[dict[str, Any]]]], turn: int, ask: Ask
) -> Recipe[list[dict[str, Any]]]:
    """Send a round of requests, as calls named by the digest of what is asked; return the replies.

    Raises:
        InvalidInput: the server rejects the first requests of a run, one and all.
    """
    digests = [hashlib.sha256(json.dumps(asked).encode()).hexdigest() for _, asked in requests]
    calls = [
        Call(f"request {turn + 1} {number}:{digest}", ask, (asked,))
        for (number, asked), digest in zip(requests, digests, strict=True)
    ]
    replies = list[dict[str, Any]]()
    # a server that rejects all of these rejects everything, for example a setting
    for some in (calls[:_FIRST], calls[_FIRST:]) if turn == 0 else (calls,):
        replies += map(_unpacked, (yield some))
        if turn == 0 and all(reply["rejected"] for reply in replies):
            raise InvalidInput(
                f"the server rejects all of {len(replies)} requests, the last one with"
                f" {replies[-1]['rejected']}; once that is mended, --restart begins again"
            )
    return replies


def _answer(reply: Mapping[str, Any], fault: str) -> dict[str, Any]:
    """Return the fields of a transcript that describe a reply; its own fault comes first."""
    names = ("reasoning", "rejected", "finish", "retries", *TOKENS)
    whole = {"answer": reply["text"], "fault": reply["fault"] or fault}
    return whole | {name: reply[name] for name in names}


def _pictures(
    batch: EpisodeBatch, ids: NDArray[np.int64], config: PromptConfig, goal: bool = False
) -> list[Picture]:
    """Encode the pictures of the goals, or the current ones with their captions."""
    size = config.task.image_size
    images = [batch.rgb(index) for index in ids.tolist()]
    if goal:
        return [Picture(encode(image[:, size:]), TEXTS["goal"]) for image in images]
    # in units of actions
    middles = batch.simulation.points[ids].mean(axis=1) / config.task.rope_config.reach
    caption = TEXTS["now_at" if config.tell_centre else "now"]
    return [
        Picture(encode(image[:, :size]), caption.format(x=x, y=y))
        for image, (x, y, _) in zip(images, middles.tolist(), strict=True)
    ]


class _Requests(Executor):
    """Threads that mostly wait for a server; after an error, the others are stopped.

    They are daemons, so that one that waits doesn't keep an interrupted run alive.
    """

    def __init__(self, count: int, stop: threading.Event) -> None:
        self.workers, self._slots, self._stop = count, threading.Semaphore(count), stop

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        promise: Future[Any] = Future()

        def _work() -> None:
            with self._slots:
                try:
                    promise.set_result(function(*arguments, **named))
                except BaseException as error:
                    self._stop.set()
                    promise.set_exception(error)

        threading.Thread(target=_work, daemon=True).start()
        return promise

    def __exit__(self, *error: object) -> None:
        self._stop.set()
