"""The errors of this package. A class is for a caller who would catch it; the sentence stands where
it is raised.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class KnotgymError(Exception):
    """An error that the caller can fix.

    The message is one line: what was wrong, what was given, and what was expected.
    """

    @classmethod
    @contextmanager
    def instead(cls, said: str, *caught: type[BaseException]) -> Iterator[None]:
        """Raise this error in place of others, with a sentence and what theirs say."""
        try:
            yield
        except caught as error:
            raise cls(f"{said}: {one_line(error)}") from error

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the finished message, so that unpickling doesn't call the subclass's __init__."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class InvalidInput(KnotgymError, ValueError):
    """An argument, option, setting, code or array that isn't valid."""


class InvalidFile(KnotgymError, ValueError):
    """A file isn't what it should be: corrupted, of another format, harmful or a link."""


class MissingFile(KnotgymError, FileNotFoundError):
    """The file or dataset doesn't exist."""


class Occupied(KnotgymError, FileExistsError):
    """The output exists, or another process uses it."""


class InvalidPolicy(KnotgymError, ValueError):
    """A policy doesn't exist, doesn't fit the task, raised an error or gave invalid actions."""


class Failed(KnotgymError, RuntimeError):
    """The request was valid, but what it asked for could not be made, or not all of it."""


class MissingExtra(KnotgymError, ImportError):
    """An optional dependency isn't installed."""

    def __init__(self, needed: str, how: str, user: str = "this") -> None:
        """Say how to install it.

        Args:
            needed: the dependency.
            how: an extra of this package, or else the whole command.
            user: what needs it.
        """
        # from a checkout: in the package index, the name belongs to the published KnotGym
        how = how if " " in how else f"pip install '.[{how}]'"
        super().__init__(f"{user} needs {needed}, which isn't installed; install it: {how}")

    @classmethod
    def imported(cls, module: str, how: str, user: str = "this") -> Any:
        """Import an optional module; raise this error, with its arguments, if it isn't installed.

        A checkout of knotgym has a link `datasets` at its top, which would shadow Hugging Face's
        `datasets` when Python runs from there, so such entries of `sys.path` are skipped.
        """
        if loaded := sys.modules.get(module):
            return loaded
        searched, link = list(sys.path), ("knotgym", module)
        sys.path[:] = [
            place for place in searched if (Path(place) / module).resolve().parts[-2:] != link
        ]
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise cls(str(error.name), how, user) from error
        finally:
            sys.path[:] = searched


def one_line(said: object) -> str:
    r"""Return text or an error's message on one line, so that it can't send commands to a terminal.

    >>> print(one_line("a" + chr(27) + "[2J"))
    a\x1b[2J
    """
    text = " ".join(str(said).split())
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
