"""A scripted chat-completions server on 127.0.0.1."""

from __future__ import annotations

import base64
import hashlib
import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Misdeed = tuple[str, Any]  # kind of misbehaviour, and its detail
Answer = str | Misdeed


class ChatServer:
    """Record all requests; `answer` maps a request's number and body to the response.

    Misdeeds: ("status", (503, {header: value}, body)), ("cut", None), ("slow", seconds),
    ("body", "{not json"), ("refusal", "I can't"), ("raw", function that yields bytes to send). All
    but those of kind raw ask the client to retry after a millisecond.
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
        kind: str
        detail: Any
        kind, detail = ("answer", answer) if isinstance(answer, str) else answer
        if kind == "slow":
            threading.Event().wait(detail)
            kind, detail = "answer", ""
        if kind == "raw":
            handler.close_connection = True
            try:
                for piece in detail():
                    handler.connection.sendall(piece)
            except OSError:  # the client hung up
                self.hung_up.set()
            return
        if kind == "cut":
            linger = struct.pack("ii", 1, 0)  # reset the connection in the middle of the body
            handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            handler.connection.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: 999\r\n\r\n{")
            handler.connection.close()
            handler.close_connection = True
            return
        status, headers, body = detail if kind == "status" else (200, {}, "")
        if kind == "body":
            body = detail
        elif kind in ("answer", "refusal"):
            message: dict[str, Any] = {"role": "assistant", "content": detail}
            if kind == "refusal":
                message = {"role": "assistant", "content": None, "refusal": detail}
            body = json.dumps(
                {
                    "id": "1",
                    "object": "chat.completion",
                    "choices": [{"index": 0, "message": message, "finish_reason": "stop"}],
                    "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110},
                }
            )
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


def kinds(message: Any) -> str:
    """Summarize a message: t per text and p per picture, or a for an assistant's."""
    if isinstance(message["content"], str):
        return "a"
    return "".join("t" if part["type"] == "text" else "p" for part in message["content"])


def hashes(message: Any) -> list[str]:
    """Return the SHA-256 of each picture of a message."""
    urls = [one["image_url"]["url"] for one in message["content"] if one["type"] == "image_url"]
    return [hashlib.sha256(base64.b64decode(url.partition(",")[2])).hexdigest() for url in urls]
