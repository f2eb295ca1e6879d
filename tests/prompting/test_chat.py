"""Hostile, slow and peculiar servers: what they return is bounded, counted, and never the key."""

from __future__ import annotations

import gzip
import json
import time
import tracemalloc
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from knotgym.common import Failed, InvalidInput, one_line
from knotgym.prompting.chat import Chat, ChatConfig

from .chat_server import Answer, ChatServer, always, completion

KEY = "sk-test/+" + "51ec2e7" * 4
WORDS = "I pull."
REFUSAL = completion({"content": None, "refusal": "I can't"})
OVERLOADED: Answer = (200, {}, '{"error": {"message": "overloaded"}}')


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def asked(answer: Callable[[int, Any], Answer], **settings: Any) -> tuple[Any, ChatServer]:
    """Send one request to a server; return the reply or the error raised."""
    server = ChatServer(answer)
    with server.serving():
        usual = {"model": "m", "timeout": 1.0, "attempts": 3}
        chat = Chat(ChatConfig(**{**usual, "base_url": server.url, **settings}))
        try:
            return SimpleNamespace(**chat.ask([{"role": "user", "content": "?"}])), server
        except Exception as error:
            return error, server


@pytest.mark.parametrize(
    ("misdeed", "reason"),
    [
        ((500, {}, "oh"), "500"),
        (lambda: [b"HTTP/1.1 200 OK\r\ncontent-length: 999\r\n\r\n{"], "connection"),
        ((200, {}, "{not json"), "malformed"),
        ((200, {}, '{"choices": []}'), "malformed"),
        (OVERLOADED, "error"),
        (completion({"content": None}, "error"), "error"),
        (REFUSAL, "refusal"),
        (completion({"content": None, "reasoning_content": "<answer>"}), "empty"),
        (completion({"content": "<think>cut off in thought"}, "length"), "empty"),
    ],
)
def test_a_request_that_fails_is_sent_again_and_counted(misdeed: Answer, reason: str) -> None:
    reply, server = asked(lambda number, body: WORDS if number else misdeed)
    assert (reply.text, reply.fault, reply.retries) == (WORDS, "", {reason: 1})
    assert len(server.requests) == 2 and server.requests[0] == server.requests[1]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ([{"type": "text", "text": "I "}, {"type": "text", "text": "pull."}], "I pull."),
        ([{"type": "thinking", "text": "hm"}, {"type": "text", "text": "yes"}], "yes"),
        ("<think><answer>draft</answer></think>final", "final"),
        ("final<think>afterthought</think>", "final"),
        ("[THINK]draft[/THINK]final", "final"),
        ("<|channel|>analysis<|message|>a<|end|><|channel|>final<|message|>final", "final"),
        ("◁think▷draft◁/think▷final", "final"),
    ],
)
def test_only_what_a_model_says_at_last_is_its_answer(content: Any, text: str) -> None:
    reply, _ = asked(always(completion({"content": content})))
    assert (reply.text, reply.finish) == (text, "stop")


def test_a_model_that_goes_on_refusing_has_answered_so() -> None:
    reply, _ = asked(always(REFUSAL))
    assert (reply.fault, reply.text, reply.retries) == ("refusal", "I can't", {"refusal": 2})
    assert reply.prompt_tokens == 300  # all three were paid for


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (400, {"message": "filtered", "code": "content_filter"}),
        (403, {"message": "your input was flagged", "code": "moderation"}),
        (451, {"message": "gone\x1b[2J\x00", "code": "law\x1b"}),
    ],
)
def test_a_rejected_request_is_a_refusal(status: int, error: dict[str, str]) -> None:
    reply, server = asked(always((status, {}, json.dumps({"error": error}))))
    assert (reply.fault, reply.text, len(server.requests)) == ("refusal", "", 1)
    said = f"{status} {error.get('code', error.get('type'))}: {error['message']}"
    assert reply.rejected == one_line(said)
    assert (reply.prompt_tokens, reply.completion_tokens) == (0, 0)


@pytest.mark.parametrize("status", [401, 403, 404])
def test_a_server_that_rejects_the_key_or_the_model_is_not_asked_again(status: int) -> None:
    told = json.dumps({"error": {"message": f"bad key {KEY}"}})
    error, server = asked(always((status, {}, told)))
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
    reply, _ = asked(lambda number, body: WORDS if number else drip(first))
    # at the end of the drip it would be a lost connection
    assert reply.text == WORDS and reply.retries == {"timeout": 1}


def test_a_reply_without_end_is_hung_up_on() -> None:
    reply, server = asked(lambda number, body: WORDS if number else flood)
    assert reply.text == WORDS and reply.retries == {"connection": 1}
    assert server.hung_up.wait(5)


def test_compressed_bytes_are_not_expanded() -> None:
    packed = gzip.compress(bytes(20_000_000))
    head = "HTTP/1.1 500 Oh\r\ncontent-encoding: gzip\r\ncontent-length: "
    bomb = f"{head}{len(packed)}\r\n\r\n".encode() + packed
    tracemalloc.start()
    reply, _ = asked(lambda number, body: WORDS if number else (lambda: [bomb]))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reply.retries == {"500": 1} and most < 10_000_000


def test_the_key_is_not_sent_to_where_a_server_redirects() -> None:
    other = ChatServer(always(WORDS))
    with other.serving():
        moved = (302, {"location": f"{other.url}/chat/completions"}, "")
        error, _ = asked(always(moved))
    assert isinstance(error, InvalidInput) and "302" in str(error) and not other.requests


def test_a_local_server_is_not_reached_through_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    assert asked(always(WORDS))[0].text == WORDS
    chat = ChatConfig(model="m", base_url="http://host.invalid/v1", attempts=1, timeout=5)
    with pytest.raises(Failed, match="through the proxy in http_proxy"):
        Chat(chat).ask([])


def test_the_key_is_blotted_in_answers_refusals_and_errors() -> None:
    error, _ = asked(always((401, {}, f"<p>{KEY}</p>")))
    assert isinstance(error, InvalidInput)
    refusal = completion({"content": None, "refusal": KEY})
    texts = [str(error), *(asked(always(a))[0].text for a in (KEY, refusal))]
    for text in texts:
        assert "[key]" in text and KEY not in text


@pytest.mark.parametrize(
    "url", ["http://me:secret@host/v1", "ftp://host", "http://host/v1?key=secret", "host", ""]
)
def test_a_url_that_might_hold_a_key_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(InvalidInput, match="base URL") as refused:
        ChatConfig(model="m", base_url=url)
    assert "secret" not in str(refused.value)


def test_without_a_key_the_public_server_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    with pytest.raises(InvalidInput, match="OPENAI_API_KEY"):
        Chat(ChatConfig(model="m"))
    reply, server = asked(always(WORDS))
    assert reply.text == WORDS and server.keys == [""]
