"""Ask a model behind any chat-completions server, through the openai client.

The API key is read from OPENAI_API_KEY and sent to the server named by `base_url` alone. It is
replaced by [key] in everything that a server returns; a server that spells it in another way can
still write it into your transcripts. Replies are bounded: at most MOST_BYTES each, never
decompressed, and at most `timeout` seconds per attempt in total. Redirects are errors.
"""

import asyncio
import importlib
import json
import os
import re
import threading
import urllib.request
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import knotgym
from knotgym.common import (
    Count,
    Failed,
    InvalidInput,
    MissingExtra,
    NonNegative,
    Positive,
    configuration,
    install_command,
    one_line,
)

KEY = "OPENAI_API_KEY"
PUBLIC = "https://api.openai.com/v1"
MOST_BYTES = 4_000_000  # size limit of a reply
_LONGEST_WAIT = 600.0  # longest pause before a retry, even if a server asks for more, seconds
_RETRIED = (408, 409, 425, 429)  # HTTP statuses that are retried, as are all from 500 on
_SHOWN = 200  # characters of a server's error message that are shown
_SECRET = 8  # length from which a key is treated as a secret, characters
_UNSENT = ("openai-organization", "openai-project")  # the client reads them from the environment
_LOOPBACK = ("localhost", "127.0.0.1", "::1")  # never reached through a proxy


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
    temperature: float = 1.0
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
        text: the model's answer, without its thinking.
        fault: "refusal" if the model refused, also in the last attempt; else "".
        finish: why the model stopped, as the server says: "stop", "length"; "" if it doesn't say.
        prompt_tokens, completion_tokens: totals over all answered attempts; None if a server
            didn't say.
        retries: reason for a retry -> how many there were.
    """

    text: str
    fault: str
    finish: str
    prompt_tokens: int | None
    completion_tokens: int | None
    retries: dict[str, int]


class _Attempt(NamedTuple):
    """The outcome of one attempt.

    Attributes:
        text, finish: as of `Reply`.
        reason: why the attempt failed and is worth a retry; "" if it succeeded.
        wait: seconds that the server asks to wait before a retry; 0 if it doesn't say.
        detail: error message of the server or of the connection.
        tokens: of prompt and completion, None each if the server doesn't say; () if the attempt
            wasn't answered.
    """

    text: str = ""
    finish: str = ""
    reason: str = ""
    wait: float = 0.0
    detail: str = ""
    tokens: tuple[int | None, ...] = ()


class Chat:
    """A client of one server; several threads may use it at once.

    Args:
        config: settings.
        stop: once it is set, requests raise Failed.

    Raises:
        InvalidInput: the key is missing, invalid, or part of the URL or the model's name.
        MissingExtra: the openai client isn't installed.
    """

    def __init__(self, config: ChatConfig, stop: threading.Event | None = None) -> None:
        self._config, self._stop = config, stop or threading.Event()
        self._key = key = os.environ.get(KEY, "").strip()
        if not key and config.base_url == PUBLIC:
            raise InvalidInput(
                f"{PUBLIC} requires a key: set {KEY} in the environment, or give the --base-url of"
                " a server that needs none"
            )
        if not (key.isascii() and key.isprintable()):
            raise InvalidInput(f"{KEY} must be printable ASCII")
        # a short placeholder such as "EMPTY", for servers without keys, isn't censored
        self._secret = key if len(key) >= _SECRET else ""
        if self._secret and self._secret in f"{config.base_url} {config.model}":
            raise InvalidInput(f"set the key only in {KEY}, not in --base-url or --model")
        self._host = urlsplit(config.base_url).hostname
        try:
            import openai
        except ImportError as error:
            raise MissingExtra("openai", install_command("prompt"), "knotgym prompt") from error
        self._openai: Any = openai

    def ask(self, messages: list[dict[str, Any]]) -> Reply:
        """Send a request; retry with exponential backoff until it is answered.

        Args:
            messages: messages of the chat-completions protocol.

        Raises:
            InvalidInput: the server rejects the request, the model or the key.
            Failed: no attempt was answered, or the run was stopped.
        """
        retries, answered = Counter[str](), list[tuple[int | None, ...]]()
        for attempt in range(1, self._config.attempts + 1):
            if self._stop.is_set():
                raise Failed("stopped")
            tried = asyncio.run(self._try(messages))
            answered += [tried.tokens] if tried.tokens else []
            last = attempt == self._config.attempts
            if not tried.reason or (last and tried.reason == "refusal"):
                prompt, completion = (
                    None if None in counts else sum(counts)
                    for counts in zip(*answered, strict=True)
                )
                return Reply(
                    tried.text, tried.reason, tried.finish, prompt, completion, dict(retries)
                )
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

    async def _try(self, messages: list[dict[str, Any]]) -> _Attempt:
        """Make one attempt; raise InvalidInput if the server rejects the request."""
        openai, config = self._openai, self._config
        settings = {} if config.temperature < 0 else {"temperature": config.temperature}
        try:
            async with self._client() as client:
                complete = client.chat.completions.with_raw_response.create
                # a server that sends a byte at a time keeps the client's own limits from expiring
                async with asyncio.timeout(config.timeout):
                    raw = await complete(model=config.model, messages=messages, **settings)
                return self._read(raw.http_response.text)
        except openai.APIStatusError as error:
            return self._failed(error.status_code, error.response.headers, error.response.text)
        except (TimeoutError, openai.APITimeoutError):
            return _Attempt(reason="timeout")
        except openai.APIError as error:
            detail = self._short(one_line(error.__cause__ or error))
            scheme = urlsplit(config.base_url).scheme
            proxies = {scheme, "all"} & urllib.request.getproxies().keys()
            if proxies and self._host not in _LOOPBACK:
                detail += f" (through the proxy in {' or '.join(sorted(proxies))}_proxy)"
            return _Attempt(reason="connection", detail=detail)

    def _client(self) -> Any:
        """Return an openai client whose replies are bounded, never decompressed, and not followed.

        Each attempt has its own, because connections belong to an event loop.
        """
        openai = self._openai
        # the client's HTTP library, which is another one in newer versions of openai
        http: Any = importlib.import_module(
            openai.DefaultHttpxClient.__mro__[1].__module__.partition(".")[0]
        )

        class Bounded(http.AsyncByteStream):
            """A reply's bytes, up to MOST_BYTES."""

            def __init__(self, stream: Any) -> None:
                self._stream = stream

            async def __aiter__(self) -> AsyncIterator[bytes]:
                size = 0
                async for block in self._stream:
                    size += len(block)
                    if size > MOST_BYTES:
                        raise http.ReadError(f"a reply of more than {MOST_BYTES} bytes")
                    yield block

            async def aclose(self) -> None:
                await self._stream.aclose()

        async def strip(request: Any) -> None:
            for name in _UNSENT if self._key else (*_UNSENT, "authorization"):
                request.headers.pop(name, None)

        async def read(response: Any) -> None:
            response.headers.pop("content-encoding", None)
            response.stream = Bounded(response.stream)
            await response.aread()  # here, so that openai turns what goes wrong into an APIError

        return openai.AsyncOpenAI(
            api_key=self._key or "none",
            base_url=self._config.base_url,
            max_retries=0,  # `ask` retries, and counts the reasons
            timeout=self._config.timeout,
            default_headers={
                "User-Agent": f"knotgym/{knotgym.__version__}",
                "Accept-Encoding": "identity",
            },
            http_client=openai.DefaultAsyncHttpxClient(
                event_hooks={"request": [strip], "response": [read]},
                follow_redirects=False,
                trust_env=self._host not in _LOOPBACK,  # with proxies
            ),
        )

    def _failed(self, status: int, headers: Mapping[str, str], body: str) -> _Attempt:
        """Turn an HTTP error into an attempt to be retried, or raise it."""
        detail = self._short(_error_message(body))
        if status in _RETRIED or status >= 500:
            asked = re.fullmatch(r"\s*(\d{1,9}(?:\.\d+)?)\s*", headers.get("retry-after", ""))
            return _Attempt(reason=str(status), wait=float(asked[1]) if asked else 0, detail=detail)
        raise InvalidInput(
            f"{self._config.base_url} rejects the request to model {self._config.model!r}:"
            f" {status} {detail}"
        )

    def _read(self, body: str) -> _Attempt:
        """Parse the JSON body of a reply."""
        try:
            whole = json.loads(body)
            choices = [one for one in whole["choices"] if one.get("index", 0) == 0]
            choice, usage = (choices or whole["choices"])[0], whole.get("usage") or {}
            content, refusal = (choice["message"].get(name) for name in ("content", "refusal"))
            finish = self._clean(str(choice.get("finish_reason") or ""))[:_SHOWN]
            tokens = tuple(_count(usage.get(f"{of}_tokens")) for of in ("prompt", "completion"))
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            # some servers send their errors with status 200
            told = _error_message(body)
            reason = "malformed" if told == body else "error"
            return _Attempt(reason=reason, detail=self._short(told))
        words = _answer_text(content)
        if finish == "error":
            detail = self._short(_error_message(json.dumps(choice)))
            return _Attempt(reason="error", detail=detail, tokens=tokens)
        if refusal or finish == "content_filter":
            reason = refusal if isinstance(refusal, str) else words or ""
            return _Attempt(self._clean(reason), finish, "refusal", tokens=tokens)
        if words is None and not finish:
            return _Attempt(reason="malformed")
        return _Attempt(self._clean(words or ""), finish, tokens=tokens)

    def _clean(self, text: str) -> str:
        """Censor the key, and replace lone surrogates, which can't be encoded as UTF-8."""
        whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
        return whole.replace(self._secret, "[key]") if self._secret else whole

    def _short(self, text: str) -> str:
        return " ".join(self._clean(text).split())[:_SHOWN]


def _answer_text(content: Any) -> str | None:
    """Return the text of a message's content without the model's thinking; None if it has none.

    Content is text, or a list of parts, of which those of type "text" count.

    >>> _answer_text([{"type": "thinking", "text": "?"}, {"type": "text", "text": "yes"}])
    'yes'
    >>> _answer_text("<think>a draft</think>final"), _answer_text("cut off</think>final")
    ('final', 'final')
    """
    if isinstance(content, list):
        parts = [one for one in content if isinstance(one, dict)]
        texts = [one.get("text") for one in parts if one.get("type") in ("text", "output_text")]
        content = "".join(text for text in texts if isinstance(text, str))
    if not isinstance(content, str):
        return None
    # some chat templates put the opening mark into the prompt, so that a reply has the end alone
    _, closed, after = content.rpartition("</think>")
    return (after if closed else content).partition("<think>")[0]


def _error_message(body: str) -> str:
    """Extract the message of an OpenAI-style error; else return the whole body."""
    try:
        return str(json.loads(body)["error"]["message"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return body


def _count(value: Any) -> int | None:
    """Return a number of tokens, None if the server sent none or nonsense."""
    fits = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
    return value if fits else None
