"""The base class of the package's errors, and the errors that several packages share."""

from typing import Any


class KnotgymError(Exception):
    """An error that the caller can fix.

    The message is one line: what was wrong, what was given, and what was expected.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the finished message, so that unpickling doesn't call the subclass's __init__."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class MissingFile(KnotgymError, FileNotFoundError):
    """The file or dataset doesn't exist."""


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
