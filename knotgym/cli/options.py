"""Commands from functions and configuration classes.

A command is a function, the configuration classes that it fills, and the fields of these that are
options; cyclopts makes the rest. The function's own parameters are options too, with their types
and defaults, and what its docstring has under Args as help; the help of a field is the first
sentence about it in the docstring of its class. What is typed for fields becomes one tree of JSON
values, with this precedence,

    typed options  >  --set name=value  >  --settings FILE  >  defaults

which the classes validate once. Fields that aren't options are settings: `--set` and `--settings`
reach every field, under the same names.
"""

import dataclasses
import functools
import inspect
import os
import re
import tomllib
import types
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from cyclopts import App, Group, Parameter

from knotgym.common import (
    InvalidInput,
    Mark,
    Occupied,
    choices,
    from_json,
    merged,
    read_json,
    use_plugins,
)
from knotgym.runs import Progress, RunOptions

Config = TypeVar("Config")
Sections = Mapping[str, type]  # of a command's settings; "" is the outermost

_GROUP, _RUN_GROUP = (Group.create_ordered(name) for name in ("Options", "How it is run"))
APP: dict[str, Any] = {
    "help_format": "plaintext",
    "version_flags": [],
    "suppress_keyboard_interrupt": False,
    "default_parameter": Parameter(
        negative=(), group=_GROUP, show_default=lambda value: as_typed(value) or None
    ),
}
EXISTING = "run.resume run.restart run.overwrite"
RUN = f"seed run.workers {EXISTING}"  # options of every command that makes data
Listed = Annotated[str | None, Parameter(metavar="A,B")]
Numbers = Annotated[str | None, Parameter(metavar="N,N")]
_of_run = functools.partial(Parameter, group=_RUN_GROUP)
DrawSeed = Annotated[int, _of_run(help="Seed of the random choice.")]
_QUIET = Annotated[bool, Parameter(show=False, help="Print results and errors only.")]
_PLUGIN_HELP = "Module that registers tasks or other kinds when imported; may be repeated."
_PLUGIN = Annotated[list[str] | None, _of_run(metavar="MODULE", help=_PLUGIN_HELP)]
_SET_HELP = "One setting, such as task.horizon=30; may be repeated."
_SET = Annotated[list[str] | None, _of_run(metavar="NAME=VALUE", help=_SET_HELP)]
_SETTINGS = Annotated[Path | None, _of_run(help="TOML or JSON file of settings.")]
_METAVARS = {int: "INT", float: "FLOAT", tuple[int, ...]: "N,N", tuple[str, ...]: "A,B"}
_TRUTH = {"true": True, "false": False}
_READERS: dict[Any, Any] = {bool: _TRUTH.__getitem__, int: int, float: float}


class _Field(NamedTuple):
    """A field of a configuration.

    Attributes:
        path: such as "task.horizon", after its section's name.
        name: the last part of the path.
        owner: the class that it is of.
        kind: type of its value.
        default: its default.
    """

    path: str
    name: str
    owner: type
    kind: Any
    default: Any


def _option(field: _Field, typed: str) -> inspect.Parameter:
    """Return the option that sets a field, as cyclopts reads it; it takes text, or is a flag.

    Args:
        field: that is set.
        typed: such as "--horizon" or "--keep/--drop"; "" for the field's name.
    """
    usual = f"--{field.name.replace('_', '-')}"
    usual += f"/--no-{usual[2:]}" if field.default is True else ""
    name, _, negative = (typed or usual).partition("/")
    help = field_help(field.owner, field.name)
    known = choices(get_type_hints(field.owner, include_extras=True)[field.name])
    if any(not re.search(rf"\b{re.escape(word)}\b", help) for word in known):
        help += f" One of {', '.join(known)}."
    info = Parameter(
        name=name,
        metavar=_METAVARS.get(_typed_kind(field.kind)),
        help=help,
        negative=negative,
        group=_RUN_GROUP if field.path.startswith("run.") or field.path == "seed" else _GROUP,
        show_default=as_typed(field.default) or False,
    )
    kind = bool if field.kind is bool else str
    name, hint = field.path.replace(".", "__"), Annotated[kind | None, info]
    how = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, how, default=None, annotation=hint)


def command(
    sections: Sections, fields: str, *, lines: bool = True
) -> Callable[[Callable[..., None]], App]:
    """Make a function a command; its first parameter is what was `Given` for the fields.

    Args:
        sections: the configuration classes. The class "" is the command's own; the settings of
            another are in a section of its name, such as `policy.noise`.
        fields: the fields that are options, separated by spaces; `tasks=--task` renames one.
        lines: see `Progress`.
    """
    sections = {**sections, "run": RunOptions}
    known = {field.path: field for field in _all_fields(sections)}
    words = (word.partition("=") for word in fields.split())
    options = [_option(known[path], typed) for path, _, typed in words]

    def _declare(function: Callable[..., None]) -> App:
        declared = dict([*inspect.signature(function).parameters.items()][1:])

        def _run(
            *words: Any,
            quiet: _QUIET = False,
            plugin: _PLUGIN = None,
            settings: _SETTINGS = None,
            set: _SET = None,
            **values: Any,
        ) -> None:
            use_plugins(plugin or ())
            for name in ("out", "record", "video", "overlay"):
                _require_apart(values.get(name), [settings, *words, *values.values()], name)
            mine = {name: values.pop(name) for name in declared if name in values}
            typed = {name.replace("__", "."): value for name, value in values.items()}
            with Progress(quiet, lines=lines) as progress:
                tree = _read_settings(settings, sections)
                for path, value in (*map(_assigned, set or ()), *typed.items()):
                    kind = known[path].kind if path in known else str
                    tree = merged(tree, _nested({path: _read_value(value, kind, path)}))
                function(Given(tree, known, sections, progress), *words, **mine)
                progress.say_seconds()

        common = inspect.signature(_run).parameters
        parameters = [*declared.values(), *options, common["quiet"], common["plugin"]]
        parameters += [common["settings"], common["set"]] if "" in sections else []
        # a terminal breaks paragraphs and entries by its own width
        doc = _run.__doc__ = re.sub(r"\n {8,}", " ", inspect.cleandoc(function.__doc__ or ""))
        _run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        signature = inspect.Signature(parameters)
        vars(_run).update(sections=sections, known=known, __signature__=signature)
        help = re.sub(r"(?<=\S)\n(?=\S)", " ", doc.partition("\n\nArgs:\n")[0]).partition("\n\n")
        name = function.__name__.rstrip("_").replace("_", "-")
        app = App(name=name, help=help[0], help_epilogue=help[2], **APP)
        app.default(_run)
        return app

    return _declare


def _assigned(word: str) -> tuple[str, str]:
    path, sign, text = word.partition("=")
    if not sign:
        raise InvalidInput(f"--set takes name=value, such as task.horizon=30, got {word!r}")
    return path, text


@dataclasses.dataclass(frozen=True)
class Given:
    """What was typed or set for the fields of a command, and where it shows what it does.

    Attributes:
        settings: what was typed or set, as nested JSON.
        known: path -> field, of all that can be set.
        sections: as of `command`.
        progress: the progress display.
    """

    settings: dict[str, Any]
    known: Mapping[str, _Field]
    sections: Sections
    progress: Progress

    def has(self, path: str) -> bool:
        """Return whether a field was typed or set."""
        return self._at(path) is not None

    def get(self, path: str) -> Any:
        """Return a field as JSON: what was typed or set, else its default; not yet validated."""
        value = self._at(path)
        return self.known[path].default if value is None else value

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
            tree = self.settings.get(section, {})
        else:
            tree = {k: v for k, v in self.settings.items() if k not in self.sections}
        above = _nested(more or {})
        # `above` would replace what isn't an object, and nobody would notice
        base = tree if isinstance(tree, Mapping) else {}
        inner = {k: base.get(k, {}) for k, v in above.items() if isinstance(v, dict)}
        for name, part in {section: tree, **inner}.items():
            if not isinstance(part, Mapping):
                path = next(path for path in self.known if path.startswith(f"{name}."))
                raise InvalidInput(
                    f"{name} is a section of settings, such as {path}=; got {part!r}"
                )
        return from_json(kind, merged(merged(_nested(usual or {}), tree), above))

    @property
    def run(self) -> RunOptions:
        """The options of the run."""
        return self.config(RunOptions, {"quiet": self.progress.quiet}, section="run")

    @staticmethod
    def folder(out: Path | None, name: str) -> Path:
        """Return --out, or else the folder of this name among those of all runs."""
        return out or Path("knotgym-data") / re.sub(r"[^\w.,-]", "-", name)

    def summarize(self, named: str) -> None:
        """Print what a dataset, or the output of a command, holds."""
        from knotgym.cli.inspection import print_summary  # the simulator

        print_summary(named, self.progress.console)

    def _at(self, path: str) -> Any:
        value: Any = self.settings
        for name in path.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        return value


def _all_fields(sections: Sections) -> Iterator[_Field]:
    """Yield the fields of all sections, and those of the configurations in them."""

    def _below(kind: type, path: str, defaults: Any) -> Iterator[_Field]:
        hints = get_type_hints(kind)
        for name, hint in ((field.name, hints[field.name]) for field in dataclasses.fields(kind)):
            default = getattr(defaults, name, None)
            yield _Field(f"{path}{name}", name, kind, hint, default)
            if dataclasses.is_dataclass(hint) and isinstance(hint, type):
                yield from _below(hint, f"{path}{name}.", hint if default is None else default)

    for section, kind in sections.items():
        yield from _below(kind, f"{section}." if section else "", kind)


def field_help(kind: type, name: str) -> str:
    """Return the first sentence that the docstring of a class has about a field.

    >>> field_help(RunOptions, "overwrite")
    'Replace an existing output once the new one is complete.'
    """
    hint = get_type_hints(kind, include_extras=True).get(name)
    for mark in getattr(hint, "__metadata__", ()):
        if described := getattr(getattr(mark, "func", None), "help", None):
            return str(described())
    for base in kind.__mro__:
        doc = inspect.cleandoc(base.__doc__ or "").partition("\nAttributes:\n")[2]
        for entry in re.split(r"\n(?=    \w)", "\n" + doc.partition("\n\n")[0]):
            names, _, text = " ".join(entry.split()).partition(": ")
            if name in names.split(", "):
                sentence = re.split(r"(?<=\.) (?=[A-Z])", text)[0]
                return sentence[:1].upper() + sentence[1:]
    return ""


def _require_apart(out: Any, values: Iterable[Any], name: str) -> None:
    """Raise Occupied if an output is a file or folder that something else that was typed names."""
    texts = (text for value in values for text in (value if isinstance(value, list) else [value]))
    for text in texts if isinstance(out, Path) and os.path.exists(out) else ():
        if text is not out and isinstance(text, (str, Path)) and os.path.exists(text):
            if os.path.samefile(text, out):
                raise Occupied(f"--{name} {out} is what the command reads; choose another")


def _read_value(value: Any, hint: Any, name: str) -> Any:
    """Convert text to the type of a field; what isn't of it stays text, which its class refuses.

    >>> _read_value("0-2,4", tuple[int, ...], "nx"), _read_value("3", int | None, "sample")
    ((0, 1, 2, 4), 3)
    """
    if not isinstance(value, str) or (value == "none" and type(None) in get_args(hint)):
        return None if value == "none" else value
    kind = _typed_kind(hint)
    if kind == tuple[int, ...]:
        return numbers(value, f"--{name.rpartition('.')[2].replace('_', '-')}")
    if get_origin(kind) is tuple:
        return [_read_value(word.strip(), get_args(kind)[0], name) for word in value.split(",")]
    try:
        return _READERS.get(kind, str)(value)
    except (KeyError, ValueError):
        return value


def _typed_kind(hint: Any) -> Any:
    """Return the first type of a union, which is what can be typed."""
    if get_origin(hint) not in (Union, types.UnionType):
        return hint
    return next(kind for kind in get_args(hint) if kind is not type(None))


def numbers(text: str, name: str = "--nx") -> tuple[int, ...]:
    """Read "3", "2,3" or "0-4".

    Raises:
        InvalidInput: it is none of them, or a number is there twice.

    >>> numbers("0-2,4")
    (0, 1, 2, 4)
    """
    listed: list[int] = []
    for word in text.split(","):
        parts = re.fullmatch(r"\s*(\d{1,4})(?:-(\d{1,4}))?\s*", word, re.ASCII)
        if parts is None or int(parts[2] or parts[1]) < int(parts[1]):
            raise InvalidInput(f"{name} takes whole numbers such as 3, 2,3 or 0-4, got {word!r}")
        listed += range(int(parts[1]), int(parts[2] or parts[1]) + 1)
    if len(set(listed)) < len(listed):
        twice = Counter(listed).most_common(1)[0][0]
        raise InvalidInput(f"{name} takes each number once, got {twice} twice")
    return tuple(listed)


def as_typed(value: Any) -> str:
    """Return a value as it would be typed, "" for what isn't worth showing.

    >>> as_typed((1, 2, 3)), as_typed((2, 3)), as_typed(None)
    ('1-3', '2,3', '')
    """
    if isinstance(value, bool):
        return "yes" if value else ""
    if not isinstance(value, tuple):
        return "" if value is None else str(value)
    if len(value) > 2 and isinstance(value[0], int):
        if value == tuple(range(value[0], value[0] + len(value))):
            return f"{value[0]}-{value[-1]}"
    return ",".join(map(str, value))


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"task": {"nx": 3}} for {"task.nx": 3}."""
    nested: dict[str, Any] = {}
    for path, value in values.items():
        for name in reversed(path.split(".")):
            value = {name: value}
        nested = merged(nested, value)
    return nested


def _read_settings(path: Path | None, sections: Sections) -> dict[str, Any]:
    """Read a --settings file; an empty dict without one.

    Raises:
        InvalidInput: the file can't be read as TOML or JSON, isn't an object, or sets what must be
            typed.
    """
    if path is None:
        return {}
    form = "TOML" if path.suffix == ".toml" else "JSON"
    with InvalidInput.instead(f"--settings {path} can't be read as {form}", OSError, ValueError):
        is_toml = form == "TOML" and path.is_file()
        tree: Any = tomllib.loads(path.read_text("utf-8")) if is_toml else read_json(path)
    if not isinstance(tree, dict):
        raise InvalidInput(f"--settings {path} must hold an object, got {tree!r}")
    for section, kind in sections.items():
        for field, _, text in Mark.fields(kind, tree.get(section) if section else tree, "typed"):
            if text is not None:
                name = f"{section}.{field}".strip(".")
                raise InvalidInput(
                    f"a settings file may not set {name}, which reaches the network or names"
                    f" code: type --set {name}=... if you mean it"
                )
    return tree
