"""Ask a model behind any chat-completions server, through the openai client.

The client sends, retries and waits. Its transport is ours: it bounds a reply (MOST_BYTES, never
decompressed, `timeout` seconds up to the last byte), and notes what came of each attempt. Redirects
are errors.

The API key is read from OPENAI_API_KEY and sent to the server named by `base_url` alone. It is
replaced by [key] in everything that a server returns; a server that spells it in another way can
still write it into your transcripts.
"""

import asyncio
import importlib
import json
import os
import re
import threading
import urllib.request
from collections import Counter
from importlib.resources import files
from typing import Annotated, Any, NamedTuple
from urllib.parse import urlsplit

from pydantic import BeforeValidator, Field, PositiveFloat, PositiveInt

import knotgym
from knotgym.common import Failed, InvalidInput, Mark, MissingExtra, configuration, one_line

KEY = "OPENAI_API_KEY"
PUBLIC = "https://api.openai.com/v1"
MOST_BYTES = 4_000_000  # size limit of a reply
_SHOWN = 200  # characters of a server's error message that are shown
_SECRET = 8  # length from which a key is treated as a secret, characters
# the client reads some of these from the environment
_UNSENT = ("openai-organization", "openai-project", "authorization")
_LOOPBACK = ("localhost", "127.0.0.1", "::1")  # never reached through a proxy
_OURS = ("model", "messages", "stream")  # fields of a request that aren't `extra`
# printable ASCII: scheme, host, port and path
_URL = re.compile(
    r"(?=[!-~]+$)https?://(\[[0-9a-f:.]+\]|[^][:/?#@]+)(:[1-9]\d{0,4})?(/[^?#]*)?", re.IGNORECASE
)
# HTTP statuses of a request that the server won't answer, while it may answer others: a filter of
# its content, a context that is too long, pictures that are too large
_REJECTING = (400, 413, 422, 451)
_MODERATED = re.compile("moderat|flagged|content.?(filter|polic)", re.IGNORECASE)
# as models are known to mark what they think before they answer
_DRAFTS = tuple((files("knotgym.prompting") / "drafts.txt").read_text("utf-8").split())


def _read_extra(value: Any) -> Any:
    try:
        return json.loads(value) if isinstance(value, str) else value
    except (ValueError, RecursionError):
        raise InvalidInput('must be a JSON object such as {"max_tokens": 4000}') from None


@configuration
class ChatConfig:
    """Settings of the client.

    Attributes:
        model: model name on the server.
        base_url: URL of a server with the chat-completions protocol; its key, if it needs one, is
            read from OPENAI_API_KEY.
        temperature: sampling temperature; below 0 uses the server's default.
        extra: further fields of each request, a JSON object such as {"max_tokens": 4000}; sent and
            recorded as given.
        drafts: marks between which a model thinks, such as <think>...</think>; what stands there is
            kept as reasoning and isn't part of the answer.
        timeout: time limit for one request, in seconds. It covers the whole reply.
        attempts: tries per request before the run stops.
    """

    model: str
    base_url: Annotated[str, Mark("typed")] = PUBLIC
    temperature: float = 1.0
    extra: Annotated[dict[str, Any], BeforeValidator(_read_extra)] = Field(default_factory=dict)
    drafts: tuple[str, ...] = _DRAFTS
    timeout: PositiveFloat = 120.0
    attempts: PositiveInt = 6

    def __post_init__(self) -> None:
        if not self.model.strip():
            raise InvalidInput("name the model to ask: --model NAME")
        if not _URL.fullmatch(self.base_url):  # the message doesn't repeat it: it may hold a key
            raise InvalidInput(
                "the base URL must be http://HOST/PATH or https://HOST/PATH, without user, password"
                f" or query; set the key in the environment, as {KEY}"
            )
        try:
            json.dumps(self.extra, allow_nan=False)
        except ValueError:
            raise InvalidInput("chat.extra must be JSON, without NaN and infinity") from None
        if taken := self.extra.keys() & _OURS:
            raise InvalidInput(f"chat.extra can't set {', '.join(sorted(taken))}")
        for marks in self.drafts:
            if not all(marks.partition("...")):
                raise InvalidInput(f"marks of drafts are such as <think>...</think>, got {marks!r}")


class _Attempt(NamedTuple):
    """The outcome of one attempt.

    Attributes:
        fault: why it failed; "" if it succeeded.
        detail: error message of the server or of the connection.
        text, reasoning, finish: as of `Chat.ask`.
        tokens: of prompt and completion, None each if the server doesn't say; () if the attempt
            wasn't answered.
    """

    fault: str = ""
    detail: str = ""
    text: str = ""
    reasoning: str = ""
    finish: str = ""
    tokens: tuple[int | None, ...] = ()


class Chat:
    """A client of one server; several threads may use it at once.

    Args:
        config: settings.
        stop: once it is set, requests raise Failed.

    Raises:
        InvalidInput: the key is missing, invalid, or part of the URL, the model's name or `extra`.
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
        shown = f"{config.base_url} {config.model} {json.dumps(config.extra)}"
        if self._secret and self._secret in shown:
            raise InvalidInput(f"set the key only in {KEY}, not in --base-url, --model or extra")
        self._openai = openai = MissingExtra.imported("openai", "prompt", "knotgym prompt")
        # the client's HTTP library, which is another one in newer versions of openai
        library = openai.DefaultAsyncHttpxClient.__mro__[1].__module__.partition(".")[0]
        self._http: Any = importlib.import_module(library)
        parts = urlsplit(config.base_url)
        bypassed = parts.hostname in _LOOPBACK or urllib.request.proxy_bypass(parts.hostname or "")
        proxies = {} if bypassed else urllib.request.getproxies()
        self._proxy = next((kind for kind in (parts.scheme, "all") if kind in proxies), "")
        self._proxy_url = proxies.get(self._proxy)

    def ask(self, messages: list[dict[str, Any]]) -> dict[str, Any]:
        """Send messages of the protocol; the client repeats a request until it is answered.

        Returns:
            text: the model's answer, without its reasoning.
            reasoning: what it thought before, as far as the server shows it.
            fault: "refusal" if the model refused, also in the last attempt, or the server rejected
                the request; "empty" if the answer was empty, also in the last attempt; else "".
            rejected: why the server rejected the request, such as "400 content_filter: Filtered";
                "" if it didn't.
            finish: why the model stopped, as the server says: "stop", "length"; or "".
            prompt_tokens, completion_tokens: totals over all answered attempts; None if a server
                didn't say.
            retries: reason for a retry -> how many there were.

        Raises:
            InvalidInput: the server rejects the model or the key.
            Failed: no attempt was answered, or the run was stopped.
        """
        if self._stop.is_set():
            raise Failed("stopped")
        url, tried = self._config.base_url, asyncio.run(self._send(messages))
        fault, detail, text, reasoning, finish, _ = tried[-1]
        if fault == "fatal":
            model = self._config.model
            raise InvalidInput(f"{url} rejects the request to model {model!r}: {detail}")
        if fault not in ("", "refusal", "empty", "rejected"):
            raise Failed(
                f"{url} didn't answer in {len(tried)} attempts; the last one failed with:"
                f" {fault}{detail and ': '}{detail}; --resume continues the run"
            )
        counts = [[attempt.tokens[k] for attempt in tried if attempt.tokens] for k in (0, 1)]
        prompt, completion = (None if None in each else sum(filter(None, each)) for each in counts)
        return {
            "text": text,
            "reasoning": reasoning,
            "fault": "refusal" if fault == "rejected" else fault,
            "rejected": detail,
            "finish": finish,
            "prompt_tokens": prompt,
            "completion_tokens": completion,
            "retries": dict(Counter(attempt.fault for attempt in tried[:-1])),
        }

    async def _send(self, messages: list[dict[str, Any]]) -> list[_Attempt]:
        """Return what came of each attempt.

        Each request has a client of its own, because connections belong to an event loop.
        """
        openai, config, tried = self._openai, self._config, list[_Attempt]()
        settings = {} if config.temperature < 0 else {"temperature": config.temperature}
        try:
            async with openai.AsyncOpenAI(
                api_key=self._key or "none",
                base_url=config.base_url,
                max_retries=config.attempts - 1,
                timeout=config.timeout,
                http_client=openai.DefaultAsyncHttpxClient(
                    transport=self._transport(tried), follow_redirects=False
                ),
            ) as client:
                await client.chat.completions.with_raw_response.create(
                    model=config.model, messages=messages, extra_body=config.extra, **settings
                )
        except (openai.OpenAIError, ImportError, ValueError) as error:
            if not tried:  # it wasn't sent, for example because of a proxy's address
                raise InvalidInput(self._short(one_line(error))) from error
        return tried

    def _transport(self, tried: list[_Attempt]) -> Any:
        """Return a transport that appends what comes of each attempt to `tried`."""
        http: Any = self._http
        chat, unsent = self, _UNSENT[: 2 if self._key else 3]

        class Bounded(http.AsyncHTTPTransport):
            """Bound what is received; let the client see an answer of no use as an error."""

            async def handle_async_request(self, request: Any) -> Any:
                for name in unsent:
                    request.headers.pop(name, None)
                request.headers["user-agent"] = f"knotgym/{knotgym.__version__}"
                request.headers["accept-encoding"] = "identity"
                try:
                    # a server that sends a byte at a time keeps the limits of single reads from
                    # expiring
                    async with asyncio.timeout(chat._config.timeout):
                        reply, body = await super().handle_async_request(request), b""
                        async for block in reply.aiter_raw():
                            body += block
                            if len(body) > MOST_BYTES:
                                raise http.ReadError(f"a reply of more than {MOST_BYTES} bytes")
                except (TimeoutError, http.TimeoutException) as error:
                    tried.append(_Attempt("timeout"))
                    raise http.ReadTimeout("timeout") from error
                except http.TransportError as error:
                    through = f" (through the proxy in {chat._proxy}_proxy)" if chat._proxy else ""
                    detail = chat._short(one_line(error.__cause__ or error)) + through
                    tried.append(_Attempt("connection", detail))
                    raise
                attempt = chat._outcome(reply.status_code, body.decode(errors="replace"))
                tried.append(attempt)
                reply.headers.pop("content-encoding", None)
                status = 503 if attempt.fault and reply.is_success else reply.status_code
                return http.Response(status, headers=reply.headers, content=body)

        return Bounded(proxy=self._proxy_url)

    def _outcome(self, status: int, body: str) -> _Attempt:
        """Return what came of an attempt that ended with an HTTP status."""
        if 200 <= status < 300:
            return self._read(body)
        detail = self._short(_error(body, "message") or body)
        if status in (408, 409, 429) or status >= 500:  # the client retries these
            return _Attempt(str(status), detail)
        if status in _REJECTING or (status == 403 and _MODERATED.search(body)):
            code = self._short(_error(body, "code") or _error(body, "type"))
            return _Attempt("rejected", f"{status} {code}".strip() + f": {detail}")
        return _Attempt("fatal", f"{status} {detail}")

    def _read(self, body: str) -> _Attempt:
        """Parse the JSON body of a reply."""
        try:
            whole = json.loads(body)
            choices = [choice for choice in whole["choices"] if choice.get("index", 0) == 0]
            choice, usage = (choices or whole["choices"])[0], whole.get("usage") or {}
            message = choice["message"]
            content, refusal = message.get("content"), message.get("refusal")
            finish = self._short(str(choice.get("finish_reason") or ""))
            tokens = tuple(_count(usage.get(f"{of}_tokens")) for of in ("prompt", "completion"))
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            # some servers send their errors with status 200
            message = _error(body, "message")
            return _Attempt("error" if message else "malformed", self._short(message or body))
        if finish == "error":
            detail = _error(json.dumps(choice), "message") or json.dumps(choice)
            return _Attempt("error", self._short(detail), tokens=tokens)
        text, drafts = _divided(content, self._config.drafts)
        thoughts = (message.get("reasoning_content"), message.get("reasoning"), drafts)
        reasoning = next((text for text in thoughts if isinstance(text, str) and text), "")
        if content is None and not (finish or reasoning or refusal):
            return _Attempt("malformed")
        fault = "" if text.strip() else "empty"
        if refusal or finish == "content_filter":
            fault, text = "refusal", refusal if isinstance(refusal, str) else text
        return _Attempt(fault, "", self._clean(text), self._clean(reasoning), finish, tokens)

    def _clean(self, text: str) -> str:
        """Censor the key, and replace lone surrogates, which can't be encoded as UTF-8."""
        whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
        return whole.replace(self._secret, "[key]") if self._secret else whole

    def _short(self, text: str) -> str:
        return one_line(" ".join(self._clean(text).split())[:_SHOWN])


def _divided(content: Any, marks: tuple[str, ...]) -> tuple[str, str]:
    """Return a message's answer and its drafts.

    Content is text, or a list of parts, of which those of type "text" are the answer.

    >>> _divided([{"type": "thinking", "text": "?"}, {"type": "text", "text": "yes"}], ())
    ('yes', '?')
    >>> _divided("<think>a draft</think>final", _DRAFTS), _divided("cut</think>final", _DRAFTS)
    (('final', 'a draft'), ('final', 'cut'))
    """
    drafts = list[str]()
    if isinstance(content, list):
        parts = [part for part in content if isinstance(part, dict)]
        said = [part for part in parts if part.get("type") in ("text", "output_text")]
        drafts += [_text(part) for part in parts if part not in said]
        content = "".join(_text(part) for part in said)
    text = content if isinstance(content, str) else ""
    for opening, _, closing in (mark.partition("...") for mark in marks):
        # up to the end where a draft was cut off
        pair = f"{re.escape(opening)}(.*?)(?:{re.escape(closing)}|$)"
        drafts += re.findall(pair, text, re.DOTALL)
        text = re.sub(pair, "", text, flags=re.DOTALL)
        # some chat templates put the opening mark into the prompt, so that a reply has the end
        # alone
        draft, closed, after = text.rpartition(closing)
        drafts, text = [*drafts, draft], after if closed else text
    return text, "\n".join(draft for draft in drafts if draft)


def _text(part: dict[str, Any]) -> str:
    text = part.get("text", part.get("thinking"))
    return text if isinstance(text, str) else ""


def _error(body: str, field: str) -> str:
    """Return a field of an OpenAI-style error; "" if the body isn't one."""
    try:
        return str(json.loads(body)["error"][field] or "")
    except (ValueError, LookupError, TypeError, RecursionError):
        return ""


def _count(value: Any) -> int | None:
    """Return a number of tokens, None if the server sent none or nonsense."""
    fits = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
    return value if fits else None
