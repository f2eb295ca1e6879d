"""Play episodes with a model, or have it read pictures; record each as a transcript.

The model is asked once per action, or in mode open once per episode. Where an answer is invalid, or
the actions of mode open are used up, the step is a no-op: an action without force. So a transcript
always has a full sequence of actions.

Both are recipes, see `knotgym.runs`: all episodes go on side by side, and each round of requests is
a batch of calls. Replies are kept by the digest of their request, so a resumed run asks only for
those that are missing.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, Stream, as_json
from knotgym.datasets import encode
from knotgym.envs import EpisodeBatch
from knotgym.prompting.answers import read_actions, read_code
from knotgym.prompting.prompt_config import PromptConfig
from knotgym.prompting.prompts import (
    OPEN,
    READ,
    STATEFUL,
    TEXTS,
    Part,
    Picture,
    Turn,
    caption,
    message,
    messages,
    opening,
    reading,
)
from knotgym.prompting.transcripts import TOKENS, total
from knotgym.runs import Call, Recipe, Result

Transcripts = Recipe[list[dict[str, Any]]]
Ask = Callable[[list[dict[str, Any]]], Result]  # sends messages; returns a reply, see `packed`

_NO_OP = (0.0,) * 6  # an action without force
_FIRST = 20  # requests after which a server that rejected them all isn't asked again


def play(config: PromptConfig, ask: Ask) -> Transcripts:
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
            "config": flat(config),
            "seed": seeds[number],
            "start": int(begun["start"][number]),
            "goal": int(begun["goal"][number]),
            "goal_gauss_code": str(begun["goal_gauss_code"][number]),
            "success": False,
            "gauss_code": [str(begun["gauss_code"][number])],
            "actions": [],
            "prompt": [_named(part) for part in befores[number]],
            "turns": [],
        }
        for number in range(count)
    ]
    windows: list[list[Turn]] = [[] for _ in range(count)]
    planned: list[list[list[float]]] = [[] for _ in range(count)]
    playing, turns = ids, 0
    while len(playing):
        if config.mode != OPEN or not turns:
            nows = _pictures(batch, playing, config)
            requests = [
                (number, messages(befores[number], windows[number], config.mode, most, now))
                for number, now in zip(playing.tolist(), nows, strict=True)
            ]
            replies = yield from _replies(requests, turns, ask)
            turns += 1
            for number, now, reply in zip(playing.tolist(), nows, replies, strict=True):
                limit = most if config.mode == OPEN else 1
                actions, fault = read_actions(reply["text"], limit)
                if reply["fault"]:
                    actions, fault = [], reply["fault"]
                planned[number] = list(actions)
                turn = {
                    "step": len(episodes[number]["actions"]),
                    "picture": now.sha256,
                    "window": len(windows[number]),
                    **_answer(reply, fault),
                    "actions": actions,
                }
                episodes[number]["turns"].append(turn)
                if config.mode == STATEFUL:
                    window = [*windows[number], Turn(now, reply["text"])]
                    windows[number] = window[-config.window :]
        # float32, as in policies, so that a replay is the same to the bit
        chosen = [planned[n].pop(0) if planned[n] else _NO_OP for n in playing.tolist()]
        pulls = np.array(chosen, dtype=np.float32)
        outcome = batch.act(pulls, playing)
        for number, action, code in zip(
            playing.tolist(), pulls, batch.codes_of(playing), strict=True
        ):
            episodes[number]["actions"].append(action.tolist())
            episodes[number]["gauss_code"].append(str(code))
        playing = playing[~(outcome.terminated | outcome.truncated)]
    for one, success in zip(episodes, batch.successes(ids).tolist(), strict=True):
        one["success"] = success
        one |= {name: total(one["turns"], name) for name in TOKENS}
    return episodes


def read(config: PromptConfig, rows: Sequence[Mapping[str, Any]], ask: Ask) -> Transcripts:
    """Ask for the Gauss codes of pictures, rows of a perception table; return the transcripts."""
    pictures = [Picture(row["image"]) for row in rows]
    requests = [(number, [message(reading(one))]) for number, one in enumerate(pictures)]
    replies = yield from _replies(requests, 0, ask)
    transcripts = []
    for number, (row, picture, reply) in enumerate(zip(rows, pictures, replies, strict=True)):
        code, fault = read_code(reply["text"])
        if reply["fault"]:
            code, fault = None, reply["fault"]
        truth = {name: row[name] for name in ("gauss_code", "nx", "grade", "accepted")}
        transcripts.append(
            {
                "number": number,
                "config": flat(config),
                "picture": picture.sha256,
                **truth,
                **_answer(reply, fault),
                "read": None if code is None else str(code),
            }
        )
    return transcripts


def packed(reply: Mapping[str, Any]) -> Result:
    """Pack a reply as what a journal keeps: the result of `Chat.ask` as JSON."""
    return {"reply": np.frombuffer(json.dumps(reply).encode(), dtype=np.uint8)}


def unpacked(kept: Result) -> dict[str, Any]:
    """Unpack a reply that `packed` packed."""
    reply: dict[str, Any] = json.loads(bytes(kept["reply"]))
    return reply


def flat(config: PromptConfig) -> dict[str, Any]:
    """Convert settings to the JSON of a transcript; in mode read, without the task."""
    fields = as_json(config)
    del fields["side_by_side"]
    if config.mode == READ:
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
        replies += map(unpacked, (yield some))
        if turn == 0 and all(one["rejected"] for one in replies):
            raise InvalidInput(
                f"the server rejects all of {len(replies)} requests, the last one with"
                f" {replies[-1]['rejected']}; once that is mended, --restart begins again"
            )
    return replies


def _answer(reply: Mapping[str, Any], fault: str) -> dict[str, Any]:
    """Return the fields of a transcript that describe a reply."""
    kept = ("reasoning", "rejected", "finish", "retries", *TOKENS)
    return {"answer": reply["text"], "fault": fault, **{name: reply[name] for name in kept}}


def _named(part: Part) -> Any:
    return part if isinstance(part, str) else {"picture": part.sha256}


def _pictures(
    batch: EpisodeBatch, ids: NDArray[np.int64], config: PromptConfig, goal: bool = False
) -> list[Picture]:
    """Encode the pictures of the goals, or the current ones with their captions."""
    size = config.task.image_size
    images = [batch.rgb(index) for index in ids.tolist()]
    if goal:
        return [Picture(encode(image[:, size:]), TEXTS["goal"]) for image in images]
    middles = batch.simulation.points[ids].mean(axis=1) / config.task.rope_config.reach
    return [
        Picture(encode(image[:, :size]), caption(middle[:2] if config.tell_centre else None))
        for image, middle in zip(images, middles.tolist(), strict=True)
    ]
