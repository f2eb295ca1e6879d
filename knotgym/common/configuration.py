"""Configurations: frozen pydantic dataclasses, which are the options of commands too.

A configuration is a dataclass of numbers, strings, tuples and further configurations; its annotated
types hold its bounds. It is stored as JSON in every file that was made with it.

    @configuration
    class RolloutConfig:
        horizon: Count = 50
        task: Literal["tie", "unknot"] = "tie"

What doesn't fit raises InvalidInput with one line, wherever the values came from.
"""

import dataclasses
import json
import math
import os
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as validated_dataclass

from knotgym.common.errors import InvalidFile, InvalidInput, KnotgymError, one_line

Config = TypeVar("Config")

MOST_JSON = 256 << 20  # largest JSON file that is read, bytes

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _plain(value: Any) -> Any:
    """NumPy's integers as Python's; strict validation refuses them otherwise."""
    return int(value) if isinstance(value, np.integer) else value


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise InvalidInput("must have the smaller number first")
    return pair


def _distinct(values: tuple[int, ...]) -> tuple[int, ...]:
    if not values or len(set(values)) < len(values):
        raise InvalidInput("must be at least one number, each once")
    return values


Whole = Annotated[int, BeforeValidator(_plain), Field(ge=0)]
Count = Annotated[int, BeforeValidator(_plain), Field(ge=1)]
Seed = Annotated[int, BeforeValidator(_plain), Field(ge=0, le=2**63 - 1)]  # stored as int64
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Interval = Annotated[tuple[NonNegative, NonNegative], AfterValidator(_ordered)]
Crossings = Annotated[tuple[Whole, ...], AfterValidator(_distinct)]


@dataclass_transform(frozen_default=True, kw_only_default=True)
def configuration(cls: type[Config]) -> type[Config]:
    """Make a class a configuration: frozen, keywords only, validated by its annotations.

    Raises (when one is made):
        InvalidInput: an unknown field, a missing one, or a value of the wrong type or out of range.
    """
    made: Any = validated_dataclass(frozen=True, kw_only=True, config=STRICT)(cls)
    validate = made.__init__

    def __init__(self: Any, /, *values: Any, **fields: Any) -> None:
        try:
            validate(self, *values, **fields)
        except ValidationError as error:
            raise InvalidInput(_sentence(error, made)) from None

    made.__init__ = __init__
    return made


def _sentence(error: ValidationError, kind: type) -> str:
    """The first problem of a validation, as one line."""
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"]) or kind.__name__
    given = repr(first["input"])
    given = given if len(given) <= 80 else f"{given[:77]}..."
    known = [field.name for field in dataclasses.fields(kind)]
    if first["type"] == "unexpected_keyword_argument":
        return f"{kind.__name__} has no field {where!r}; it has {', '.join(known)}"
    if first["type"] == "missing":
        return f"{kind.__name__} needs the field {where}"
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, InvalidInput) and not first["loc"]:
        return str(cause)  # of the configuration's own check: a whole sentence
    problem = str(cause) if cause else first["msg"].replace("Input should be", "must be")
    return f"{where} {problem}, got {given}"


def check_numbers(
    config: object,
    *,
    counts: Sequence[str] = (),
    whole: Sequence[str] = (),
    positive: Sequence[str] = (),
    non_negative: Sequence[str] = (),
    shares: Sequence[str] = (),
    ranges: Sequence[str] = (),
    error: type[KnotgymError] = InvalidInput,
) -> None:
    """Check the numbers of a configuration; NaN and infinity are never valid.

    Args:
        counts, whole: names of fields that must be whole numbers of at least 1, at least 0.
        positive, non_negative: names of those that must be above 0, at least 0.
        shares: names of those that must be in [0, 1].
        ranges: names of those that must be pairs (least, most) of numbers of at least 0.
        error: the error class to raise.
    """
    least_whole = {**dict.fromkeys(counts, 1), **dict.fromkeys(whole, 0)}
    for name, least in least_whole.items():
        value = getattr(config, name)
        if not isinstance(value, Integral) or value < least:
            raise error(f"{name} must be a whole number of at least {least}, got {value!r}")
    for names, fits, expected in (
        (positive, lambda value: 0 < value < math.inf, "above 0 and finite"),
        (non_negative, lambda value: 0 <= value < math.inf, "at least 0 and finite"),
        (shares, lambda value: 0 <= value <= 1, "in [0, 1]"),
        (ranges, _is_range, "two finite numbers, at least 0, the smaller one first"),
    ):
        for name in names:
            value = getattr(config, name)
            if not fits(value):
                raise error(f"{name} must be {expected}, got {value!r}")


def check_nx(nx: Sequence[int], most: int) -> None:
    """Raise InvalidInput unless there are crossing numbers, distinct and in [0, most]."""
    if not nx or any(not 0 <= one <= most for one in nx) or len(set(nx)) != len(nx):
        raise InvalidInput(
            f"nx takes distinct numbers of crossings from 0 to {most}, got"
            f" {', '.join(map(str, nx)) or 'none'}"
        )


def read_json(path: str | os.PathLike[str], most: int = MOST_JSON) -> Any:
    """Read a JSON file of at most `most` bytes; anything but a regular file isn't opened.

    Raises:
        InvalidFile: it isn't a regular file, too large, not JSON, or too deeply nested.
    """
    given = Path(path)
    if given.exists() and not given.is_file():
        raise InvalidFile(f"{given} isn't a regular file")
    with open(given, "rb") as file:
        text = file.read(most + 1)
    if len(text) > most:
        raise InvalidFile(f"{given} has more than {most} bytes, too many for a JSON file")
    try:
        return json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InvalidFile(f"{given} isn't valid JSON: {one_line(error)}") from error


def as_json(config: Any) -> dict[str, Any]:
    """Convert a configuration to JSON: nested dicts, with lists for tuples."""
    found: dict[str, Any] = json.loads(json.dumps(asdict(config)))
    return found


def updated(config: Config, changes: Mapping[str, Any], where: str = "") -> Config:
    """Return a copy of a configuration with some fields replaced, in nested ones field by field.

    `changes` have the form that `as_json` returns; `where` names the configuration in errors.

    Raises:
        InvalidInput: an unknown field, or a value of the wrong type.
        KnotgymError: the configuration rejects the value.

    >>> from knotgym.envs.tasks import TaskConfig
    >>> updated(TaskConfig(task="tie"), {"nx": 3}).nx
    3
    """
    assert is_dataclass(config) and not isinstance(config, type)
    current = partial(getattr, config)
    return replace(config, **_fields(type(config), changes, where or "settings", where, current))


def from_json(kind: type[Config], values: Mapping[str, Any], where: str = "") -> Config:
    """Make a configuration of class `kind` from JSON, as `as_json` returns it or less.

    Fields that aren't given get their defaults, in nested configurations too.

    Raises:
        InvalidInput: an unknown field, or a value of the wrong type.
        KnotgymError: the configuration rejects a value.
    """
    made: Any = kind
    defaults = {field.name: field.default for field in fields(made)}
    named = where or made.__name__
    return kind(**_fields(kind, values, named, where, defaults.__getitem__))


def _fields(
    kind: type, values: Any, named: str, where: str, current: Callable[[str], Any]
) -> dict[str, Any]:
    """Convert JSON values to the types of a configuration's fields.

    Args:
        kind: a dataclass.
        values: name -> value, unchecked.
        named: name of the configuration in error messages.
        where: path to it; "" for the outermost.
        current: name -> value to update, if it is a configuration.
    """
    if not isinstance(values, Mapping):
        raise InvalidInput(f"{named} must be an object, got {values!r}")
    hints = get_type_hints(kind)
    if unknown := [name for name in values if name not in hints]:
        raise InvalidInput(
            f"{named}: no field {', '.join(map(repr, unknown))}; there is {', '.join(hints)}"
        )
    found: dict[str, Any] = {}
    for name, value in values.items():
        here, path = current(name), f"{where}.{name}" if where else name
        nested = is_dataclass(here) and not isinstance(here, type)
        found[name] = updated(here, value, path) if nested else _typed(value, hints[name], path)
    return found


def differences(there: Any, requested: Any, where: str = "") -> Iterator[str]:
    """Yield a sentence for each place where two JSON values differ.

    >>> list(differences({"seed": 1, "rope": {"beads": 100}}, {"seed": 2, "rope": {"beads": 100}}))
    ['seed is 1 there and 2 here']
    """
    if isinstance(there, dict) and isinstance(requested, dict):
        for name in dict.fromkeys([*there, *requested]):
            path = f"{where}.{name}" if where else str(name)
            yield from differences(there.get(name), requested.get(name), path)
    elif there != requested:
        yield f"{where} is {json.dumps(there)} there and {json.dumps(requested)} here"


def _typed(value: Any, hint: Any, where: str) -> Any:
    """Convert a JSON value to the type of a field; a list becomes a tuple."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    for option in options:
        origin = get_origin(option) or option
        if origin is Literal:
            return value  # the configuration itself checks it
        if option is type(None):
            if value is None:
                return None
        elif is_dataclass(origin) and isinstance(value, Mapping):
            return from_json(option, value, where)
        elif origin is tuple:
            if isinstance(value, (list, tuple)):
                kinds = get_args(option)
                many = kinds[:1] * len(value) if kinds[-1:] == (Ellipsis,) else kinds
                if len(many) == len(value):
                    return tuple(_typed(*each, where) for each in zip(value, many, strict=True))
        elif origin is float:
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                return float(value)
        elif isinstance(value, origin) and (origin is bool or not isinstance(value, bool)):
            return value
    names = " or ".join(getattr(option, "__name__", str(option)) for option in options)
    raise InvalidInput(f"{where} must be {names}, got {value!r}")


def _is_range(value: Any) -> bool:
    return len(value) == 2 and 0 <= value[0] <= value[1] < math.inf
