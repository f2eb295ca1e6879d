"""Transcripts: the requests and answers of an episode or a picture, one JSON object per line.

Each line is self-contained: it has the format, the settings, the answers and the outcome; pictures
are given by the SHA-256 of their PNG.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NotRequired

from annotated_types import Predicate
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from knotgym.common import MOST_JSON, InvalidFile, MissingFile, one_line

FORMAT = "knotgym-transcript"
FORMAT_VERSION = 1
TOKENS = ("prompt_tokens", "completion_tokens")  # what is counted
FILE = "transcripts.jsonl"  # name of the file in a run's folder

_Text = Annotated[str, Predicate(str.isprintable)]
_Tokens = Annotated[int, Field(ge=0)] | None
_Action = Annotated[list[Annotated[float, Field(ge=-1, le=1)]], Field(min_length=6, max_length=6)]


# The fields that are read later; lines have more, which docs/prompting.md lists.


class _Chat(TypedDict):
    model: _Text


class _Task(TypedDict):
    task: _Text
    nx: int
    split: _Text


class _Config(TypedDict):
    mode: _Text
    chat: _Chat
    task: NotRequired[_Task]


class _Request(TypedDict):
    fault: _Text
    finish: str
    retries: dict[_Text, Annotated[int, Field(ge=0)]]
    prompt_tokens: _Tokens
    completion_tokens: _Tokens


class _EpisodeLine(TypedDict):
    config: _Config
    seed: int
    start: int
    goal: int
    actions: list[_Action]
    success: bool
    turns: list[_Request]
    prompt_tokens: _Tokens
    completion_tokens: _Tokens


class _Picture(_Request):
    config: _Config
    gauss_code: str
    grade: _Text
    accepted: bool


_STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_EPISODE, _PICTURE = (
    TypeAdapter[Any](with_config(_STRICT)(kind)) for kind in (_EpisodeLine, _Picture)
)


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
    try:
        (_EPISODE if "actions" in found else _PICTURE).validate_python(found)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"]))
        raise InvalidFile(f"{where}, field {field}: {first['msg']}") from None
    return found
