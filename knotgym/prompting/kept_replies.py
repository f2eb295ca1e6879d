"""A log of replies, so that a resumed run doesn't repeat requests that were answered.

Each line is a JSON list: the number of the episode or picture, the index of the request in it, the
digest of the request, the reply, and a digest of all these, which detects corruption. A resumed run
plays its episodes again from the start and takes known replies from here.
"""

import hashlib
import itertools
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidInput
from knotgym.common.hdf5_files import require_regular
from knotgym.prompting.chat import Chat, Reply

Asking = Callable[[list[dict[str, Any]]], Reply]


class KeptReplies:
    """The replies of a run, in a file of its staging folder; several threads may use it at once."""

    def __init__(self, path: Path) -> None:
        """Load the file if it exists, without a last line that was cut off, and open it to append.

        Raises:
            InvalidInput: the file is corrupted or not a regular file.
        """
        self._lock, self._kept = threading.Lock(), {}
        if path.is_symlink():
            raise InvalidInput(f"{path} is a symbolic link; it must be a regular file")
        if path.exists():
            require_regular(path, "file of replies", InvalidInput)
        try:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            whole = text[: text.rfind("\n") + 1]
            for line in whole.splitlines():
                *entry, seal = json.loads(line)
                number, turn, digest, reply = entry
                if seal != _digest(entry):
                    raise InvalidInput(f"{path} has a line that is corrupted")
                self._kept[number, turn] = (digest, Reply(*reply))
        except InvalidInput:
            raise
        except (ValueError, TypeError, RecursionError) as error:
            raise InvalidInput(f"{path} has a line that isn't a reply") from error
        if whole != text:
            with atomic_write(path) as temporary:
                temporary.write_text(whole, encoding="utf-8")
        self._file = open(path, "a", encoding="utf-8")

    def __len__(self) -> int:
        return len(self._kept)

    def asking(self, number: int, chat: Chat) -> Asking:
        """Return the function with which episode or picture `number` makes its requests."""
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
        """Close the file; later replies are dropped."""
        with self._lock:
            self._file.close()

    def _keep(self, number: int, turn: int, digest: str, reply: Reply) -> None:
        with self._lock:
            if self._file.closed:  # the run was stopped
                return
            entry = [number, turn, digest, [*reply]]
            self._file.write(json.dumps([*entry, _digest(entry)]) + "\n")
            self._file.flush()
            os.fsync(self._file.fileno())
            self._kept[number, turn] = (digest, reply)


def _digest(value: list[Any]) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
