"""Commands from configuration classes.

A command is a function, the configuration classes that it fills, and the fields of these that are
options; cyclopts makes the rest. The help of an option is the first sentence about its field in the
class's docstring; that of an option that is no field, what the function's docstring has under Args.
What is typed becomes one tree of JSON values, with this precedence,

    typed options  >  --set name=value  >  --settings FILE  >  defaults

which the classes validate once. Fields that aren't options are settings: `--set` and `--settings`
reach every field, under the same names.
"""

import dataclasses
import inspect
import os
import re
import tomllib
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from cyclopts import App, Group, Parameter

from knotgym.common import (
    InvalidInput,
    Occupied,
    choices,
    from_json,
    marked,
    merged,
    read_json,
)
from knotgym.runs import Progress, RunOptions

Config = TypeVar("Config")
Sections = Mapping[str, type]  # of a command's settings; "" is the outermost

APP: dict[str, Any] = {
    "help_format": "plaintext",
    "version_flags": [],
    "suppress_keyboard_interrupt": False,
}
EXISTING = "run.resume run.restart run.overwrite"
RUN = f"seed run.workers {EXISTING}"  # options of every command that makes data
_QUIET = Annotated[bool, Parameter(show=False, negative="", help="Print errors only.")]
_GROUP, _RUN_GROUP = (Group.create_ordered(name) for name in ("Options", "How it is run"))
_METAVARS = {int: "N", float: "X", Path: "PATH", tuple[int, ...]: "N,N", tuple[str, ...]: "A,B"}


class Option(NamedTuple):
    """An option, or an argument.

    Attributes:
        path: the field that it sets, such as "task.horizon", or the name of an extra option.
        typed: what is typed, such as "--horizon" or "--keep/--drop"; the name of an argument.
        kind: type of its value.
        default: its default; `...` if it must be given.
        help: its help.
        is_field: whether it sets a field of a configuration.
    """

    path: str
    typed: str
    kind: Any
    default: Any = None
    help: str = ""
    is_field: bool = False

    @property
    def key(self) -> str:
        """Its name as a parameter of a function."""
        return self.path.replace(".", "__")

    @property
    def is_argument(self) -> bool:
        """Whether it is typed without a name."""
        return not self.typed.startswith("-")

    def parameter(self) -> inspect.Parameter:
        """Return it as cyclopts reads it; values are text, but for flags and lists."""
        name, _, negative = self.typed.partition("/")
        shown = as_typed(self.default)
        in_run = self.path.startswith("run.") or self.path in ("seed", "settings", "set")
        info = Parameter(
            name=name,
            metavar=_METAVARS.get(_typed_kind(self.kind), "TEXT"),
            help=self.help,
            negative=negative,
            group=_RUN_GROUP if in_run else _GROUP,
            show_default=(lambda _: shown) if shown else False,
        )
        kind = self.kind if self.kind in (bool, list[str]) else str
        return inspect.Parameter(
            self.key,
            inspect.Parameter.POSITIONAL_ONLY
            if self.is_argument
            else inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if self.default is ... else None,
            annotation=Annotated[kind | None, info],
        )


def extra(name: str, kind: Any, default: Any = None, help: str = "") -> Option:
    """Return an option that is no field of a configuration; one in capitals is an argument."""
    path = name.lower().replace("-", "_")
    return Option(path, name if name.isupper() else f"--{name}", kind, default, help)


def command(
    sections: Sections, fields: str, *extras: Option, lines: bool = True
) -> Callable[[Callable[["Given"], None]], App]:
    """Make a function a command.

    Args:
        sections: the configuration classes. The class "" is the command's own; the settings of
            another are in a section of its name, such as `policy.noise`.
        fields: the fields that are options, separated by spaces; `tasks=--task` renames one.
        extras: options that are no fields.
        lines: see `Progress`.
    """
    sections = {**sections, "run": RunOptions}
    found = [_field(sections, *word.split("=")) for word in fields.split()]
    options = [*extras, *(option for option in found if option is not None)]
    if "" in sections:
        options += [
            extra("settings", Path, help="TOML or JSON file of settings."),
            extra("set", list[str], help="One setting, such as task.horizon=30; may be repeated."),
        ]

    def declare(function: Callable[[Given], None]) -> App:
        arguments = [option.key for option in options if option.is_argument]
        doc = inspect.cleandoc(function.__doc__ or "")
        parameters = [
            option._replace(help=option.help or _described(doc, "Args", option.path)).parameter()
            for option in options
        ]
        parameters.sort(key=lambda one: one.kind)  # arguments first
        quiet = inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False)
        parameters.append(quiet.replace(annotation=_QUIET))

        def run(*words: str, quiet: bool = False, **values: Any) -> None:
            values |= dict(zip(arguments, words, strict=False))
            with Progress(quiet, lines=lines) as progress:
                function(Given(sections, options, values, progress, quiet))

        run.__annotations__ = {one.name: one.annotation for one in parameters}
        vars(run).update(__signature__=inspect.Signature(parameters), sections=sections)
        help = _reflowed(doc.partition("\n\nArgs:\n")[0]).partition("\n\n")
        name = function.__name__.rstrip("_").replace("_", "-")
        app = App(name=name, help=help[0], help_epilogue=help[2], **APP)
        app.default(run)
        return app

    return declare


class Given:
    """What was typed for a command.

    Attributes:
        progress: the progress display.
        quiet: whether only errors are printed.
        typed: paths of the options that were typed.
    """

    def __init__(
        self,
        sections: Sections,
        options: list[Option],
        values: Mapping[str, Any],
        progress: Progress,
        quiet: bool,
    ) -> None:
        self.progress, self.quiet, self._sections = progress, quiet, sections
        self._extras: dict[str, Any] = {}
        self.typed: set[str] = set()
        fields: dict[str, Any] = {}
        for option in options:
            value = values.get(option.key)
            if value is not None:
                self.typed.add(option.path)
                value = _read_value(value, option.kind, option.typed.partition("/")[0])
            if option.is_field and value is not None:
                fields[option.path] = value
            elif not option.is_field:
                self._extras[option.path] = option.default if value is None else value
        self._require_apart(options, values)
        settings = _read_settings(self._extras.get("settings"))
        for section, kind in sections.items():
            own = settings.get(section) if section else settings
            for path, _, text in marked(kind, own, "typed"):
                if text is not None:
                    name = f"{section}.{path}" if section else path
                    raise InvalidInput(
                        f"a settings file may not set {name}, which reaches the network or names"
                        f" code: type --set {name}=... if you mean it"
                    )
        for one in self._extras.get("set") or ():
            path, sign, text = one.partition("=")
            if not sign:
                raise InvalidInput(f"--set takes name=value, such as task.horizon=30, got {one!r}")
            field = _field(sections, path)
            value = _read_value(text, field.kind, f"--set {path}") if field else text
            settings = merged(settings, _nested({path: value}))
        self._settings = merged(settings, _nested(fields))

    def _require_apart(self, options: list[Option], values: Mapping[str, Any]) -> None:
        """Raise Occupied if --out is a file or folder that another option names."""
        out = self._extras.get("out")
        if out is None or not os.path.exists(out):
            return
        for option in options:
            value = values.get(option.key)
            for text in value if isinstance(value, list) else [value]:
                if option.path == "out" or not isinstance(text, str) or not os.path.exists(text):
                    continue
                if os.path.samefile(text, out):
                    raise Occupied(f"--out {out} is what {option.typed} reads; choose another")

    def __getitem__(self, name: str) -> Any:
        """Return the value of an option that is no field."""
        return self._extras[name]

    def has(self, path: str) -> bool:
        """Return whether a field was typed or set."""
        return _value_at(self._settings, path) is not None

    def get(self, path: str) -> Any:
        """Return a field as JSON: what was typed or set, else its default; not yet validated."""
        found, field = _value_at(self._settings, path), _field(self._sections, path)
        return found if found is not None or field is None else field.default

    def config(
        self,
        kind: type[Config],
        more: Mapping[str, Any] | None = None,
        *,
        usual: Mapping[str, Any] | None = None,
        section: str = "",
    ) -> Config:
        """Make a configuration.

        Args:
            kind: its class.
            more: path -> value, which replaces what was typed.
            usual: path -> value, which replaces defaults of the class.
            section: the section of the settings that it is made from; "" for what is in no section.

        Raises:
            InvalidInput: a value is invalid.
        """
        if section:
            own = self._settings.get(section, {})
        else:
            own = {name: one for name, one in self._settings.items() if name not in self._sections}
        return from_json(kind, merged(merged(_nested(usual or {}), own), _nested(more or {})))

    def folder(self, name: str) -> Path:
        """Return --out, or else the folder of this name among those of all runs."""
        return self["out"] or Path("knotgym-data") / re.sub(r"[^\w.,-]", "-", name)

    @property
    def run(self) -> RunOptions:
        """The options of the run."""
        return self.config(RunOptions, {"quiet": self.quiet}, section="run")


def _field(sections: Sections, path: str, typed: str = "") -> Option | None:
    """Make the option of a field, such as "task.horizon" or "run.workers"; None if there is none.

    The option has the field's name, or is `typed` otherwise.
    """
    first, _, rest = path.partition(".")
    section, names = (first, rest) if rest and first in sections else ("", path)
    hint: Any = sections.get(section)
    default, help = hint, ""
    for name in names.split("."):
        hints = get_type_hints(hint) if dataclasses.is_dataclass(hint) else {}
        if name not in hints:
            return None
        help = field_help(hint, name)
        known = choices(get_type_hints(hint, include_extras=True)[name])
        if any(not re.search(rf"\b{re.escape(word)}\b", help) for word in known):
            help += f" One of {', '.join(known)}."
        hint, default = hints[name], getattr(default, name, None)
    name = f"--{path.rpartition('.')[2].replace('_', '-')}"
    name += f"/--no-{name[2:]}" if default is True else ""
    return Option(path, typed or name, hint, default, help, is_field=True)


def settings_named(sections: Sections, name: str) -> Iterator[str]:
    """Yield the paths of all fields whose last part is `name`."""

    def below(kind: type, path: str) -> Iterator[str]:
        for field, hint in get_type_hints(kind).items():
            if field == name:
                yield path + field
            if dataclasses.is_dataclass(hint) and isinstance(hint, type):
                yield from below(hint, f"{path}{field}.")

    for section, kind in sections.items():
        yield from below(kind, f"{section}." if section else "")


def _reflowed(doc: str) -> str:
    """Join the lines of each paragraph, which a terminal breaks by its own width.

    >>> _reflowed("One\\nsentence.\\n\\nExamples:\\n\\n    knotgym demo")
    'One sentence.\\n\\nExamples:\\n\\n    knotgym demo'
    """
    return re.sub(r"(?<=\S)\n(?=\S)", " ", doc)


def field_help(kind: type, name: str) -> str:
    """Return the first sentence that the docstring of a class has about a field.

    >>> field_help(RunOptions, "overwrite")
    'Replace an existing output once the new one is complete.'
    """
    hint = get_type_hints(kind, include_extras=True).get(name)
    for one in getattr(hint, "__metadata__", ()):
        if described := getattr(getattr(one, "func", None), "help", None):
            return str(described())
    for one in kind.__mro__:
        if text := _described(inspect.cleandoc(one.__doc__ or ""), "Attributes", name):
            sentence = re.split(r"(?<=\.) (?=[A-Z])", text)[0]
            return sentence[:1].upper() + sentence[1:]
    return ""


def _described(doc: str, heading: str, name: str) -> str:
    """Return what a docstring has about a name under a heading; "" for nothing."""
    section = doc.partition(f"\n{heading}:\n")[2].partition("\n\n")[0]
    for entry in re.split(r"\n(?=    \w)", "\n" + section):
        names, colon, text = entry.strip().partition(": ")
        if colon and name in names.split(", "):
            return " ".join(text.split())
    return ""


def _read_value(value: Any, hint: Any, name: str) -> Any:
    """Convert what was typed to the type of a field.

    Args:
        value: text, a flag or a list of texts; all but text is returned as it is.
        hint: the type.
        name: the option, for messages.

    Raises:
        InvalidInput: the text isn't of this type.

    >>> _read_value("0-2,4", tuple[int, ...], "--nx")
    (0, 1, 2, 4)
    """
    if not isinstance(value, str):
        return value
    if value == "none" and type(None) in get_args(hint):
        return None
    hint = _typed_kind(hint)
    if get_origin(hint) is tuple:
        (kind, *_) = get_args(hint)
        if kind is int:
            return numbers(value, name)
        return tuple(_read_value(word.strip(), kind, name) for word in value.split(","))
    reader, expected = _READERS.get(hint, (str, ""))
    try:
        return reader(value)
    except (KeyError, ValueError):
        raise InvalidInput(f"{name} takes {expected}, got {value!r}") from None


def _typed_kind(hint: Any) -> Any:
    """Return the first type of a union, which is what can be typed."""
    if get_origin(hint) not in (Union, types.UnionType):
        return hint
    return next(one for one in get_args(hint) if one is not type(None))


_READERS: dict[Any, tuple[Callable[[str], Any], str]] = {
    bool: ({"true": True, "false": False}.__getitem__, "true or false"),
    int: (int, "a whole number"),
    float: (float, "a number"),
    Path: (Path, "a path"),
}


def numbers(text: str, name: str = "--nx") -> tuple[int, ...]:
    """Read "3", "2,3" or "0-4".

    Raises:
        InvalidInput: it is none of them, or a number is there twice.

    >>> numbers("0-2,4")
    (0, 1, 2, 4)
    """
    found: list[int] = []
    for word in text.split(","):
        parts = re.fullmatch(r"\s*(\d{1,4})(?:-(\d{1,4}))?\s*", word, re.ASCII)
        if parts is None or int(parts[2] or parts[1]) < int(parts[1]):
            raise InvalidInput(f"{name} takes whole numbers such as 3, 2,3 or 0-4, got {text!r}")
        found += range(int(parts[1]), int(parts[2] or parts[1]) + 1)
    if len(set(found)) < len(found):
        raise InvalidInput(f"{name} takes each number once, got {text!r}")
    return tuple(found)


def as_typed(value: Any) -> str:
    """Return a value as it would be typed, "" for what isn't worth showing.

    >>> as_typed((1, 2, 3)), as_typed((2, 3)), as_typed(None)
    ('1-3', '2,3', '')
    """
    if isinstance(value, bool):
        return "yes" if value else ""
    if not isinstance(value, tuple):
        return "" if value in (None, ...) else str(value)
    if len(value) > 2 and isinstance(value[0], int):
        if value == tuple(range(value[0], value[0] + len(value))):
            return f"{value[0]}-{value[-1]}"
    return ",".join(map(str, value))


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"task": {"nx": 3}} for {"task.nx": 3}."""
    found: dict[str, Any] = {}
    for path, value in values.items():
        for name in reversed(path.split(".")):
            value = {name: value}
        found = merged(found, value)
    return found


def _value_at(settings: Any, path: str) -> Any:
    """Return the value at a path of nested settings; None if there is none."""
    for name in path.split("."):
        settings = settings.get(name) if isinstance(settings, dict) else None
    return settings


def _read_settings(path: Path | None) -> dict[str, Any]:
    """Read a --settings file; an empty dict without one.

    Raises:
        InvalidInput: the file can't be read as TOML or JSON, or isn't an object.
    """
    if path is None:
        return {}
    form = "TOML" if path.suffix == ".toml" else "JSON"
    try:
        if form == "TOML" and path.is_file():
            found = tomllib.loads(path.read_text(encoding="utf-8"))
        else:
            found = read_json(path)
    except (OSError, ValueError) as error:
        raise InvalidInput(f"--settings {path} can't be read as {form}: {error}") from error
    if not isinstance(found, dict):
        raise InvalidInput(f"--settings {path} must hold an object, got {found!r}")
    return found
