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
PRICES = ("prompt", "completion")  # what tokens are counted and priced for
FILE = "transcripts.jsonl"  # name of the file in a run's folder
_Count, _Text = (int,), (str,)
_TOKENS = {f"{name}_tokens": (int, type(None)) for name in PRICES}
_REQUEST: dict[str, tuple[type, ...]] = {
    **{"fault": _Text, "finish": _Text, "retries": (dict,)},
    **_TOKENS,
}
_PLAYED: dict[str, tuple[type, ...]] = {
    **{"number": _Count, "config": (dict,), "seed": _Count, "start": _Count, "goal": _Count},
    **{"gauss_code": (list,), "actions": (list,), "success": (bool,), "turns": (list,)},
    **_TOKENS,
}
_READ: dict[str, tuple[type, ...]] = {
    **{"number": _Count, "config": (dict,), "gauss_code": _Text, "nx": _Count, "grade": _Text},
    **{"accepted": (bool,)},
    **_REQUEST,
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
    _require(found, _PLAYED if "actions" in found else _READ, where)
    for turn in found.get("turns", []):
        _require(turn, _REQUEST, f"{where}, turns")
    retries = [one["retries"] for one in found.get("turns", [found])]
    valid = (
        all(map(_is_action, found.get("actions", [])))
        and all(isinstance(code, str) for code in found["gauss_code"])
        and all(isinstance(n, int) and n >= 0 for one in retries for n in one.values())
        and all(_is_price(found["config"].get(f"{name}_price")) for name in PRICES)
        and _is_config(found["config"])
    )
    if not valid:
        raise InvalidFile(
            f"{where}: config, actions (six numbers in [-1, 1]), codes or counts are invalid"
        )
    return found


def _require(found: Any, fields: Mapping[str, tuple[type, ...]], where: str) -> None:
    if not isinstance(found, dict):
        raise InvalidFile(f"{where} aren't objects")
    for field, kinds in fields.items():
        if type(found.get(field)) not in kinds:
            raise InvalidFile(f"{where}: {field} must be {kinds[0].__name__}")


def _is_action(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 6
        and all(type(number) in (int, float) and abs(number) <= 1 for number in value)
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


def _is_price(value: Any) -> bool:
    return value is None or (type(value) in (int, float) and 0 <= value < math.inf)
