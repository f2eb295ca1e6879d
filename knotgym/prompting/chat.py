"""Ask a chat-completions server a question until it is answered.

The API key is read from OPENAI_API_KEY. It is sent with requests and is replaced by [key] in
everything that a server returns, however the server encodes it. An exchange is bounded: a reply of
more than MOST_BYTES is refused, and each attempt ends after `timeout` seconds in all.
"""

from __future__ import annotations

import base64
import html
import json
import math
import os
import re
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from concurrent.futures import Future
from dataclasses import dataclass
from email.message import Message
from email.utils import parsedate_to_datetime
from http.client import HTTPException
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import knotgym
from knotgym.configuration import check_numbers
from knotgym.errors import KnotgymError, one_line
from knotgym.runs.run_options import NotEnough

KEY = "OPENAI_API_KEY"
PUBLIC = "https://api.openai.com/v1"
_LONGEST_WAIT = 600.0  # seconds, whatever a server asks for
_RETRIED = (408, 409, 425, 429)  # and all from 500 on
_TOLD = 200  # characters of what a server says
_SECRET = 8  # characters of a key, at least
MOST_BYTES = 4_000_000  # of a reply, as sent; compressed replies are not asked for
_BLOCK = 65536  # bytes read at a time; the time limit is checked after each block


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
        timeout: seconds that an attempt may take in all, until the last byte of the answer.
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
            fits = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
            fits = fits and re.fullmatch(r"[!-~]+", self.base_url) is not None  # printable ASCII
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


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Report a redirect as an error: following it would send the key to another server."""

    def redirect_request(self, *request: Any) -> None:
        return None


class Chat:
    """A server, to be asked by several threads at once.

    Args:
        config: whom and how.
        stop: when it is set, questions end with Stopped.

    Raises:
        InvalidChat: there is no key for the public server, or the key is in the wrong place.
    """

    def __init__(self, config: ChatConfig, stop: threading.Event | None = None) -> None:
        self._config, self._stop = config, stop or threading.Event()
        key = os.environ.get(KEY, "").strip()
        if not key and config.base_url == PUBLIC:
            raise InvalidChat(
                f"{PUBLIC} wants a key: set {KEY} in the environment, or give --base-url of a"
                " server that needs none"
            )
        if not (key.isascii() and key.isprintable()):
            raise InvalidChat(f"{KEY} holds letters that no key has")
        # "EMPTY" and the like, for servers that want no key, are words as others are
        self._secret = _spellings(key) if len(key) >= _SECRET else None
        if self._secret and any(map(self._secret.search, (config.base_url, config.model))):
            raise InvalidChat(f"the key belongs into {KEY} alone, not into --base-url or --model")
        self._headers = {
            "Content-Type": "application/json",
            "User-Agent": f"knotgym/{knotgym.__version__}",
            **({"Authorization": f"Bearer {key}"} if key else {}),
        }
        self._opener = urllib.request.build_opener(_NoRedirects)

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
        """Make one attempt, in a thread of its own: a server that sends its headers one byte at a
        time can keep a connection from ever timing out, but not this function.
        """
        outcome: Future[_Attempt] = Future()

        def exchange() -> None:
            try:
                outcome.set_result(self._exchange(messages))
            except BaseException as error:
                outcome.set_exception(error)

        threading.Thread(target=exchange, daemon=True).start()
        try:
            return outcome.result(self._config.timeout)
        except TimeoutError:
            return _Attempt(reason="timeout")

    def _exchange(self, messages: list[dict[str, Any]]) -> _Attempt:
        """Send the question and read the answer.

        Raises:
            InvalidChat: the server says that the question is wrong.
        """
        config = self._config
        question: dict[str, Any] = {"model": config.model, "messages": messages}
        if config.temperature is not None:
            question["temperature"] = config.temperature
        request = urllib.request.Request(
            f"{config.base_url.rstrip('/')}/chat/completions",
            json.dumps(question).encode(),
            self._headers,
        )
        until = time.monotonic() + config.timeout
        try:
            try:
                with self._opener.open(request, timeout=config.timeout) as response:
                    return self._read(_bounded(response, until))
            except urllib.error.HTTPError as error:
                with error:
                    return self._refused(error.code, error.headers, _bounded(error, until))
        except _TooLong:
            return _Attempt(reason="too long", said=f"a reply of more than {MOST_BYTES} bytes")
        except TimeoutError:
            return _Attempt(reason="timeout")
        except (OSError, HTTPException) as error:
            cause = getattr(error, "reason", error)
            if isinstance(cause, TimeoutError):
                return _Attempt(reason="timeout")
            return _Attempt(reason="connection", said=self._short(one_line(error)))

    def _refused(self, status: int, headers: Message, body: str) -> _Attempt:
        said = self._short(_complaint(body))
        if status in _RETRIED or status >= 500:
            wait = retry_after(headers.get("retry-after"))
            return _Attempt(reason=str(status), wait=wait, said=said)
        raise InvalidChat(
            f"{self._config.base_url} refuses the question to model {self._config.model!r}:"
            f" {status} {said}"
        )

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
        words = self._clean(text if isinstance(text, str) else "")
        if refusal or choice.get("finish_reason") == "content_filter":
            told = self._clean(refusal) if isinstance(refusal, str) else words
            return _Attempt(told, "refusal", tokens=tokens)
        return _Attempt(words, tokens=tokens)

    def _clean(self, text: str) -> str:
        """Replace the key, and half surrogate pairs, which no file or request can hold."""
        whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
        return self._secret.sub("[key]", whole) if self._secret else whole

    def _short(self, text: str) -> str:
        return " ".join(self._clean(text).split())[:_TOLD]


class _TooLong(Exception):
    """A reply has more than MOST_BYTES."""


def _bounded(response: Any, until: float) -> str:
    """Read the body of a response, at most MOST_BYTES of it and no longer than `until`.

    Raises:
        _TooLong: it has more bytes.
        TimeoutError: it takes more time.
    """
    body = bytearray()
    while block := response.read1(_BLOCK):
        body += block
        if len(body) > MOST_BYTES:
            raise _TooLong
        if time.monotonic() > until:
            raise TimeoutError
    return body.decode("utf-8", "replace")


def _spellings(key: str) -> re.Pattern[str]:
    r"""Match a key as it is and as servers may encode it: escaped for JSON, URLs or HTML, also more
    than once, or in base64.

    >>> [_spellings("a/b+c").sub("[key]", text) for text in (r"a\/b\u002bc", "a%2Fb%2bc")]
    ['[key]', '[key]']
    """
    # repeats are bounded, so that the time to search a text is linear in its length
    letters = [
        rf"(?:\\{{0,9}}{re.escape(letter)}|\\{{1,9}}(?:u00|x){ord(letter):02x}"
        rf"|%(?:25){{0,3}}{ord(letter):02x}|{re.escape(html.escape(letter))}"
        rf"|&(?:amp;){{0,3}}#(?:0{{0,5}}{ord(letter)}|x0{{0,5}}{ord(letter):x});)"
        for letter in key
    ]
    # base64 has three alignments; the characters that depend on what surrounds the key are left out
    data, encoded = key.encode(), []
    for shift in range(3):
        lead = (0, 2, 3)[shift]
        whole = base64.b64encode(b" " * shift + data).decode()
        end = len(whole.rstrip("=")) - (1 if (shift + len(data)) % 3 else 0)
        encoded += [whole[lead:end], whole[lead:end].translate(str.maketrans("+/", "-_"))]
    return re.compile("|".join([f"(?i:{''.join(letters)})", *map(re.escape, encoded)]))


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
    """What a server says is wrong: as OpenAI's says it, or as it comes."""
    try:
        return str(json.loads(body)["error"]["message"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return body


def _count(value: Any) -> int:
    fits = isinstance(value, int) and not isinstance(value, bool) and 0 < value < 2**53
    return value if fits else 0
