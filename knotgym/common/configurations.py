"""Configurations: frozen pydantic dataclasses, which are the options of commands too.

A configuration is a dataclass of numbers, strings, tuples and further configurations; its annotated
types hold its bounds. It is stored as JSON in every file that was made with it.

    @configuration
    class RolloutConfig:
        horizon: PositiveInt = 50
        task: Literal["tie", "unknot"] = "tie"

A value that doesn't fit raises InvalidInput with one line, wherever it came from. A class checks
what no single field can tell in `__post_init__`, and raises the error itself.
"""

import dataclasses
import importlib
import importlib.util
import json
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import (
    Annotated,
    Any,
    Generic,
    Literal,
    NamedTuple,
    NoReturn,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as validated_dataclass

from knotgym.common.errors import InvalidFile, InvalidInput, KnotgymError, one_line

Config = TypeVar("Config")
Record = TypeVar("Record")


class Mark(NamedTuple):
    """What a field's value stands for, as part of its annotation; `Mark.fields` finds such fields.

    Attributes:
        word: "states" and "policy" name files, which a run digests and never overwrites; "typed" is
            what reaches the network or names code, so that no settings file may set it. Words of
            single classes are beside them, such as the roles of fields in `envs.tasks`.
        applies: for which values.
    """

    word: str
    applies: Callable[[Any], bool] = lambda value: True

    @staticmethod
    def fields(
        kind: type, values: Any, word: str, path: str = ""
    ) -> Iterator[tuple[str, Any, Any]]:
        """Yield the fields with a mark: path, the values beside it, and its own, which may be None.

        Args:
            kind: a configuration class.
            values: a configuration of this class, or JSON of one, which needn't be valid.
            word: the mark.
            path: what comes before the names of the fields.
        """
        hints = get_type_hints(kind, include_extras=True)
        for name, hint in ((field.name, hints[field.name]) for field in dataclasses.fields(kind)):
            own = values.get(name) if isinstance(values, Mapping) else getattr(values, name, None)
            for member in _members(hint):
                if isinstance(member, Mark) and member.word == word and member.applies(own):
                    yield f"{path}{name}", values, own
                if isinstance(member, type) and dataclasses.is_dataclass(member):
                    inner = own if isinstance(own, (list, tuple)) else [own]
                    for each in inner if own is not None else ():
                        yield from Mark.fields(member, each, word, f"{path}{name}.")

    @staticmethod
    def values(config: Any, *words: str) -> dict[str, Any]:
        """Return the fields of a configuration with one of the marks: path -> value."""
        each = (Mark.fields(type(config), config, word) for word in words)
        return {path: value for marked in each for path, _, value in marked}


_MOST_JSON = 256 << 20  # largest JSON file that is read, bytes

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_WORDS = {  # pydantic's words, and ours
    "Input should": "must",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "greater than": "above",
    "less than": "below",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid string": "text",
    "a valid boolean": "true or false",
    "a valid tuple": "a list",
    "a valid array": "a list",
}
_PLAIN = {bool, int, float, str, type(None)}
_SHOWN = 80  # characters of a refused value that a message repeats


def python_values(value: Any, lists: type = list) -> Any:
    """NumPy's numbers, truth values, texts and arrays as Python's, which JSON takes.

    Args:
        value: a value, or dicts, lists and tuples of values.
        lists: what becomes of lists.
    """
    if type(value) in _PLAIN:
        return value
    if isinstance(value, np.longdouble):
        return float(value)  # `item` returns it as it is
    if isinstance(value, (np.generic, np.ndarray)):
        return python_values(value.tolist(), lists)
    if isinstance(value, dict):
        return {python_values(key): python_values(item, lists) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return (lists if isinstance(value, list) else tuple)(python_values(v, lists) for v in value)
    return value


def _of_name(hint: Any, value: Any) -> Any:
    """Replace names, alone or in a tuple, where a configuration with NAMED_BY is wanted."""
    kind = next((member for member in _members(hint) if hasattr(member, "NAMED_BY")), None)
    if kind and isinstance(value, tuple):
        return tuple(_of_name(kind, item) for item in value)
    return kind(**{kind.NAMED_BY: value}) if kind and isinstance(value, str) else value


def _distinct(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if not values or len(set(values)) < len(values):
        raise InvalidInput("must be at least one, each once")
    return values


def choice(
    *known: str, growing: Collection[str] = (), help: Callable[[], str] | None = None
) -> AfterValidator:
    """Make the annotation of a string that must be one of some words.

    Args:
        known: the words.
        growing: a table of more of them, which may grow.
        help: returns the field's help, where that is made from the table.
    """
    return AfterValidator(_Choice(known, growing, help))


@dataclasses.dataclass(frozen=True, eq=False)
class _Choice:
    known: tuple[str, ...]
    growing: Collection[str]
    help: Callable[[], str] | None

    def __call__(self, value: Any) -> Any:
        if value not in (*self.known, *self.growing):
            use_plugins()  # may make it grow
        words = *self.known, *self.growing
        if value not in words:
            named = ", ".join(name or repr(name) for name in words)
            raise InvalidInput(f"must be one of {named}{getattr(self.growing, 'more', '')}")
        return value


class Kinds(dict[str, Record], Generic[Record]):
    """A closed set: name -> the record that holds everything in which one of its kinds differs.

    Everybody looks up; nobody compares names. InvalidInput for a name that isn't there.

    Attributes:
        more: what an error adds of names that users can give to kinds of their own.
    """

    def __init__(self, what: str, records: dict[str, Record], more: str = "") -> None:
        super().__init__(records)
        self.more = more
        self._what = what  # the field that names them, for the error

    def __missing__(self, name: Any) -> Record:
        use_plugins()
        if name in self:
            return self[name]
        raise InvalidInput(f"{self._what} must be one of {', '.join(self)}, got {name!r}")


def choices(hint: Any) -> list[str]:
    """Return the words that a field may be or hold, as its annotation says; none if any may."""
    words = list[str]()
    for member in _members(hint):
        checked = getattr(member, "func", None)
        if isinstance(checked, _Choice):
            words += [*checked.known, *checked.growing]
        elif get_origin(member) is Literal:
            words += [word for word in get_args(member) if isinstance(word, str)]
    return [word for word in dict.fromkeys(words) if word]


Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]  # stored as int64
Count = Annotated[int, Field(gt=0, le=10**9)]  # of what a run makes; more would never end
Share = Annotated[float, Field(ge=0, le=1)]
Distinct = AfterValidator(_distinct)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(Field,))
def configuration(cls: type[Config]) -> type[Config]:
    """Make a class a configuration: frozen, keywords only, validated by its annotations.

    A class may say in `NAMED_BY` which of its fields a name stands for: `policy="expert"` is then
    the same as `policy=PolicyConfig(policy="expert")`.

    Raises (when one is made):
        InvalidInput: an unknown field, a missing one, or a value of the wrong type or out of range.
    """
    made: Any = validated_dataclass(frozen=True, kw_only=True, config=_STRICT)(cls)
    validate, hints = made.__init__, cache(partial(get_type_hints, made))

    def __init__(self: Any, /, *values: Any, **fields: Any) -> None:
        try:
            given = {
                n: _of_name(hints().get(n), python_values(value, tuple))
                for n, value in fields.items()
            }
            validate(self, *values, **given)
        except ValidationError as error:
            _refuse(error, made)

    made.__init__ = __init__
    return made


def as_json(config: Any) -> dict[str, Any]:
    """Convert a configuration to JSON: nested dicts, with lists for tuples."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(kind: type[Config], values: Mapping[str, Any]) -> Config:
    """Make a configuration of class `kind` from JSON, as `as_json` returns it or less.

    Fields that aren't given get their defaults, in nested configurations too.

    Raises:
        InvalidInput: an unknown field, or a value of the wrong type or out of range.
    """
    every: Any = dataclasses.fields(kind)  # type: ignore[arg-type]
    inner = [field for field in every if dataclasses.is_dataclass(field.default)]
    nested = {field.name: as_json(field.default) for field in inner}
    with InvalidInput.instead(f"{kind.__name__} is made of JSON values", TypeError, ValueError):
        text = json.dumps(merged(nested, values), default=_jsonable)
    try:
        return TypeAdapter(kind).validate_json(text)  # lists become tuples, objects configurations
    except ValidationError as error:
        _refuse(error, kind)


def merged(below: Any, above: Any) -> Any:
    """JSON with the values of `above`, and those of `below` that it lacks, object by object."""
    if not (isinstance(below, Mapping) and isinstance(above, Mapping)):
        return above
    common = {name: merged(below[name], above[name]) for name in above if name in below}
    return {**below, **above, **common}


def _jsonable(value: Any) -> Any:
    """A value that JSON lacks, as one that it has."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if (plain := python_values(value)) is not value:
        return plain
    raise InvalidInput(f"{value!r} isn't one")


def _refuse(error: ValidationError, kind: type) -> NoReturn:
    """Raise the first problem of a validation as an error of ours, in one line."""
    problems = error.errors(include_url=False)
    first, path, is_field = problems[0], list[str](), False
    for name in map(str, first["loc"]):  # beyond a field: an index, or a member of a union
        path.append(name)
        hint = get_type_hints(kind).get(name)  # of a configuration, or such as `X | None`
        inner: Any = next(filter(dataclasses.is_dataclass, (hint, *get_args(hint))), None)
        if is_field := inner is None:
            break
        kind = inner
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, KnotgymError) and not is_field:
        raise cause from None  # by the configuration's own check: a whole sentence
    where = ".".join(path) or kind.__name__
    if first["type"] == "unexpected_keyword_argument":
        known = ", ".join(field.name for field in dataclasses.fields(kind))
        raise InvalidInput(f"{kind.__name__} has no field {where!r}; it has {known}") from None
    if first["type"] == "missing" and not isinstance(first["loc"][-1], int):
        raise InvalidInput(f"{kind.__name__} needs the field {where!r}") from None
    given = repr(first["input"])
    given = given if len(given) <= _SHOWN else f"{given[: _SHOWN - 3]}..."
    # the members of a union each have a problem
    every = [fault for fault in problems if fault["loc"][: len(path)] == first["loc"][: len(path)]]
    problem = " or ".join(dict.fromkeys(map(_problem, every))).replace(" or must be ", " or ")
    raise InvalidInput(f"{where} {problem}, got {given}") from None


def _problem(error: Any) -> str:
    """Say what a value must be."""
    cause = error.get("ctx", {}).get("error")
    if cause:
        return str(cause)
    if error["type"] == "missing":  # an item of a list
        return f"must have at least {error['loc'][-1] + 1} items"
    if error["type"] == "too_long":
        return f"must have at most {error['ctx']['max_length']} items"
    problem = str(error["msg"])
    for theirs, ours in _WORDS.items():
        problem = problem.replace(theirs, ours)
    return problem


def _members(hint: Any) -> Iterator[Any]:
    """Yield what an annotation consists of: types and marks."""
    yield hint
    for arg in get_args(hint):
        yield from _members(arg)


def read_json(path: str | os.PathLike[str], most: int = _MOST_JSON) -> Any:
    """Read a JSON file of at most `most` bytes; anything but a regular file isn't opened.

    Raises:
        InvalidFile: it isn't a regular file, is too large or too deeply nested, isn't JSON, or has
            an object with a key twice.
    """
    given = Path(path)
    if given.exists() and not given.is_file():
        raise InvalidFile(f"{given} isn't a regular file")
    with open(given, "rb") as file:
        text = file.read(most + 1)
    if len(text) > most:
        raise InvalidFile(f"{given} has more than {most} bytes, too many for a JSON file")
    with InvalidFile.instead(f"{given} isn't valid JSON", ValueError, LookupError, RecursionError):
        return json.loads(text.decode("utf-8"), object_pairs_hook=_object)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    named = dict(pairs)
    if len(named) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise LookupError(f"key {twice!r} is there twice")
    return named


def by_name(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return a dictionary of pairs, in which a name that comes with another value gets a number.

    >>> by_name([("a", 1), ("b", 2), ("a", 1), ("a", 3)])
    {'a': 1, 'b': 2, 'a (2)': 3}
    """
    values: dict[str, Any] = {}
    for name, value in pairs:
        number, key = 1, name
        while values.setdefault(key, value) != value:
            number += 1
            key = f"{name} ({number})"
    return values


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
        said = f"{where} is {json.dumps(there)} there and {json.dumps(requested)} here"
        yield one_line(said)


# Plugins are modules of others that register kinds, such as tasks and policies, when imported.
# `--plugin MODULE` names one; packages that are installed name theirs by entry points of this
# group, which are also imported where a name is looked up that nothing registered. No file of data
# names one. Workers import what the process that started them did.
_PLUGINS = "knotgym.plugins"
_imported: dict[str, ModuleType] = {}
_installed = list[str]()


@contextmanager
def near(module: str) -> Iterator[None]:
    """In the block, import a module from the current folder if it isn't installed.

    That is on the path only there, so the module must import its neighbours at the top.
    """
    package, searched = module.partition(".")[0], list(sys.path)
    if package not in sys.modules and importlib.util.find_spec(package) is None:
        sys.path.append(os.getcwd())  # searched, too, as by `python -m`
    try:
        yield
    finally:
        sys.path[:] = searched


def use_plugins(names: Iterable[str] = ()) -> None:
    """Import plugins, and those that are installed, once.

    Raises:
        InvalidInput: one isn't a module, or importing it fails.
    """
    if not _installed:
        _installed.extend(["", *sorted(point.value for point in entry_points(group=_PLUGINS))])
    for name in dict.fromkeys([*_installed[1:], *names]):
        if name in _imported:
            continue
        if not all(map(str.isidentifier, name.split("."))):
            raise InvalidInput(f"a plugin is a module, such as mine, got {name!r}")
        try:
            with near(name):
                _imported[name] = importlib.import_module(name)
        except (Exception, SystemExit) as error:
            what = one_line(error) if isinstance(error, KnotgymError) else repr(error)
            raise InvalidInput(f"plugin {name} can't be imported: {one_line(what)}") from error


def plugins() -> dict[str, Path | str]:
    """Return the plugins that were imported, and the source of each, or "" where it has none."""
    sources = ((name, getattr(value, "__file__", None)) for name, value in _imported.items())
    return {name: Path(source) if source else "" for name, source in sources}
