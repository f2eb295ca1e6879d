"""Transcripts, their totals, and scores of the Gauss codes read from pictures.

A transcript has the requests and answers of an episode or a picture, one JSON object per line.

Each line is self-contained: it has the format, the settings, the answers and the outcome; pictures
are given by the SHA-256 of their PNG.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from annotated_types import Predicate
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from knotgym.common import InvalidFile, MissingFile
from knotgym.quality import GRADES
from knotgym.runs import cluster_interval
from knotgym.topology import GaussCode

FORMAT = "knotgym-transcript"
FORMAT_VERSION = 2
TOKENS = ("prompt_tokens", "completion_tokens")  # what is counted
FILE = "transcripts.jsonl"  # name of the file in a run's folder
_MOST_BYTES = 256 << 20  # of a file
_HEAD = ("", "pictures", "exact", "crossings")

_Text = Annotated[str, Predicate(str.isprintable)]
_Tokens = Annotated[int, Field(ge=0)] | None


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
    rejected: _Text
    finish: str
    retries: dict[_Text, Annotated[int, Field(ge=0)]]
    prompt_tokens: _Tokens
    completion_tokens: _Tokens


class _EpisodeLine(TypedDict):
    config: _Config
    start: int
    goal: int
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
_strict = with_config(_STRICT)
_EPISODE, _PICTURE = (TypeAdapter[Any](_strict(kind)) for kind in (_EpisodeLine, _Picture))


def line(transcript: Mapping[str, Any]) -> str:
    """Serialize a transcript as a line, with its format and a line break."""
    whole = {"format": FORMAT, "format_version": FORMAT_VERSION, **transcript}
    return json.dumps(whole, ensure_ascii=True, allow_nan=False) + "\n"


def show_transcripts(named: str | Path) -> tuple[dict[str, Any], list[tuple[str, ...]]] | None:
    """Return facts by name and a table, its head first, of the transcripts of a file or a run.

    Returns:
        None if the path is neither a `.jsonl` file nor a folder with transcripts. The table is
        empty for episodes.

    Raises:
        InvalidFile: as in `_read_transcripts`.
    """
    given = Path(named)
    file = given / FILE if given.is_dir() else given
    if not file.is_file() or file.suffix != ".jsonl":
        return None
    transcripts = _read_transcripts(file)
    config = transcripts[0]["config"]
    task = config.get("task")  # none where pictures were read
    task = task and {name: task[name] for name in ("task", "nx", "split")}
    facts = {"model": config["chat"]["model"], "mode": config["mode"], "task": task}
    table = [] if "actions" in transcripts[0] else _reading_table(reading_scores(transcripts))
    return {**facts, **summarize(transcripts)}, table


def _read_transcripts(path: Path) -> list[dict[str, Any]]:
    """Read the transcripts of a file.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: a line is not a valid transcript.
    """
    if not path.is_file():
        raise MissingFile(f"no transcripts at {path}")
    if path.stat().st_size > _MOST_BYTES:
        raise InvalidFile(f"{path} is larger than {_MOST_BYTES} bytes; split it")
    with InvalidFile.instead(f"{path} isn't UTF-8 text", UnicodeDecodeError):
        text = path.read_text(encoding="utf-8")
    lines = text.removesuffix("\n").split("\n")
    return [_checked(row, f"{path}, line {number}") for number, row in enumerate(lines, 1)]


def _checked(text: str, where: str) -> dict[str, Any]:
    """Parse a line and check every field that is read later."""
    with InvalidFile.instead(f"{where} isn't JSON", ValueError, RecursionError):
        transcript = json.loads(text)
    if not isinstance(transcript, dict):
        raise InvalidFile(f"{where} isn't a transcript but {str(transcript)[:40]}")
    name, version = transcript.get("format"), transcript.get("format_version")
    if (name, version) != (FORMAT, FORMAT_VERSION):
        raise InvalidFile(
            f"{where} has format {name!r} version {version!r}; this version reads {FORMAT!r}"
            f" version {FORMAT_VERSION}"
        )
    try:
        (_EPISODE if "actions" in transcript else _PICTURE).validate_python(transcript)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"]))
        raise InvalidFile(f"{where}, field {field}: {first['msg']}") from None
    return transcript


def summarize(transcripts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarize the transcripts of one run, at least one, as JSON-compatible values.

    Counts answers by fault, requests that the server rejected by its reason, answers cut off by its
    limit, retries and tokens, which are None if a server didn't state them. For episodes it adds
    the success rate with its 95 % interval, and the episodes without any valid answer.
    """
    # the requests: turns of episodes, or the transcripts of pictures themselves
    turns = [turn for transcript in transcripts for turn in transcript.get("turns", [transcript])]
    reasons = [turn["rejected"].partition(":")[0] for turn in turns if turn["rejected"]]
    facts: dict[str, Any] = {
        "answers": dict(Counter(turn["fault"] or "valid" for turn in turns).most_common()),
        "rejected": dict(Counter(reasons).most_common()),
        "truncated": sum(turn["finish"] == "length" for turn in turns),
        "retries": dict(sum((Counter(turn["retries"]) for turn in turns), Counter())),
        **{name: total(transcripts, name) for name in TOKENS},
    }
    if "actions" not in transcripts[0]:
        return {"pictures": len(transcripts), **facts}
    columns = ([int(t[name]) for t in transcripts] for name in ("success", "start", "goal"))
    success, starts, goals = columns
    return {
        "episodes": len(transcripts),
        "successes": sum(success),
        "success_rate": sum(success) / len(transcripts),
        "interval": list(cluster_interval(success, starts, goals)),
        "without_valid_answer": sum(
            not transcript["success"] and all(turn["fault"] for turn in transcript["turns"])
            for transcript in transcripts
        ),
        **facts,
    }


def total(replies: Iterable[Mapping[str, Any]], name: str) -> int | None:
    """Add up the numbers of tokens of replies; None if one is unknown."""
    counts = [reply[name] for reply in replies]
    return None if None in counts else sum(counts)


def reading_scores(transcripts: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Score transcripts of mode read, by number of crossings and by grade; chirality is ignored.

    The scores are `exact` and `crossings`, the shares of pictures whose code, or number of
    crossings, was read correctly.

    Returns:
        Group -> number of pictures and mean of each score. Groups are "all", "nx 2" and the like,
        and the grades.
    """
    groups: dict[str, list[tuple[bool, bool]]] = {}
    for transcript in transcripts:
        code, answer = GaussCode.parse(transcript["gauss_code"]), transcript.get("read")
        read = GaussCode.parse(answer) if isinstance(answer, str) else None
        scores = read is not None and read.matches(code), read is not None and read.nx == code.nx
        for key in ("all", f"nx {code.nx}", str(transcript["grade"])):
            groups.setdefault(key, []).append(scores)
    # all, then by nx, then by grade from easy to hard
    grades = {grade: str(place) for place, grade in enumerate(GRADES)}
    order = sorted(groups, key=lambda key: (key != "all", key in grades, grades.get(key, key)))
    means = {key: np.mean(groups[key], axis=0).tolist() for key in order}
    return {
        key: {"pictures": len(groups[key]), "exact": exact, "crossings": crossings}
        for key, (exact, crossings) in means.items()
    }


def _reading_table(scores: Mapping[str, Mapping[str, float]]) -> list[tuple[str, ...]]:
    """Return the rows of a table of `reading_scores`, its head first."""
    return [_HEAD] + [
        (key, f"{means['pictures']:.0f}", *(f"{100 * means[name]:.1f} %" for name in _HEAD[2:]))
        for key, means in scores.items()
    ]
