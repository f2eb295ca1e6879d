"""Transcripts: the requests and answers of an episode or a picture, one JSON object per line.

Each line is self-contained: it has the format, the settings, the answers and the outcome; pictures
are given by the SHA-256 of their PNG. docs/prompting.md lists the fields.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from knotgym.common.configuration import MOST_JSON
from knotgym.common.errors import InvalidFile, MissingFile, one_line

FORMAT = "knotgym-transcript"
FORMAT_VERSION = 1
PRICES = ("prompt_price", "completion_price")  # fields of the settings, per million tokens
FILE = "transcripts.jsonl"  # name of the file in a run's folder
_PLAYED: dict[str, type] = {
    "number": int,
    "config": dict,
    "start": int,
    "goal": int,
    "gauss_code": list,
    "actions": list,
    "success": bool,
    "turns": list,
    "retries": dict,
    "prompt_tokens": int,
    "completion_tokens": int,
}
_READ: dict[str, type] = {
    "number": int,
    "config": dict,
    "gauss_code": str,
    "nx": int,
    "grade": str,
    "accepted": bool,
    "fault": str,
    "retries": dict,
    "prompt_tokens": int,
    "completion_tokens": int,
}


def line(transcript: Mapping[str, Any]) -> str:
    """Serialize a transcript as a line, with its format and a line break."""
    whole = {"format": FORMAT, "format_version": FORMAT_VERSION, **transcript}
    return json.dumps(whole, ensure_ascii=True, allow_nan=False) + "\n"


def transcripts_at(named: str | Path) -> Path | None:
    """Return the transcript file at a path, or in a run's folder; None if there is none."""
    given = Path(named)
    inside = given / FILE if given.is_dir() else given
    return inside if inside.is_file() and inside.suffix == ".jsonl" else None


def read_transcripts(path: Path) -> list[dict[str, Any]]:
    """Read the transcripts of a file.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: a line is not a valid transcript.
    """
    if not path.is_file():
        raise MissingFile(f"no transcripts at {path}")
    if path.stat().st_size > MOST_JSON:
        raise InvalidFile(f"{path} is larger than {MOST_JSON} bytes; split it")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InvalidFile(f"{path} isn't UTF-8 text: {one_line(error)}") from error
    lines = text.removesuffix("\n").split("\n")
    return [_checked(one, f"{path}, line {number}") for number, one in enumerate(lines, 1)]


def _checked(text: str, where: str) -> dict[str, Any]:
    """Parse a line and check every field that is read later."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidFile(f"{where} isn't JSON: {one_line(error)}") from error
    if not isinstance(found, dict):
        raise InvalidFile(f"{where} isn't a transcript but {str(found)[:40]}")
    name, version = found.get("format"), found.get("format_version")
    if (name, version) != (FORMAT, FORMAT_VERSION):
        raise InvalidFile(
            f"{where} has format {name!r} version {version!r}; this version reads {FORMAT!r}"
            f" version {FORMAT_VERSION}"
        )
    for field, kind in (_PLAYED if "actions" in found else _READ).items():
        if type(found.get(field)) is not kind:
            raise InvalidFile(f"{where}: {field} must be {kind.__name__}")
    turns = found.get("turns", [])
    valid = (
        all(isinstance(one, dict) and isinstance(one.get("fault"), str) for one in turns)
        and all(map(_is_action, found.get("actions", [])))
        and all(isinstance(code, str) for code in found["gauss_code"])
        and all(_is_count(count) for count in found["retries"].values())
        and all(_is_price(found["config"].get(name)) for name in PRICES)
        and _is_config(found["config"])
    )
    if not valid:
        raise InvalidFile(
            f"{where}: config, turns, actions (six numbers in [-1, 1]), codes or counts are invalid"
        )
    return found


def _is_action(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 6
        and all(
            isinstance(number, (int, float)) and not isinstance(number, bool) and abs(number) <= 1
            for number in value
        )
    )


def _is_config(config: Mapping[str, Any]) -> bool:
    """Return whether settings name the model and the mode, and for episodes the task."""
    chat, task = config.get("chat"), config.get("task")
    if not isinstance(chat, dict) or not isinstance(task, dict | None):
        return False
    words = [chat.get("model"), config.get("mode")]
    if task:
        words += [task.get("task"), task.get("split")]
    return all(isinstance(word, str) and word.isprintable() for word in words) and (
        not task or type(task.get("nx")) is int
    )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and value >= 0


def _is_price(value: Any) -> bool:
    return value is None or (isinstance(value, (int, float)) and 0 <= value < math.inf)
