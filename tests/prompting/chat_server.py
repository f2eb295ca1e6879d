"""A scripted chat-completions server on 127.0.0.1."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Pieces = Callable[[], Iterable[bytes]]
Response = tuple[int, dict[str, str], str]
Answer = str | Response | Pieces


def completion(message: dict[str, Any], finish_reason: str = "stop", **more: Any) -> Response:
    """Return the answer of a server whose model says a message."""
    choice = {"index": 0, "message": message, "finish_reason": finish_reason}
    usage = {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110}
    return 200, {}, json.dumps({"choices": [choice], "usage": usage, **more})


class ChatServer:
    """Record all requests; `answer` maps a request's number and body to the response.

    That is what the model says; or status, headers and body; or a function of the bytes to send.
    All but the last ask the client to retry after a millisecond.
    """

    def __init__(self, answer: Callable[[int, Any], Answer]) -> None:
        self.requests: list[dict[str, Any]] = []
        self.keys: list[str] = []
        self.hung_up = threading.Event()  # a client closed its connection before the end
        self._answer, self._lock = answer, threading.Lock()
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["content-length"])))
                with server._lock:
                    number = len(server.requests)
                    server.requests.append({"path": self.path, **body})
                    server.keys.append(self.headers.get("authorization", ""))
                server._respond(self, server._answer(number, body))

            def log_message(self, format: str, *arguments: Any) -> None:
                pass

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}/v1"

    @contextmanager
    def serving(self) -> Iterator[ChatServer]:
        """Serve until the block ends."""
        thread = threading.Thread(target=self._http.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._http.shutdown()
            self._http.server_close()
            thread.join()

    def _respond(self, handler: BaseHTTPRequestHandler, answer: Answer) -> None:
        if isinstance(answer, str):
            answer = completion({"role": "assistant", "content": answer})
        if not isinstance(answer, tuple):
            handler.close_connection = True
            try:
                for piece in answer():
                    handler.connection.sendall(piece)
            except OSError:  # the client hung up
                self.hung_up.set()
            return
        status, headers, body = answer
        data = body.encode()
        try:
            handler.send_response(status)
            usual = {"content-type": "application/json", "retry-after-ms": "1"}
            for name, value in {**usual, **headers}.items():
                handler.send_header(name, value)
            handler.send_header("content-length", str(len(data)))
            handler.end_headers()
            handler.wfile.write(data)
        except OSError:
            handler.close_connection = True  # the client hung up


def always(answer: Answer) -> Callable[[int, Any], Answer]:
    return lambda number, body: answer


def kinds(message: Any) -> str:
    """Summarize a message: t per text and p per picture, or a for an assistant's."""
    if isinstance(message["content"], str):
        return "a"
    return "".join("t" if part["type"] == "text" else "p" for part in message["content"])


def hashes(message: Any) -> list[str]:
    """Return the SHA-256 of each picture of a message."""
    urls = [one["image_url"]["url"] for one in message["content"] if one["type"] == "image_url"]
    return [hashlib.sha256(base64.b64decode(url.partition(",")[2])).hexdigest() for url in urls]
