"""Damage done to JSON values: another type, out of range, leading elsewhere, or gone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Random = np.random.Generator

ODD: tuple[Any, ...] = (
    None,
    True,
    -1,
    1.5,
    2**70,
    float("nan"),
    "",
    "\x1b[2J",
    "../../x",
    "/dev/zero",
    [],
    {},
    [[1]],
    {"a": {"b": None}},
)


def pick(rng: Random, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON value but the whole, as keys to go by."""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for name, one in inner:
        found.append((*at, name))
        if isinstance(one, dict | list):
            found += places(one, (*at, name))
    return found


def holder(value: Any, place: tuple[Any, ...]) -> Any:
    for name in place[:-1]:
        value = value[name]
    return value


def _change(value: Any, rng: Random, change: Callable[[Any, Any], None]) -> None:
    """Change a place in a JSON value, if it has any."""
    found = places(value)
    if not found:
        return
    # shallow places, where readers look, as often as all the deep ones
    depth = pick(rng, sorted({len(place) for place in found}))
    place = pick(rng, [one for one in found if len(one) == depth])
    change(holder(value, place), place[-1])


def change_one(value: Any, rng: Random) -> None:
    """Put something odd at a place of a JSON value."""
    odd = pick(rng, ODD)

    def change(inside: Any, name: Any) -> None:
        inside[name] = odd

    _change(value, rng, change)


def _changed(path: Path, rng: Random, change: Callable[[Any, Any], None]) -> None:
    """Change a place in a JSON file, or in a line of a file of such lines."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.suffix == ".jsonl" else [""]
    line = int(rng.integers(len(lines)))
    value = json.loads(lines[line] or path.read_text(encoding="utf-8"))
    _change(value, rng, change)
    lines[line] = json.dumps(value)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def value_changed(path: Path, rng: Random) -> None:
    """One value of another type, out of range, or leading elsewhere."""
    odd = pick(rng, ODD)

    def change(inside: Any, name: Any) -> None:
        inside[name] = odd

    _changed(path, rng, change)


def value_missing(path: Path, rng: Random) -> None:
    """One value gone."""
    _changed(path, rng, lambda inside, name: inside.__delitem__(name))


def not_json(path: Path, rng: Random) -> None:
    """Something else in its place: nested too deeply, another kind of value, no text, nothing."""
    other = (b"[" * 200_000, b"[1]", b'"a"', b"null", b"\xff\xfe", b"", b"9" * 10_000, b"{}")
    path.write_bytes(pick(rng, other))
