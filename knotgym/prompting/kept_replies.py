"""Replies kept as they come, so that no question of an interrupted run is asked twice.

A line each: which episode or picture, its how-manieth question, the digest of what was asked, the
reply, and the digest of all that, by which a changed line is known. A run gone on with plays its
episodes again and takes from here what it asked before.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import KnotgymError
from knotgym.common.hdf5_files import require_regular
from knotgym.prompting.chat import Chat, Reply

Asking = Callable[[list[dict[str, Any]]], Reply]


class InvalidReplies(KnotgymError, ValueError):
    """What a run has kept isn't replies."""


class KeptReplies:
    """The replies of a run, in a file of its staging folder; for several threads at once."""

    def __init__(self, path: Path) -> None:
        """Take up what is there; a line that a kill cut goes.

        Raises:
            InvalidReplies: it isn't what a run has kept.
        """
        self._lock, self._kept = threading.Lock(), {}
        if path.is_symlink():
            raise InvalidReplies(f"{path} is a link to another place, should be a file")
        if path.exists():
            require_regular(path, "file of replies", InvalidReplies)
        try:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            whole = text[: text.rfind("\n") + 1]
            for line in whole.splitlines():
                *said, seal = json.loads(line)
                number, turn, digest, reply = said
                if seal != _digest(said):
                    raise InvalidReplies(f"{path} has a line that was changed")
                self._kept[number, turn] = (digest, Reply(*reply))
        except InvalidReplies:
            raise
        except (ValueError, TypeError, RecursionError) as error:
            raise InvalidReplies(f"{path} has a line that keeps no reply") from error
        if whole != text:
            with atomic_write(path) as temporary:
                temporary.write_text(whole, encoding="utf-8")
        self._file = open(path, "a", encoding="utf-8")

    def __len__(self) -> int:
        return len(self._kept)

    def asking(self, number: int, chat: Chat) -> Asking:
        """How episode or picture `number` asks its questions, one after the other."""
        turns = itertools.count()

        def ask(messages: list[dict[str, Any]]) -> Reply:
            turn = next(turns)
            digest = _digest(messages)
            with self._lock:
                kept = self._kept.get((number, turn))
            if kept is not None and kept[0] == digest:
                return kept[1]
            reply = chat.ask(messages)
            self._keep(number, turn, digest, reply)
            return reply

        return ask

    def close(self) -> None:
        """Keep nothing more."""
        with self._lock:
            self._file.close()

    def _keep(self, number: int, turn: int, digest: str, reply: Reply) -> None:
        with self._lock:
            if self._file.closed:  # the run was stopped
                return
            said = [number, turn, digest, [*reply]]
            self._file.write(json.dumps([*said, _digest(said)]) + "\n")
            self._file.flush()
            os.fsync(self._file.fileno())
            self._kept[number, turn] = (digest, reply)


def _digest(said: list[Any]) -> str:
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
