"""The entry points of the command line; a user's mistake prints one line, with exit status 2."""

import copy
import errno
import functools
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperCommand, TyperGroup

from knotgym.cli.dataset_commands import dataset_app
from knotgym.cli.demo_commands import compile_kernels, demo
from knotgym.cli.learning_commands import train
from knotgym.cli.options import DerivedCommand
from knotgym.cli.play_command import play
from knotgym.cli.policy_commands import collect, evaluate
from knotgym.cli.prompt_commands import prompt
from knotgym.cli.run_commands import generate, images
from knotgym.cli.selection_commands import delete, import_curves, select, split
from knotgym.cli.suite_command import suite
from knotgym.common.errors import Failed, KnotgymError, printable


class Command(DerivedCommand):
    """A command whose --help shows flags without a type, keeps square brackets and wraps once."""

    def get_params(self, ctx: Any) -> Any:
        return _flags_bare(super().get_params(ctx))

    def format_help(self, ctx: Any, formatter: Any) -> None:
        plain: Any = copy.copy(self)
        plain.params = [copy.copy(one) for one in self.params]
        for part in [plain, *plain.params]:
            unwrapped = re.sub(r"(?<=\S)\n(?=\S)", " ", part.help or "")
            part.help = escape(unwrapped)  # rich would read '.[video]' as a style
        TyperCommand.format_help(plain, ctx, formatter)


class Group(TyperGroup):
    """A group of commands whose --help shows flags without a type."""

    def get_params(self, ctx: Any) -> Any:
        return _flags_bare(super().get_params(ctx))


def _flags_bare(parameters: list[Any]) -> list[Any]:
    for parameter in parameters:
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    return parameters


_HELP: dict[str, Any] = {"context_settings": {"help_option_names": ["-h", "--help"]}}
_APP: dict[str, Any] = {**_HELP, "add_completion": False, "pretty_exceptions_enable": False}

app = typer.Typer(cls=Group, no_args_is_help=True, **_APP)
dataset_app.command()(select)
dataset_app.command()(split)
dataset_app.command()(delete)
dataset_app.command("import")(import_curves)
app.add_typer(dataset_app, name="dataset", cls=Group, **_HELP)
for _command in (demo, generate, collect, suite, train, evaluate, play, images, prompt):
    app.command(cls=Command)(_command)
app.command("compile", cls=Command)(compile_kernels)
for _listed in dataset_app.registered_commands:
    _listed.cls = Command
generate_app = typer.Typer(**_APP)  # knotgym-generate, one command without a name
generate_app.command(cls=Command)(generate)


def _version(given: bool) -> None:
    if given:
        import knotgym

        print(f"knotgym {knotgym.__version__}")
        raise typer.Exit


@app.callback()
def knotgym(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Environments and data for spatial reasoning about knots.

    Examples:

        knotgym demo

        knotgym generate --nx 3 --count 40

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym evaluate --task tie --nx 3 --policy random

        knotgym dataset show knotgym-data/nx3
    """


# ClickException, from Click itself or from the copy that typer bundles
_USAGE: Any = typer.BadParameter.__mro__[2]
_FAILED, _MISTAKEN, _INTERRUPTED = 1, 2, 130
_NO_NAME = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP)
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_OURS = (
    "this is a bug in knotgym: please report it, with the traceback above, in the repository's"
    " issue tracker"
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `knotgym` and exit, with status 0 only if everything requested was done."""
    _run(app, "knotgym", arguments)


def main_generate(arguments: Sequence[str] | None = None) -> None:
    """Run `knotgym-generate`, an alias of `knotgym generate`."""
    _run(generate_app, "knotgym-generate", arguments)


# typer would rebuild every command from its signature at each call
_built = functools.cache(typer.main.get_command)


def _run(command: typer.Typer, name: str, arguments: Sequence[str] | None) -> None:
    stopped = functools.partial(_stopped, command, arguments)
    for number in _SIGNALS:
        signal.signal(number, functools.partial(_interrupt, stopped))
    try:
        result = _built(command)(args=arguments, prog_name=name, standalone_mode=False)
        status = result if isinstance(result, int) else 0
        if status == _INTERRUPTED:  # typer returns this after a KeyboardInterrupt
            _say(stopped(), status)
    except Failed as error:
        status = _say(str(error), _FAILED)
    except _USAGE as error:
        # an empty message means that the help was shown
        status = _say(error.format_message(), _MISTAKEN) if error.format_message() else _MISTAKEN
    except KnotgymError as error:
        status = _say(str(error), _MISTAKEN)
    except BrokenExecutor:
        status = _say(
            "a worker died, perhaps out of memory; --resume continues from the last checkpoint",
            _FAILED,
        )
    except MemoryError:
        status = _say(
            "out of memory, here or in a worker; finished work is kept, --resume continues from"
            " there",
            _FAILED,
        )
    except OSError as error:
        # an impossible file name is the user's mistake
        status = _say(_trouble(error), _MISTAKEN if error.errno in _NO_NAME else _FAILED)
    except (KeyboardInterrupt, typer.Abort):
        status = _say(stopped(), _INTERRUPTED)
    except typer.Exit as ended:
        status = ended.exit_code
    except Exception as error:
        if _interrupted(error):
            status = _say(stopped(), _INTERRUPTED)
        else:
            traceback.print_exc()
            status = _say(_OURS, _FAILED)
    sys.exit(status)


def _interrupted(error: BaseException | None) -> bool:
    """Whether a KeyboardInterrupt caused this; in compiled code, numba makes it a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _stopped(typed: typer.Typer, arguments: Sequence[str] | None) -> str:
    """Return the message of an interrupted command, which mentions --resume if it has one."""
    command: Any = _built(typed)
    for word in sys.argv[1:] if arguments is None else arguments:
        command = getattr(command, "commands", {}).get(word, command)
    resumable = any(parameter.name == "resume" for parameter in command.params)
    goes_on = ", --resume continues from the last checkpoint" if resumable else ""
    return f"interrupted; no partial output is left{goes_on}"


def _interrupt(stopped: Callable[[], str], number: int, frame: object) -> None:
    for one in _SIGNALS:
        signal.signal(one, functools.partial(_end, stopped))
    sys.unraisablehook = functools.partial(_unraisable, stopped)
    raise KeyboardInterrupt


def _unraisable(stopped: Callable[[], str], error: "sys.UnraisableHookArgs") -> None:
    """After an interruption, ignore errors in destructors, but act on a second interruption."""
    if issubclass(error.exc_type, KeyboardInterrupt):
        _end(stopped, 0, None)


def _end(stopped: Callable[[], str], number: int, frame: object) -> None:
    """Exit at once when interrupted again during cleanup.

    Partial output never has its final name, and workers end with their parent.
    """
    shown = "\x1b[?25h" if sys.stderr.isatty() else ""  # the live table hides the cursor
    os.write(2, f"{shown}knotgym: {stopped()}\n".encode())
    os._exit(_INTERRUPTED)


def _trouble(error: OSError) -> str:
    """Return the operating system's message, without what a library adds to it."""
    message = os.strerror(error.errno) if error.errno else str(error)
    return f"{message} {error.filename or ''}"


def _say(text: str, status: int) -> int:
    """Print one line on standard error; return the exit status."""
    if status == _INTERRUPTED:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)  # this is the last line
    print(f"knotgym: {printable(' '.join(text.split()))}", file=sys.stderr)
    return status
