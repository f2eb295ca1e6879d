"""The errors of this package. A class is for a caller who would catch it; the sentence stands where
it is raised.
"""

from typing import Any


class KnotgymError(Exception):
    """An error that the caller can fix.

    The message is one line: what was wrong, what was given, and what was expected.
    """

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


def install_command(extra: str) -> str:
    """Return the command that installs an optional extra from a checkout.

    It doesn't install from the package index, where the name belongs to the published KnotGym.

    >>> install_command("learn")
    "pip install '.[learn]'"
    """
    return f"pip install '.[{extra}]'"


class MissingExtra(KnotgymError, ImportError):
    """An optional dependency, `needed` by `user`, isn't installed; `how` is the command for it."""

    def __init__(self, needed: str, how: str, user: str = "this") -> None:
        super().__init__(f"{user} needs {needed}, which isn't installed; install it: {how}")


def one_line(error: BaseException) -> str:
    """Return an error's message on one line, with other control characters escaped."""
    return printable(" ".join(str(error).split()))


def printable(text: str) -> str:
    r"""Escape control characters, so that text can't send commands to a terminal.

    >>> print(printable("a" + chr(27) + "[2J"))
    a\x1b[2J
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
