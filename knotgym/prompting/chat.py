"""A client for chat-completions servers that retries failed requests.

The API key is read from OPENAI_API_KEY. It is sent with requests, and replaced by [key] in
everything that a server returns, however the server encodes it. Replies are bounded: at most
MOST_BYTES each, and at most `timeout` seconds per attempt in total.
"""

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
from email.message import Message
from email.utils import parsedate_to_datetime
from http.client import HTTPException
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import knotgym
from knotgym.common.configuration import Count, NonNegative, Positive, configuration
from knotgym.common.errors import Failed, InvalidInput, one_line

KEY = "OPENAI_API_KEY"
PUBLIC = "https://api.openai.com/v1"
_LONGEST_WAIT = 600.0  # longest pause before a retry, even if a server asks for more, seconds
_RETRIED = (408, 409, 425, 429)  # HTTP statuses that are retried, as are all from 500 on
_SHOWN = 200  # characters of a server's error message that are shown
_SECRET = 8  # length from which a key is treated as a secret, characters
MOST_BYTES = 4_000_000  # size limit of a reply; compressed replies are not requested
_BLOCK = 65536  # bytes read at a time; the time limit is checked after each block


@configuration
class ChatConfig:
    """Settings of the client.

    Attributes:
        model: model name on the server.
        base_url: URL of a server with the chat-completions protocol; its key, if it needs one, is
            read from OPENAI_API_KEY.
        temperature: sampling temperature; below 0 uses the server's default.
        timeout: time limit for one request, in seconds. It covers the whole reply.
        attempts: tries per request before the run stops.
        backoff: seconds to wait before the second try; doubled before each later one.
    """

    model: str
    base_url: str = PUBLIC
    temperature: NonNegative | None = 1.0
    timeout: Positive = 120.0
    attempts: Count = 6
    backoff: NonNegative = 1.0

    def __post_init__(self) -> None:
        if not self.model.strip():
            raise InvalidInput("name the model to ask: --model NAME")
        try:
            parts = urlsplit(self.base_url)
            fits = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
            fits = fits and re.fullmatch(r"[!-~]+", self.base_url) is not None  # printable ASCII
            bare = "@" not in parts.netloc and not parts.query and not parts.fragment
        except ValueError:
            fits = bare = False
        if not (fits and bare):  # the message doesn't repeat the URL, which may contain a key
            raise InvalidInput(
                "the base URL must be http://HOST/PATH or https://HOST/PATH, without user, password"
                f" or query; set the key in the environment, as {KEY}"
            )


class Reply(NamedTuple):
    """The reply to one request.

    Attributes:
        text: the model's answer.
        refused: the model refused, also in the last attempt.
        prompt_tokens, completion_tokens: totals over all answered attempts.
        retries: reason for a retry -> how many there were.
    """

    text: str
    refused: bool
    prompt_tokens: int
    completion_tokens: int
    retries: dict[str, int]


class _Attempt(NamedTuple):
    """The outcome of one attempt.

    Attributes:
        text: the model's answer.
        reason: why the attempt failed and is worth a retry; "" if it succeeded.
        wait: seconds that the server asks to wait before a retry; 0 if it doesn't say.
        detail: error message of the server or of the connection.
        tokens: of prompt and completion.
    """

    text: str = ""
    reason: str = ""
    wait: float = 0.0
    detail: str = ""
    tokens: tuple[int, int] = (0, 0)


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Report a redirect as an error: following it would send the key to another server."""

    def redirect_request(self, *request: Any) -> None:
        return None


class Chat:
    """A client of one server; several threads may use it at once.

    Args:
        stop: once it is set, requests raise Failed.

    Raises:
        InvalidInput: the key is missing, invalid, or part of the URL or the model's name.
    """

    def __init__(self, config: ChatConfig, stop: threading.Event | None = None) -> None:
        self._config, self._stop = config, stop or threading.Event()
        key = os.environ.get(KEY, "").strip()
        if not key and config.base_url == PUBLIC:
            raise InvalidInput(
                f"{PUBLIC} requires a key: set {KEY} in the environment, or give the --base-url of"
                " a server that needs none"
            )
        if not (key.isascii() and key.isprintable()):
            raise InvalidInput(f"{KEY} must be printable ASCII")
        # a short placeholder such as "EMPTY", for servers without keys, isn't censored
        self._secret = _spellings(key) if len(key) >= _SECRET else None
        if self._secret and any(map(self._secret.search, (config.base_url, config.model))):
            raise InvalidInput(f"set the key only in {KEY}, not in --base-url or --model")
        self._headers = {
            "Content-Type": "application/json",
            "User-Agent": f"knotgym/{knotgym.__version__}",
            **({"Authorization": f"Bearer {key}"} if key else {}),
        }
        self._opener = urllib.request.build_opener(_NoRedirects)

    def ask(self, messages: list[dict[str, Any]]) -> Reply:
        """Send a request; retry with exponential backoff until it is answered.

        Args:
            messages: messages of the chat-completions protocol.

        Raises:
            InvalidInput: the server rejects the request, the model or the key.
            Failed: no attempt was answered.
            Failed: the run was stopped.
        """
        retries: Counter[str] = Counter()
        tokens = [0, 0]
        for attempt in range(1, self._config.attempts + 1):
            if self._stop.is_set():
                raise Failed("stopped")
            tried = self._try(messages)
            tokens = [sum(pair) for pair in zip(tokens, tried.tokens, strict=True)]
            last = attempt == self._config.attempts
            if not tried.reason or (last and tried.reason == "refusal"):
                return Reply(tried.text, bool(tried.reason), tokens[0], tokens[1], dict(retries))
            if last:
                raise Failed(
                    f"{self._config.base_url} didn't answer in {attempt} attempts; the last one"
                    f" failed with: {tried.reason}{tried.detail and ': '}{tried.detail};"
                    " --resume continues the run"
                )
            retries[tried.reason] += 1
            pause = tried.wait or self._config.backoff * 2 ** (attempt - 1)
            self._stop.wait(min(pause, _LONGEST_WAIT))
        raise AssertionError("at least one attempt is made")

    def _try(self, messages: list[dict[str, Any]]) -> _Attempt:
        """Make one attempt in a thread of its own, with a time limit.

        A server that sends its headers one byte at a time keeps the socket's own timeout from
        expiring.
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
        """Send the request and read the reply.

        Raises:
            InvalidInput: the server rejects the request.
        """
        config = self._config
        content: dict[str, Any] = {"model": config.model, "messages": messages}
        if config.temperature is not None:
            content["temperature"] = config.temperature
        request = urllib.request.Request(
            f"{config.base_url.rstrip('/')}/chat/completions",
            json.dumps(content).encode(),
            self._headers,
        )
        until = time.monotonic() + config.timeout
        try:
            try:
                with self._opener.open(request, timeout=config.timeout) as response:
                    return self._read(_bounded(response, until))
            except urllib.error.HTTPError as error:
                with error:
                    return self._failed(error.code, error.headers, _bounded(error, until))
        except _TooLong:
            return _Attempt(reason="too long", detail=f"a reply of more than {MOST_BYTES} bytes")
        except TimeoutError:
            return _Attempt(reason="timeout")
        except (OSError, HTTPException) as error:
            cause = getattr(error, "reason", error)
            if isinstance(cause, TimeoutError):
                return _Attempt(reason="timeout")
            return _Attempt(reason="connection", detail=self._short(one_line(error)))

    def _failed(self, status: int, headers: Message, body: str) -> _Attempt:
        """Turn an HTTP error into an attempt to be retried, or raise it."""
        detail = self._short(_error_message(body))
        if status in _RETRIED or status >= 500:
            wait = retry_after(headers.get("retry-after"))
            return _Attempt(reason=str(status), wait=wait, detail=detail)
        raise InvalidInput(
            f"{self._config.base_url} rejects the request to model {self._config.model!r}:"
            f" {status} {detail}"
        )

    def _read(self, body: str) -> _Attempt:
        """Parse the JSON body of a reply."""
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
            reason = self._clean(refusal) if isinstance(refusal, str) else words
            return _Attempt(reason, "refusal", tokens=tokens)
        return _Attempt(words, tokens=tokens)

    def _clean(self, text: str) -> str:
        """Censor the key, and replace lone surrogates, which can't be encoded as UTF-8."""
        whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
        return self._secret.sub("[key]", whole) if self._secret else whole

    def _short(self, text: str) -> str:
        return " ".join(self._clean(text).split())[:_SHOWN]


class _TooLong(Exception):
    """A reply is longer than MOST_BYTES."""


def _bounded(response: Any, until: float) -> str:
    """Read the body of a response, up to MOST_BYTES and until the monotonic time `until`.

    Raises:
        _TooLong: the body is longer.
        TimeoutError: it takes longer.
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
    r"""Compile a pattern that matches a key however a server may encode it.

    That is as it stands, escaped for JSON, URLs or HTML (also repeatedly), or in base64.

    >>> [_spellings("a/b+c").sub("[key]", text) for text in (r"a\/b\u002bc", "a%2Fb%2bc")]
    ['[key]', '[key]']
    """
    # repetitions are bounded, so that searching takes time linear in the length of the text
    letters = [
        rf"(?:\\{{0,9}}{re.escape(letter)}|\\{{1,9}}(?:u00|x){ord(letter):02x}"
        rf"|%(?:25){{0,3}}{ord(letter):02x}|{re.escape(html.escape(letter))}"
        rf"|&(?:amp;){{0,3}}#(?:0{{0,5}}{ord(letter)}|x0{{0,5}}{ord(letter):x});)"
        for letter in key
    ]
    # Base64 encodes 3 bytes as 4 characters, so the key may have three alignments. Only characters
    # that don't depend on the bytes around the key are matched; both alphabets are.
    data, encoded = key.encode(), []
    for shift in range(3):
        lead = (0, 2, 3)[shift]
        whole = base64.b64encode(b" " * shift + data).decode()
        end = len(whole.rstrip("=")) - (1 if (shift + len(data)) % 3 else 0)
        encoded += [whole[lead:end], whole[lead:end].translate(str.maketrans("+/", "-_"))]
    return re.compile("|".join([f"(?i:{''.join(letters)})", *map(re.escape, encoded)]))


def retry_after(header: str | None) -> float:
    """Parse a Retry-After header, in seconds or as a date; return seconds, 0 without a valid one.

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


def _error_message(body: str) -> str:
    """Extract the message of an OpenAI-style error; else return the whole body."""
    try:
        return str(json.loads(body)["error"]["message"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return body


def _count(value: Any) -> int:
    """Return a number of tokens, 0 if the server sent none or nonsense."""
    fits = isinstance(value, int) and not isinstance(value, bool) and 0 < value < 2**53
    return value if fits else 0
