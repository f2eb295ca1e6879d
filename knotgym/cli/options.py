"""Command-line options derived from the configuration dataclasses that they set.

The help of an option is the first sentence about its field in the Attributes section of the class,
its default the field's default, and its type the field's type. A configuration checks its own
values. Options are made when their command is typed, because configurations import the simulator.
"""

import inspect
import re
import tomllib
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from typer.core import TyperCommand

from knotgym.common.configuration import from_json, read_json
from knotgym.common.errors import InvalidInput
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import RunOptions
from knotgym.runs.shards import Shard

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ENVIRONMENT, ACTING, RUN = "The environment", "Who acts", "How it is run"
TASK = (
    "task.states task.observation task.action task.max_goals task.image_size task.views"
    " task.depth task.horizon task.hold task.endless task.tow_limit task.reset_noise task.engine"
    " task.beads task.integrator_steps task.camera"
)  # what collect and evaluate let users set of the environment
EXECUTION, EXISTING = "workers executor scheduler settings", "resume restart overwrite quiet"
Config = TypeVar("Config", bound="DataclassInstance")


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option or an argument of a command.

    Attributes:
        path: field of the configuration that it sets, such as "task.horizon"; or any name.
        help: its help text.
        names: what is typed, such as "--horizon"; "" for an argument.
        kind: type of the value, for typer.
        default: value if it isn't typed, in the form in which it would be.
        group: heading in --help; "" for the first.
        read: converts what was typed to the field's type; called with the value and `names`.
        of_config: whether it sets a field of the configuration.
        metavar, show_default: see `typer.Option`.
    """

    path: str
    help: str
    names: str = ""
    kind: Any = str
    default: Any = None
    group: str = ""
    read: Callable[[Any, str], Any] | None = None
    of_config: bool = False
    metavar: str | None = None
    show_default: bool | str = True

    def parameter(self) -> inspect.Parameter:
        """Return it as a parameter of a function, as typer reads it."""
        kind = self.kind | None if self.default is None else self.kind
        if self.names:
            info: Any = typer.Option(
                self.names,
                help=self.help,
                rich_help_panel=self.group or None,
                show_default=self.show_default,
            )
        else:
            info = typer.Argument(help=self.help, metavar=self.metavar)
        empty = inspect.Parameter.empty
        return inspect.Parameter(
            self.path.replace(".", "__"),
            inspect.Parameter.KEYWORD_ONLY,
            default=empty if self.default is Ellipsis else self.default,
            annotation=Annotated[kind, info],
        )


def options_of(
    config: Any, paths: str, group: str = "", **changed: Mapping[str, Any]
) -> list[Option]:
    """Return an option for each field of a configuration that `paths` names.

    Args:
        config: the configuration with its defaults.
        paths: fields, separated by spaces; those of nested configurations as "task.horizon".
        group: heading in --help.
        changed: last part of a path -> attributes of `Option` that differ from the derived ones.
    """
    found = []
    for path in paths.split():
        *outer, name = path.split(".")
        owner = config
        for step in outer:
            owner = getattr(owner, step)
        kind, read = _kind_and_reader(get_type_hints(type(owner))[name])
        value = getattr(owner, name)
        typed, dashed = _as_typed(value), name.replace("_", "-")
        option = Option(
            path=path,
            names=f"--{dashed}/--no-{dashed}" if value is True else f"--{dashed}",
            help=field_help(type(owner), name),
            kind=kind,
            default=typed if read or not isinstance(value, tuple) else None,
            group=group,
            read=read,
            of_config=True,
        )
        found.append(replace(option, **changed.get(name, {})))
    return found


def option(
    name: str, kind: Any, help: str, default: Any = None, group: str = "", **more: Any
) -> Option:
    """Return an option that is no field of the configuration; `name` is as typed."""
    path = name.removeprefix("--").replace("-", "_")
    return Option(path=path, names=name, kind=kind, help=help, default=default, group=group, **more)


def run_options(names: str) -> list[Option]:
    """Return options of a run, see `RunOptions`; and `settings`, a file of the configuration."""
    shard = {"kind": str, "default": "", "read": lambda text, _: Shard.parse(text)}
    fields = names.replace("settings", "")
    found = {
        one.path: replace(one, of_config=False)
        for one in options_of(RunOptions(), fields, RUN, shard=shard)
    }
    found["settings"] = option(
        "--settings",
        Path,
        "JSON or TOML file with more settings, using the names of `config` in manifest.json;"
        " options that are typed take precedence.",
        group=RUN,
    )
    return [found[name] for name in names.split()]


def field_help(kind: type, name: str) -> str:
    """Return the first sentence that the docstring of a class has about a field.

    >>> field_help(RunOptions, "overwrite")
    'Replace an existing output once the new one is complete.'
    """
    for one in kind.__mro__:
        section = inspect.cleandoc(one.__doc__ or "").partition("\nAttributes:\n")[2]
        for entry in re.split(r"\n(?=    \w)", "\n" + section.partition("\n\n")[0]):
            names, colon, text = entry.strip().partition(": ")
            if colon and name in names.split(", "):
                sentence = re.split(r"(?<=\.) (?=[A-Z])", " ".join(text.split()))[0]
                return sentence[:1].upper() + sentence[1:]
    return ""


def _flag(name: str) -> Any:
    help = field_help(RunOptions, name)
    return typer.Option(f"--{name}", help=help, rich_help_panel=RUN)


OverwriteOption = Annotated[bool, _flag("overwrite")]
QuietOption = Annotated[bool, _flag("quiet")]


class Given:
    """What was typed for a command.

    Attributes:
        progress: the progress display, which is shown already.
    """

    def __init__(self, context: typer.Context, options: Sequence[Option]) -> None:
        self.progress: Progress = context.obj
        self._options = {option.path: option for option in options}
        self._values: dict[str, Any] = {}
        self.typed: set[str] = set()  # paths of the options that aren't left at their default
        for path in self._options:
            name = path.replace(".", "__")
            self._values[path] = context.params[name]
            source = context.get_parameter_source(name)
            if source is not None and source.name != "DEFAULT":
                self.typed.add(path)

    def __getitem__(self, path: str) -> Any:
        """Return the value of an option, converted to the type of its field."""
        option, value = self._options[path], self._values[path]
        return value if option.read is None or value is None else option.read(value, option.names)

    def text(self, path: str) -> Any:
        """Return an option as it was typed."""
        return self._values[path]

    def config(
        self,
        kind: type[Config],
        more: Mapping[str, Any] | None = None,
        *,
        usual: Mapping[str, Any] | None = None,
        under: str = "",
    ) -> Config:
        """Make a configuration of what was typed, else of a --settings file, else of defaults.

        Args:
            kind: class of the configuration; options that it has no field for are ignored.
            more: path -> value, which replaces what was typed.
            usual: path -> value, which replaces defaults of the class.
            under: the fields have this prefix, and there is no --settings file for them.

        Raises:
            KnotgymError: a value is invalid.
        """
        known = {field.name for field in fields(kind)}
        typed = {
            path.removeprefix(under): self[path]
            for path, option in self._options.items()
            if path in self.typed and option.of_config and path.startswith(under)
        }
        typed = {path: value for path, value in typed.items() if path.split(".")[0] in known}
        settings = _nested(usual or {})
        for values in (self.settings if not under else {}, _nested({**typed, **(more or {})})):
            settings = _merged(settings, values)
        return from_json(kind, settings)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The content of the --settings file."""
        return read_settings(self._values.get("settings"))

    @property
    def run(self) -> RunOptions:
        """The options of the run."""
        names = "workers executor scheduler shard resume restart overwrite quiet".split()
        return RunOptions(**{name: self[name] for name in names if name in self._options})


class Declared(NamedTuple):
    """A command with derived options.

    Attributes:
        function: what it does.
        options: return its options; may import anything.
        lines: see `Progress`.
    """

    function: Callable[[Given], None]
    options: Callable[[], list[Option]]
    lines: bool


def command(
    options: Callable[[], list[Option]], *, lines: bool = True
) -> Callable[[Callable[[Given], None]], Callable[[], None]]:
    """Declare a function as a command with derived options, to be registered with typer."""

    def declare(function: Callable[[Given], None]) -> Callable[[], None]:
        def placeholder() -> None: ...

        placeholder.__name__, placeholder.__doc__ = function.__name__, function.__doc__
        vars(placeholder)["declared"] = Declared(function, options, lines)
        return placeholder

    return declare


class DerivedCommand(TyperCommand):
    """A typer command whose options are made when they are needed.

    The progress display starts first, because making them imports the simulator.
    """

    _made: list[Option]
    _params: list[Any]

    @property
    def _declared(self) -> Declared | None:
        return getattr(self.callback, "declared", None)

    @property
    def params(self) -> list[Any]:
        if self._declared is not None and not self._params:
            self._made = self._declared.options()
            app = typer.Typer(add_completion=False)

            def typed(**_: Any) -> None: ...

            parameters = [option.parameter() for option in self._made]
            vars(typed)["__signature__"] = inspect.Signature(parameters)
            typed.__annotations__ = {one.name: one.annotation for one in parameters}
            app.command()(typed)
            self._params = list(typer.main.get_command(app).params)
        return self._params

    @params.setter
    def params(self, value: list[Any]) -> None:
        self._params = value

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if self._declared is not None and not {"--help", "-h"} & set(args):
            progress = Progress("--quiet" in args, lines=self._declared.lines)
            ctx.obj = ctx.with_resource(progress)
        try:
            return list(super().parse_args(ctx, args))
        except BaseException:
            ctx.close()
            raise

    def invoke(self, ctx: Any) -> Any:
        if self._declared is None:
            return super().invoke(ctx)
        return self._declared.function(Given(ctx, self._made))


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"task": {"nx": 3}} for {"task.nx": 3}."""
    found: dict[str, Any] = {}
    for path, value in values.items():
        *outer, name = path.split(".")
        inner = found
        for step in outer:
            inner = inner.setdefault(step, {})
        inner[name] = value
    return found


def _merged(first: dict[str, Any], last: dict[str, Any]) -> dict[str, Any]:
    """Return a nested dict with the values of both, the last one's where both have one."""
    found = {**first, **last}
    for name in first.keys() & last.keys():
        if isinstance(first[name], dict) and isinstance(last[name], dict):
            found[name] = _merged(first[name], last[name])
    return found


def numbers(text: str, name: str = "--nx") -> tuple[int, ...]:
    """Read "3", "2,3" or "0-4".

    >>> numbers("0-2,4")
    (0, 1, 2, 4)
    """
    out: list[int] = []
    for word in text.split(","):
        low, dash, high = word.strip().partition("-")
        if (
            not low.isdecimal()
            or (dash and not high.isdecimal())
            or len(word.strip()) > 9
            or (dash and int(high) < int(low))
            or max(len(low), len(high)) > 4
        ):
            raise typer.BadParameter(
                f"{name} takes whole numbers such as 3, 2,3 or 0-4, got {text!r}"
            )
        out += range(int(low), int(high if dash else low) + 1)
    if len(set(out)) < len(out):
        raise typer.BadParameter(f"{name} takes each number once, got {text!r}")
    return tuple(out)


def words(text: str, name: str = "") -> tuple[str, ...]:
    """Split "tie,unknot" at its commas and drop duplicates."""
    return tuple(dict.fromkeys(listed(text, name)))


def default_folder(name: str, *marks: str) -> Path:
    """Return the output folder used without --out: a name and marks for non-default settings.

    >>> print(default_folder("nx3", "3_1", "", "seed1"))
    knotgym-data/nx3-3_1-seed1
    """
    return Path("knotgym-data") / "-".join([name.replace(" ", ""), *filter(None, marks)])


def read_settings(path: Path | None) -> dict[str, Any]:
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


def listed(text: str, name: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(","))


def _floats(text: str, name: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{name} takes comma-separated numbers, got {text!r}") from None


_LISTS: dict[type, Callable[[str, str], tuple[Any, ...]]] = {
    int: numbers,
    float: _floats,
    str: listed,
}


def _kind_and_reader(hint: Any) -> tuple[Any, Callable[[str, str], Any] | None]:
    """Return the type that typer parses for a field, and what converts it further."""
    if get_origin(hint) in (Union, types.UnionType):
        (hint,) = (one for one in get_args(hint) if one is not type(None))
    if get_origin(hint) is tuple:
        return str, _LISTS[get_args(hint)[0]]
    return hint, None


def _as_typed(value: Any) -> Any:
    """Return a field's value as it would be typed: (0, 1, 2) is "0-2", ("a", "b") is "a,b"."""
    if not isinstance(value, tuple):
        return value
    is_range = (
        len(value) > 2
        and isinstance(value[0], int)
        and value == tuple(range(value[0], value[-1] + 1))
    )
    return f"{value[0]}-{value[-1]}" if is_range else ",".join(map(str, value))
