"""The table of commands, and the entry points of the command line.

An entry point of the group `knotgym.commands` names a package, such as `knotgym.learn`, whose
`commands.toml` has a table for each of its commands:

    [commands.train]
    summary = "Train a policy."      # a line of `knotgym --help`
    module = "train_command"         # of the package, where the function `train` is; the default
    resumes = true                   # whether it takes --resume after an interruption

The file is read without importing the package; a command's module is imported when it is typed.

A user's mistake prints one line, with exit status 2.
"""

import errno
import functools
import os
import signal
import sys
import tomllib
import traceback
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from types import FrameType
from typing import Any, NamedTuple

from cyclopts import App, CycloptsError, UnknownOptionError, UnusedCliTokensError

from knotgym import __version__
from knotgym.common import Failed, InvalidInput, KnotgymError, one_line

GROUP = "knotgym.commands"
_FILE, _OWN = "commands.toml", "knotgym.cli"
_FAILED, _MISTAKEN, _INTERRUPTED = 1, 2, 130
_NO_NAME = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP)
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_KEPT = (
    "finished work, if any, is kept in the hidden folder .NAME.partial beside the output NAME: run"
    " the same command with --resume to go on, or with --restart to delete it and begin again"
)
_OURS = (
    "this is a bug in knotgym: please report it, with the traceback above, in the repository's"
    " issue tracker"
)


class Command(NamedTuple):
    """A command: its line of help, where its function is, and whether --resume continues it."""

    summary: str
    target: str
    resumes: bool = False


@cache
def _command_texts(package: str = _OWN) -> dict[str, Any]:
    """Return a package's commands.toml; nothing of one that isn't there."""
    spec = find_spec(package)  # which imports only what the package is in
    folders = spec.submodule_search_locations if spec else None
    if not folders:  # a guest whose entry point was installed, but which isn't there
        return {}
    return tomllib.loads(Path(folders[0], _FILE).read_text("utf-8"))


@cache
def packages() -> tuple[str, ...]:
    """Return the packages that bring commands, this room first.

    Raises:
        InvalidInput: one that an entry point names has no readable table.
    """
    named = [_OWN]
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.value):
        said = f"the commands of entry point {entry.name} = {entry.value} can't be loaded"
        with InvalidInput.instead(said, ImportError, OSError, ValueError):
            _command_texts(entry.value)
        named.append(entry.value)
    return tuple(dict.fromkeys(named))


@cache
def commands() -> dict[str, Command]:
    """Return the commands by name.

    Raises:
        InvalidInput: two packages bring a command of one name.
    """
    table: dict[str, Command] = {}
    for package in packages():
        for name, row in _command_texts(package).get("commands", {}).items():
            if name in table:
                raise InvalidInput(f"{package} brings a command {name!r}, which there is already")
            module = f"{package}.{row.get('module', f'{name}_command')}"
            table[name] = Command(row["summary"], f"{module}:{name}", row.get("resumes", False))
    return table


def shown(named: str) -> Any:
    """Return what a package shows of a folder that only it knows: facts and rows, or None."""
    for package in packages():
        if function := _command_texts(package).get("shows"):
            if facts := resolve_name(f"{package}.{function}")(named):
                return facts
    return None


def application() -> App:
    """Make the application `knotgym`."""
    app = App(
        name="knotgym",
        help=_command_texts()["help"],
        help_epilogue=_command_texts()["epilogue"],
        help_format="plaintext",
        suppress_keyboard_interrupt=False,
        version=f"knotgym {__version__}",
    )
    for name, command in commands().items():
        app.command(command.target, name=name, help=command.summary)
    return app


def main_generate() -> None:
    """Run `knotgym-generate`, the same as `knotgym generate`."""
    main(["generate", *sys.argv[1:]])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `knotgym` and exit, with status 0 only if everything requested was done."""
    tokens = sys.argv[1:] if arguments is None else [*arguments]
    goes_on = stopped = ""
    try:
        # no path has a meaning in a folder that was deleted
        with InvalidInput.instead("the current folder is gone: change to another", OSError):
            os.getcwd()
        typed = commands().get(tokens[0]) if tokens else None
        goes_on = f"; {_KEPT}" if typed and typed.resumes else ""
        stopped = f"interrupted before all output was written{goes_on}"
        for number in _SIGNALS:
            signal.signal(number, functools.partial(_interrupt, stopped))
        status = application()(
            tokens, print_error=False, exit_on_error=False, result_action="return_value"
        )
        status = status if isinstance(status, int) else 0
    except CycloptsError as error:
        status = _say(_mistake(error), _MISTAKEN)
    except KnotgymError as error:
        status = _say(str(error), _FAILED if isinstance(error, Failed) else _MISTAKEN)
    except (BrokenExecutor, MemoryError):
        status = _say(f"a worker died or memory ran out{goes_on}", _FAILED)
    except OSError as error:
        # the system's message, without what a library adds; an impossible name is a mistake
        message = os.strerror(error.errno) if error.errno else str(error)
        is_mistake = error.errno in _NO_NAME
        status = _say(f"{message} {error.filename or ''}", _MISTAKEN if is_mistake else _FAILED)
    except KeyboardInterrupt:
        status = _say(stopped, _INTERRUPTED)
    except Exception as error:
        if _interrupted(error):
            status = _say(stopped, _INTERRUPTED)
        else:
            traceback.print_exc()
            status = _say(_OURS, _FAILED)
    sys.exit(status)


def _mistake(error: CycloptsError) -> str:
    """Say what is wrong with a command line; a setting typed as an option is said to be one."""
    error.verbose = False
    if isinstance(error, UnknownOptionError):
        typed = error.token.keyword or ""
        name = typed.partition("=")[0].removeprefix("--").removeprefix("no-").replace("-", "_")
        known = getattr(error.target, "known", ())  # all that can be set, see `options.command`
        if paths := [path for path in known if path.rpartition(".")[2] == name]:
            ways = " or ".join(f"--set {path}=..." for path in paths)
            return f"{typed.partition('=')[0]} is a setting: {ways}"
    if isinstance(error, UnusedCliTokensError):
        many = " ".join(error.unused_tokens or [])
        return f"a word too many: {many}; several values are one word, such as 2,3"
    return str(error)


def _interrupted(error: BaseException | None) -> bool:
    """Whether a KeyboardInterrupt caused this; in compiled code, numba makes it a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _interrupt(stopped: str, number: int, frame: FrameType | None) -> None:
    for signal_number in _SIGNALS:
        signal.signal(signal_number, functools.partial(_end, stopped))
    sys.unraisablehook = functools.partial(_unraisable, stopped)
    raise KeyboardInterrupt


def _unraisable(stopped: str, error: "sys.UnraisableHookArgs") -> None:
    """After an interruption, ignore errors in destructors, but act on a second interruption."""
    if issubclass(error.exc_type, KeyboardInterrupt):
        _end(stopped, 0, None)


def _end(stopped: str, number: int, frame: FrameType | None) -> None:
    """Exit at once when interrupted again during cleanup.

    Partial output never has its final name, and workers end with their parent.
    """
    shown = "\x1b[?25h" if sys.stderr.isatty() else ""  # the live table hides the cursor
    os.write(2, f"{shown}knotgym: {stopped}\n".encode())
    os._exit(_INTERRUPTED)


def _say(text: str, status: int) -> int:
    """Print one line on standard error; return the exit status."""
    if status == _INTERRUPTED:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)  # this is the last line
    print(f"knotgym: {one_line(text)}", file=sys.stderr)
    return status
