"""Episodes and pictures with a scripted model: requests, answers and errors."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
import os
import signal
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from knotgym.common.errors import Failed, InvalidFile, InvalidInput
from knotgym.datasets.image_rows import Row, record
from knotgym.datasets.image_table import decode, encode, write_rows
from knotgym.envs.tasks import TaskConfig
from knotgym.prompting.chat import Chat, ChatConfig, _spellings, retry_after
from knotgym.prompting.prompt_run import run
from knotgym.prompting.prompted_episodes import PromptConfig, play, read
from knotgym.prompting.prompts import first
from knotgym.prompting.reading_scores import ReadingScores
from knotgym.prompting.transcripts import read_transcripts
from knotgym.rendering.appearance_config import AppearanceConfig
from knotgym.rope.model import Rope
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import RunOptions
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

from ..conftest import curled
from ..small_job import knotgym
from .chat_server import Answer, ChatServer, hashes, kinds

KEY = "sk-test/+" + "51ec2e7" * 4
PULL = "I pull. <answer>[0.1, 0, 0, 1, 0, 0]</answer>"
NAN = "<answer>[0.1, 0, 0, nan, 0, 0]</answer>"


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def config(url: str, states_path: str, mode: str = "stateless", **more: Any) -> PromptConfig:
    chat = ChatConfig(model="m", base_url=url, timeout=0.5, attempts=3, backoff=0.01)
    task = TaskConfig(task="unknot", nx=2, states=states_path, horizon=4, image_size=16)
    return PromptConfig(**{"mode": mode, "chat": chat, "task": task, "episodes": 2, **more})


def always(answer: Answer) -> Callable[[int, Any], Answer]:
    return lambda number, body: answer


def played(server: ChatServer, states_path: str, mode: str, **more: Any) -> dict[str, Any]:
    with server.serving():
        own = config(server.url, states_path, mode, **more)
        return play(own, 0, Chat(own.chat).ask)


def asked(answer: Callable[[int, Any], Answer]) -> tuple[Any, ChatServer]:
    """Send one request to a server; return the reply or the error raised."""
    server = ChatServer(answer)
    with server.serving():
        chat = Chat(config(server.url, "").chat)
        try:
            return chat.ask([{"role": "user", "content": "?"}]), server
        except Exception as error:
            return error, server


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# what is asked


def test_a_prompt_has_all_parts_in_their_order(states_path: str) -> None:
    server = ChatServer(always(PULL))
    told = played(server, states_path, "stateless")
    (asks,) = {tuple(map(kinds, one["messages"])) for one in server.requests}
    assert asks == ("ttptttptpt",)
    texts = [part.get("text", "") for part in server.requests[0]["messages"][0]["content"]]
    beginnings = ("Task:", "This picture", "", "You succeed", "An action", "The goal:", "")
    assert all(text.startswith(word) for text, word in zip(texts, beginnings, strict=False))
    assert texts[7] == "The rope now:" and "<answer>" in texts[9]
    shown = [hashes(one["messages"][0]) for one in server.requests]
    assert [one[0] for one in shown] == [first().sha256] * len(shown)
    assert [one[2] for one in shown] == [turn["picture"] for turn in told["turns"]]
    assert {one["picture"] for one in told["prompt"] if isinstance(one, dict)} == {*shown[0][:2]}
    assert len(shown) == len(told["actions"]) == len(told["gauss_code"]) - 1


def test_the_window_holds_the_last_turns_and_their_answers(states_path: str) -> None:
    server = ChatServer(lambda number, body: PULL.replace("I pull.", f"Turn {number}."))
    told = played(server, states_path, "stateful", window=2)
    asks = [[kinds(message) for message in one["messages"]] for one in server.requests]
    assert asks[0] == ["ttptttptpt"]
    assert asks[1] == ["ttptttptpt", "a", "tpt"]
    assert asks[2] == asks[3] == ["ttptttptpt", "a", "tpt", "a", "tpt"]
    last = server.requests[3]["messages"]
    assert [one["content"][:7] for one in last if one["role"] == "assistant"] == [
        "Turn 1.",
        "Turn 2.",
    ]
    pictures = [hashes(one)[-1] for one in last if one["role"] == "user"]
    assert pictures == [turn["picture"] for turn in told["turns"][1:]]
    assert [turn["window"] for turn in told["turns"]] == [0, 1, 2, 2]


def test_open_mode_asks_once_and_then_leaves_the_rope_alone(states_path: str) -> None:
    server = ChatServer(always("<answer>[0.1,0,0,1,0,0] [0,0.1,0,0,1,0]</answer>"))
    told = played(server, states_path, "open")
    assert len(server.requests) == 1 and len(told["actions"]) == 4
    assert [any(action) for action in told["actions"]] == [True, True, False, False]


def test_temperature_is_sent_unless_it_is_the_server_s(states_path: str) -> None:
    server = ChatServer(always(PULL))
    played(server, states_path, "open")
    chat = ChatConfig(model="m", base_url=server.url, temperature=None)
    assert server.requests[0]["temperature"] == 1.0 and chat.temperature is None
    assert (server.requests[0]["model"], server.keys[0]) == ("m", f"Bearer {KEY}")


def test_the_middle_of_the_picture_is_told_if_wanted(states_path: str) -> None:
    server = ChatServer(always(PULL))
    played(server, states_path, "open", tell_centre=True)
    assert "middle of this picture" in server.requests[0]["messages"][0]["content"][7]["text"]


# what goes wrong


@pytest.mark.parametrize(
    ("misdeed", "reason"),
    [
        (("status", (500, {}, "oh")), "500"),
        (("status", (429, {"retry-after": "0.01"}, "{}")), "429"),
        (("cut", None), "connection"),
        (("slow", 0.7), "timeout"),
        (("body", "{not json"), "malformed"),
        (("body", '{"choices": []}'), "malformed"),
        (("refusal", "I can't"), "refusal"),
    ],
)
def test_a_question_not_answered_is_put_again_and_counted(misdeed: Answer, reason: str) -> None:
    reply, server = asked(lambda number, body: PULL if number else misdeed)
    assert reply.text == PULL and reply.retries == {reason: 1} and not reply.refused
    assert len(server.requests) == 2 and server.requests[0] == server.requests[1]


def test_retry_after_is_waited_for() -> None:
    began = time.monotonic()
    wait = ("status", (429, {"retry-after": "0.3"}, "{}"))
    asked(lambda number, body: PULL if number else wait)
    assert time.monotonic() - began >= 0.3
    assert retry_after("Wed, 21 Oct 2015 07:28:00 GMT") == retry_after("soon") == 0


def test_a_model_that_goes_on_refusing_has_answered_so() -> None:
    reply, _ = asked(always(("refusal", "I can't")))
    assert reply.refused and reply.text == "I can't" and reply.retries == {"refusal": 2}
    assert reply.prompt_tokens == 300  # all three were paid for


def test_a_server_that_never_answers_ends_the_run() -> None:
    error, server = asked(always(("status", (503, {}, "down"))))
    assert isinstance(error, Failed) and "3 attempts" in str(error)
    assert "503" in str(error) and len(server.requests) == 3


@pytest.mark.parametrize("status", [400, 401, 404])
def test_a_question_the_server_calls_wrong_is_not_put_again(status: int) -> None:
    body = json.dumps({"error": {"message": f"bad key {KEY}"}})
    error, server = asked(always(("status", (status, {}, body))))
    assert isinstance(error, InvalidInput) and len(server.requests) == 1
    assert str(status) in str(error) and KEY not in str(error) and "[key]" in str(error)


def drip(first: bytes) -> Callable[[], Iterator[bytes]]:
    """Yield some bytes, then one every 50 ms for two seconds."""

    def pieces() -> Iterator[bytes]:
        yield first
        for _ in range(40):
            time.sleep(0.05)
            yield b" "

    return pieces


def flood() -> Iterator[bytes]:
    yield b"HTTP/1.1 200 OK\r\ncontent-length: 600000000\r\n\r\n"
    for _ in range(600):
        yield b" " * 1_000_000


@pytest.mark.parametrize(
    "first",
    [
        b"HTTP/1.1 200 OK\r\ncontent-length: 999\r\n\r\n",
        b"HTTP/1.1 500 Oh\r\ncontent-length: 999\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nx:",
    ],
    ids=["body", "error body", "headers"],
)
def test_an_attempt_ends_in_time_however_slowly_bytes_drip(first: bytes) -> None:
    began = time.monotonic()
    reply, _ = asked(lambda number, body: PULL if number else ("raw", drip(first)))
    assert reply.text == PULL and reply.retries == {"timeout": 1}
    assert time.monotonic() - began < 1.5  # 0.5 s are allowed; all that is sent takes 2 s


def test_a_reply_without_end_is_hung_up_on() -> None:
    reply, server = asked(lambda number, body: PULL if number else ("raw", flood))
    assert reply.text == PULL and reply.retries == {"too long": 1}
    assert server.hung_up.wait(5)


def test_compressed_bytes_are_not_expanded() -> None:
    packed = gzip.compress(bytes(20_000_000))
    head = "HTTP/1.1 500 Oh\r\ncontent-encoding: gzip\r\ncontent-length: "
    bomb = f"{head}{len(packed)}\r\n\r\n".encode() + packed
    tracemalloc.start()
    reply, _ = asked(lambda number, body: PULL if number else ("raw", lambda: [bomb]))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reply.retries == {"500": 1} and most < 10_000_000


def test_the_key_is_not_sent_to_where_a_server_redirects() -> None:
    other = ChatServer(always(PULL))
    with other.serving():
        moved = ("status", (302, {"location": f"{other.url}/chat/completions"}, ""))
        error, _ = asked(always(moved))
    assert isinstance(error, InvalidInput) and "302" in str(error) and not other.requests


SPELLINGS = {
    "slashes": KEY.replace("/", r"\/"),
    "unicode": KEY.replace("+", r"\u002b").replace("/", r"\u002F"),
    "escaped twice": json.dumps(json.dumps(KEY.replace("+", r"\u002b"))),
    "percent": quote(KEY, safe=""),
    "percent twice": quote(quote(KEY, safe="")),
    "html": KEY.replace("+", "&#43;").replace("/", "&#x2f;"),
    **{
        f"base64 {shift}": base64.b64encode(b"x" * shift + KEY.encode() + b"y").decode()
        for shift in range(3)
    },
}


@pytest.mark.parametrize("spelled", SPELLINGS.values(), ids=[*SPELLINGS])
@pytest.mark.parametrize(
    "body", ['{"error": {"message": "%s"}}', '{"detail": "%s"}', "<p>%s</p>"], ids=str
)
def test_the_key_is_blotted_however_it_is_spelled(body: str, spelled: str) -> None:
    error, _ = asked(always(("status", (401, {}, body.replace("%s", spelled)))))
    assert isinstance(error, InvalidInput) and "[key]" in str(error)
    assert "51ec2e7" not in str(error) and spelled[8:-8] not in str(error)


@pytest.mark.parametrize("spelled", SPELLINGS.values(), ids=[*SPELLINGS])
def test_a_model_s_words_are_blotted_too(spelled: str) -> None:
    for answer in (spelled, ("refusal", spelled)):
        reply, _ = asked(always(answer))
        assert "[key]" in reply.text and "51ec2e7" not in reply.text
        assert spelled[8:-8] not in reply.text


@pytest.mark.parametrize("letter", ["\\", "&amp;", "%25", "s"])
def test_blotting_takes_time_in_proportion_to_the_text(letter: str) -> None:
    secret = _spellings(KEY)
    seconds = []
    for length in (20_000, 200_000):
        began = time.process_time()
        assert not secret.search(letter * (length // len(letter)))
        seconds.append(time.process_time() - began)
    assert seconds[1] < 40 * seconds[0] + 0.1  # quadratic would be 100 times


def test_half_a_surrogate_pair_doesn_t_end_a_run(states_path: str, tmp_path: Path) -> None:
    broken = [True]

    def answer(number: int, body: Any) -> Answer:
        stopped = broken[0] and number >= 2
        return ("status", (500, {}, "")) if stopped else f"\ud83d{PULL}\ude00"

    server = ChatServer(answer)
    with server.serving():
        own = config(server.url, states_path, "stateful")
        for resume in (False, True):
            try:
                run(
                    own,
                    lambda number, ask: play(own, number, ask),
                    2,
                    tmp_path / "r",
                    RunOptions(resume=resume, quiet=True),
                    side_by_side=1,
                    progress=Progress(quiet=True),
                )
            except Failed:
                broken[0] = False
    (_, told) = read_transcripts(tmp_path / "r" / "transcripts.jsonl")
    assert not broken[0] and told["turns"][0]["answer"] == f"\ufffd{PULL}\ufffd"


def test_wrong_answers_are_counted_apart_and_leave_the_rope_alone(states_path: str) -> None:
    answers = [NAN, "no", PULL, "<answer>[" + ", ".join(["0"] * 11) + "]</answer>"]
    told = played(ChatServer(lambda number, body: answers[number]), states_path, "stateless")
    faults = [turn["fault"] for turn in told["turns"]]
    assert faults == ["not finite", "no block", "", "not six numbers"]
    assert [any(action) for action in told["actions"]] == [False, False, True, False]


@pytest.mark.parametrize(
    "url", ["http://me:secret@host/v1", "ftp://host", "http://host/v1?key=secret", "host", ""]
)
def test_a_url_that_might_hold_a_key_is_refused_and_not_told(url: str) -> None:
    with pytest.raises(InvalidInput, match="base URL") as refused:
        ChatConfig(model="m", base_url=url)
    assert "secret" not in str(refused.value)


def test_without_a_key_the_public_server_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    with pytest.raises(InvalidInput, match="OPENAI_API_KEY"):
        Chat(ChatConfig(model="m"))
    Chat(ChatConfig(model="m", base_url="http://127.0.0.1:1/v1"))


def test_a_word_that_stands_for_no_key_is_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "pull")
    assert asked(always(PULL))[0].text == PULL


def test_a_key_in_the_base_url_is_refused() -> None:
    with pytest.raises(InvalidInput, match="--base-url") as refused:
        Chat(ChatConfig(model="m", base_url=f"http://127.0.0.1:1/{KEY}/v1"))
    assert KEY not in str(refused.value)


# runs


def test_a_run_is_resumed_shown_and_replayed_and_the_key_is_nowhere(
    states_path: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = [True]

    def answer(number: int, body: Any) -> Answer:
        if broken[0] and number >= 6:
            return ("status", (500, {}, f"the key {KEY} is bad"))
        return f"{PULL} {KEY}" if number % 3 else NAN

    server = ChatServer(answer)
    with server.serving():
        command = (
            *(
                "prompt",
                "--task",
                "unknot",
                "--nx",
                2,
                "--states",
                states_path,
                "--set",
                "task.horizon=4",
            ),
            *(
                "--set",
                "task.image_size=16",
                "--episodes",
                3,
                "--model",
                "m",
                "--base-url",
                server.url,
            ),
            *(
                "--set",
                "attempts=2",
                "--set",
                "chat.backoff=0",
                "--set",
                "side_by_side=1",
                "--seed",
                5,
            ),
            *("--set", "prompt_price=2", "--set", "completion_price=4", "--out", tmp_path / "run"),
        )
        assert knotgym(*command) == 1
        assert not (tmp_path / "run").exists()
        replies = tmp_path / ".run.partial" / "replies.jsonl"
        assert len(replies.read_text().splitlines()) == 6
        replies.write_text(replies.read_text() + '[9, 9, "as a kill le')
        broken[0] = False
        before = len(server.requests)
        assert knotgym(*command, "--set", "window=3", "--resume") == 2  # another run
        assert knotgym(*command, "--resume") == 0
        assert len(server.requests) == before + 6  # of three episodes of four actions
        assert knotgym(*command, "--resume") == 0 and knotgym(*command) == 2  # it is there
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    told = read_transcripts(tmp_path / "run" / "transcripts.jsonl")
    assert [one["number"] for one in told] == [0, 1, 2]
    assert result["answers"] == {"valid": 8, "not finite": 4} and result["episodes"] == 3
    assert (result["prompt_tokens"], result["completion_tokens"]) == (1200, 120)
    assert result["cost"] == pytest.approx(0.00288)
    assert result["settings"]["window"] == 4 and result["settings"]["task"]["horizon"] == 4
    assert knotgym("dataset", "show", tmp_path / "run" / "transcripts.jsonl") == 0
    assert "unknot nx 2" in capfd.readouterr().out.splitlines()[-5]
    replay = (
        *("evaluate", "--policy", f"prompt:{tmp_path / 'run'}", "--task", "unknot", "--nx", 2),
        *("--states", states_path, "--set", "task.horizon=4", "--episodes", 3, "--workers", 1),
    )
    again = tmp_path / "again.json"
    assert knotgym(*replay, "--split", "train", "--seed", 5, "--out", again) == 0
    assert json.loads(again.read_text())["success_rate"] == result["success_rate"]
    assert knotgym(*replay, "--split", "train") == 2 and knotgym(*replay, "--seed", 5) == 2
    said = capfd.readouterr()
    assert "--seed 5" in said.err and 'split is "train" there and "test" here' in said.err
    everything = b"".join(files_of(tmp_path).values()) + (said.out + said.err).encode()
    assert KEY.encode() not in everything and b"[key]" in everything


def test_a_replay_shows_the_same_codes(states_path: str) -> None:
    from knotgym.control.rollouts import EVALUATION, rollout
    from knotgym.prompting.transcript_policy import TranscriptPolicy

    told = played(ChatServer(always(PULL)), states_path, "open")
    task = config("http://host", states_path).task
    (again,) = rollout(task, TranscriptPolicy([told], "t"), [0], 0, streams=EVALUATION)
    assert again.episode.gauss_code.tolist() == told["gauss_code"]


def test_ctrl_c_leaves_what_is_whole(
    states_path: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # put back afterwards

    def answer(number: int, body: Any) -> Answer:
        if number == 4:  # the first episode is over, the second has begun
            os.kill(os.getpid(), signal.SIGINT)
        return PULL if number < 4 else ("slow", 1)

    server = ChatServer(answer)
    with server.serving():
        status = knotgym(
            *("prompt", "--task", "unknot", "--states", states_path, "--set", "task.horizon=4"),
            *(
                "--set",
                "task.image_size=16",
                "--episodes",
                2,
                "--model",
                "m",
                "--base-url",
                server.url,
            ),
            *("--set", "side_by_side=1", "--quiet", "--out", tmp_path / "run"),
        )
    said = capfd.readouterr().err
    assert status == 130 and "--resume continues" in said and said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == [".run.partial"]
    kept = (tmp_path / ".run.partial" / "replies.jsonl").read_text()
    assert [json.loads(one)[:2] for one in kept.splitlines()] == [[0, turn] for turn in range(4)]


def test_side_by_side_gives_the_same_transcripts(states_path: str, tmp_path: Path) -> None:
    server = ChatServer(always(PULL))
    texts = []
    with server.serving():
        chat = ChatConfig(model="m", base_url=server.url)  # retries are in the transcripts
        own = config(server.url, states_path, "open", episodes=3, chat=chat)
        for count in (1, 3):
            out = tmp_path / str(count)
            run(
                own,
                lambda number, ask: play(own, number, ask),
                3,
                out,
                RunOptions(quiet=True),
                side_by_side=count,
                progress=Progress(quiet=True),
            )
            texts.append((out / "transcripts.jsonl").read_text())
        with pytest.raises(InvalidInput, match="at least 1"):
            run(
                own,
                lambda number, ask: play(own, number, ask),
                1,
                out,
                RunOptions(quiet=True),
                side_by_side=0,
                progress=Progress(True),
            )
    assert texts[0] == texts[1]


# reading


def test_a_picture_s_code_is_asked_for_and_scored() -> None:
    picture = encode(decode(first().png)[:16, :16])
    row = {"image": picture, "gauss_code": "1+,1-,2-,2+", "nx": 2, "grade": "easy"}
    answers = ["<answer>1+,1-,2-,2+</answer>", "<answer>1+,1-</answer>", "it is a loop"]
    server = ChatServer(lambda number, body: answers[number])
    with server.serving():
        own = config(server.url, "", "read")
        chat = Chat(own.chat)
        told = [read(own, k, {**row, "accepted": k == 0}, chat.ask) for k in range(3)]
    assert [hashes(one["messages"][0])[1] for one in server.requests] == [told[0]["picture"]] * 3
    assert [one["fault"] for one in told] == ["", "", "no block"]
    scores = ReadingScores.of(told).as_json()
    assert [*scores] == ["all", "nx 2", "easy", "accepted", "accepted, nx 2"]
    assert scores["all"] == pytest.approx(
        {"pictures": 3, "exact": 1 / 3, "crossings": 1 / 3, "edits": 2}
    )
    assert scores["accepted"] == {"pictures": 1, "exact": 1, "crossings": 1, "edits": 0}


def test_chirality_is_no_matter_when_a_code_is_scored() -> None:
    scores = ReadingScores()
    assert scores.add(GaussCode.parse("1+,1-"), GaussCode.parse("1+a,1-a"), "easy", True)


# transcripts


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "line 1 isn't JSON"),
        ("[]", "isn't a transcript"),
        ("{}", "format None"),
        ('{"format": "knotgym-transcript", "format_version": 9}', "version 9"),
        ('{"format": "knotgym-transcript", "format_version": 1, "actions": 3}', "number must be"),
    ],
)
def test_a_line_that_is_no_transcript_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "t.jsonl").write_text(text + "\n")
    with pytest.raises(InvalidFile, match=said):
        read_transcripts(tmp_path / "t.jsonl")


@pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="pyarrow isn't installed")
def test_a_model_reads_the_pictures_of_a_split(rope: Rope, tmp_path: Path) -> None:
    ropes = [rope.from_curve(curled(nx, 0.3)) for nx in (1, 2, 1)]
    sources = [{"seed": 0, "family": number, "row": number} for number in range(len(ropes))]
    rows = [
        record(Row(points, label(points), "test", source), AppearanceConfig())
        for points, source in zip(ropes, sources, strict=True)
    ]
    write_rows(tmp_path / "table.parquet", rows)
    server = ChatServer(always(f"<answer>{label(ropes[0])}</answer>"))
    with server.serving():
        command = (
            *("prompt", "--mode", "read", tmp_path / "table.parquet", "--model", "m"),
            *("--base-url", server.url, "--quiet", "--out", tmp_path / "run"),
        )
        assert knotgym(*command, "--episodes", 2) == 0
        assert knotgym("prompt", "--mode", "open", tmp_path / "table.parquet") == 2
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert len(server.requests) == result["pictures"] == 2
    assert {key: score["exact"] for key, score in result["scores"].items() if "nx" in key[:2]} == {
        "nx 1": 1,
        "nx 2": 0,
    }
    assert knotgym("dataset", "show", tmp_path / "run") == 0
