"""The log of replies is reused as it was written, or refused."""

import os
from pathlib import Path

import pytest

from knotgym.common.errors import InvalidInput
from knotgym.prompting.chat import Reply
from knotgym.prompting.kept_replies import KeptReplies


@pytest.fixture
def path(tmp_path: Path) -> Path:
    kept = KeptReplies(tmp_path / "replies.jsonl")
    for number in range(2):
        kept._keep(number, 0, "ab", Reply(f"pull {number}", False, 10, 2, {"timeout": 1}))
    kept.close()
    return tmp_path / "replies.jsonl"


def test_replies_come_back(path: Path) -> None:
    kept = KeptReplies(path)
    kept.close()
    assert len(kept) == 2


def test_a_truncated_last_line_is_dropped(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])
    kept = KeptReplies(path)
    kept.close()
    assert len(kept) == 1 and path.read_text().count("\n") == 1


@pytest.mark.parametrize("old, new", [(b"pull 1", b"pull 2"), (b"pull", b"\xff\xfe"), (b"[", b"{")])
def test_a_changed_line_is_refused_in_one(old: bytes, new: bytes, path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(InvalidInput, match="has a line that"):
        KeptReplies(path)


def test_a_pipe_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "replies.jsonl")
    with pytest.raises(InvalidInput, match="isn't a regular file"):
        KeptReplies(tmp_path / "replies.jsonl")
