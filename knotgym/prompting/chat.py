"""One question to a chat-completions server, asked until it is answered.

The key is OPENAI_API_KEY's. It goes into requests alone: wherever a server's words are kept or told
it is blotted out of them. The `openai` package is imported when a `Chat` is made.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import threading
import time
from collections import Counter
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from knotgym.configuration import check_numbers
from knotgym.errors import KnotgymError, install_command, one_line
from knotgym.runs.run_options import NotEnough

KEY = "OPENAI_API_KEY"
PUBLIC = "https://api.openai.com/v1"
_LONGEST_WAIT = 600.0  # seconds, whatever a server asks for
_RETRIED = (408, 409, 425, 429)  # and all from 500 on
_TOLD = 200  # characters of what a server says
_SECRET = 8  # characters of a key, at least


class InvalidChat(KnotgymError, ValueError):
    """A server or model that cannot be asked so."""


class Unanswered(NotEnough):
    """A question was asked as often as allowed, and not answered."""


class Stopped(KnotgymError, RuntimeError):
    """The run was stopped while a question was open."""


@dataclass(frozen=True, kw_only=True)
class ChatConfig:
    """Whom to ask, and how.

    Attributes:
        model: its name at the server.
        base_url: of the server, such as http://127.0.0.1:8000/v1.
        temperature: of sampling; None leaves it to the server.
        timeout: seconds until an answer counts as lost.
        attempts: of each question.
        backoff: seconds before the second attempt, doubled before each one after it.
    """

    model: str
    base_url: str = PUBLIC
    temperature: float | None = 1.0
    timeout: float = 120.0
    attempts: int = 6
    backoff: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("attempts",),
            positive=("timeout",),
            non_negative=("backoff", *(["temperature"] if self.temperature is not None else [])),
            error=InvalidChat,
        )
        if not self.model.strip():
            raise InvalidChat("name the model to ask: --model NAME")
        try:
            parts = urlsplit(self.base_url)
            fits = parts.scheme in ("http", "https") and bool(parts.hostname)
            bare = "@" not in parts.netloc and not parts.query and not parts.fragment
        except ValueError:
            fits = bare = False
        if not (fits and bare):  # not told again: a key may be in it
            raise InvalidChat(
                "the base URL must be http://HOST/PATH or https://HOST/PATH, without user, password"
                f" or query; a key goes into the environment, as {KEY}"
            )


class Reply(NamedTuple):
    """What came of one question.

    Attributes:
        text: the model's words.
        refused: it would not answer, at the last attempt too.
        prompt_tokens, completion_tokens: of all attempts that were answered.
        retries: why attempts were made again -> how often.
    """

    text: str
    refused: bool
    prompt_tokens: int
    completion_tokens: int
    retries: dict[str, int]


class _Attempt(NamedTuple):
    """What came of one attempt: a text; or a reason to try again, how long to wait, what was
    said.
    """

    text: str = ""
    reason: str = ""
    wait: float = 0.0
    said: str = ""
    tokens: tuple[int, int] = (0, 0)


class Chat:
    """A server, to be asked by several threads at once.

    Args:
        config: whom and how.
        stop: when it is set, questions end with Stopped.

    Raises:
        InvalidChat: the `openai` package isn't installed, or there is no key for the public server.
    """

    def __init__(self, config: ChatConfig, stop: threading.Event | None = None) -> None:
        self._config, self._stop = config, stop or threading.Event()
        self._openai = _openai()
        self._key = os.environ.get(KEY, "").strip()
        if not self._key and config.base_url == PUBLIC:
            raise InvalidChat(
                f"{PUBLIC} wants a key: set {KEY} in the environment, or give --base-url of a"
                " server that needs none"
            )
        if not (self._key.isascii() and self._key.isprintable()):
            raise InvalidChat(f"{KEY} holds letters that no key has")
        # "EMPTY" and the like, for servers that want no key, are words as others are
        self._secret = self._key if len(self._key) >= _SECRET else ""
        if self._secret and any(self._secret in text for text in (config.base_url, config.model)):
            raise InvalidChat(f"the key belongs into {KEY} alone, not into --base-url or --model")
        self._client = self._openai.OpenAI(
            api_key=self._key or "none",
            base_url=config.base_url,
            timeout=config.timeout,
            max_retries=0,  # they are made and counted here
        )

    def close(self) -> None:
        """Close all connections."""
        self._client.close()

    def ask(self, messages: list[dict[str, Any]]) -> Reply:
        """Put a question, and again with growing pauses where it isn't answered.

        Args:
            messages: as the protocol has them.

        Raises:
            InvalidChat: the server says that the question, the model or the key is wrong.
            Unanswered: no attempt was answered.
            Stopped: the run was.
        """
        retries: Counter[str] = Counter()
        tokens = [0, 0]
        for attempt in range(1, self._config.attempts + 1):
            if self._stop.is_set():
                raise Stopped("stopped")
            tried = self._try(messages)
            tokens = [sum(pair) for pair in zip(tokens, tried.tokens, strict=True)]
            last = attempt == self._config.attempts
            if not tried.reason or (last and tried.reason == "refusal"):
                return Reply(tried.text, bool(tried.reason), tokens[0], tokens[1], dict(retries))
            if last:
                raise Unanswered(
                    f"{self._config.base_url} didn't answer in {attempt} attempts, the last ended"
                    f" with: {tried.reason}{tried.said and ': '}{tried.said}; --resume goes on"
                )
            retries[tried.reason] += 1
            pause = tried.wait or self._config.backoff * 2 ** (attempt - 1)
            self._stop.wait(min(pause, _LONGEST_WAIT))
        raise AssertionError("at least one attempt is made")

    def _try(self, messages: list[dict[str, Any]]) -> _Attempt:
        how = {} if self._config.temperature is None else {"temperature": self._config.temperature}
        try:
            raw = self._client.chat.completions.with_raw_response.create(
                model=self._config.model, messages=messages, **how
            )
            return self._read(raw.text)
        except self._openai.APITimeoutError:
            return _Attempt(reason="timeout")
        except self._openai.APIConnectionError as error:
            return _Attempt(reason="connection", said=self._told(error.__cause__ or error))
        except self._openai.APIStatusError as error:
            status, said = int(error.status_code), _complaint(self._blotted(error.response.text))
            if status not in _RETRIED and status < 500:
                raise InvalidChat(
                    f"{self._config.base_url} refuses the question to model"
                    f" {self._config.model!r}: {status} {said}"
                ) from None  # the cause holds the request, and that the key
            wait = retry_after(error.response.headers.get("retry-after"))
            return _Attempt(reason=str(status), wait=wait, said=said)

    def _read(self, body: str) -> _Attempt:
        try:
            whole = json.loads(body)
            choice = whole["choices"][0]
            message = choice["message"]
            text, refusal = message.get("content"), message.get("refusal")
            usage = whole.get("usage") or {}
            tokens = (_count(usage.get("prompt_tokens")), _count(usage.get("completion_tokens")))
            fits = isinstance(text, str) or refusal or choice.get("finish_reason")
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return _Attempt(reason="malformed")
        if not fits:
            return _Attempt(reason="malformed")
        words = self._blotted(text if isinstance(text, str) else "")
        if refusal or choice.get("finish_reason") == "content_filter":
            told = self._blotted(refusal) if isinstance(refusal, str) else words
            return _Attempt(told, "refusal", tokens=tokens)
        return _Attempt(words, tokens=tokens)

    def _told(self, error: BaseException) -> str:
        """What an error says, short and without the key."""
        return self._blotted(one_line(error))[:_TOLD]

    def _blotted(self, text: str) -> str:
        return text.replace(self._secret, "[key]") if self._secret else text


def retry_after(header: str | None) -> float:
    """Seconds that a server asks to be left alone, 0 if it doesn't say.

    >>> retry_after("2.5"), retry_after("nan"), retry_after(None)
    (2.5, 0.0, 0.0)
    """
    if not header:
        return 0.0
    try:
        seconds = float(header)
    except ValueError:
        try:
            seconds = parsedate_to_datetime(header).timestamp() - time.time()
        except (ValueError, OverflowError):
            return 0.0
    return seconds if 0 < seconds < math.inf else 0.0


def _complaint(body: str) -> str:
    """What a server says is wrong, short: as OpenAI's says it, or as it comes."""
    try:
        said = json.loads(body)["error"]["message"]
    except (ValueError, LookupError, TypeError, RecursionError):
        said = body
    return " ".join(str(said).split())[:_TOLD]


def _count(value: Any) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0


def _openai() -> Any:
    try:
        return importlib.import_module("openai")
    except ImportError as error:
        raise InvalidChat(
            "prompting a model needs the openai client, which isn't installed; install it:"
            f" {install_command('prompt')}"
        ) from error
