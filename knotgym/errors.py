"""The base class of all errors this package raises on purpose, and those that rooms share."""

from typing import Any


class KnotgymError(Exception):
    """Something the caller can mend.

    The message is one line: what was wrong, what was given, what would be right.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the finished message: an __init__ that makes it isn't asked again."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class MissingFile(KnotgymError, FileNotFoundError):
    """There is no such file or dataset."""


def install_command(extra: str) -> str:
    """Return the command that installs an extra, to be run in a checkout.

    The name on the package index belongs to the published system, so no command names it.

    >>> install_command("learn")
    "pip install '.[learn]'"
    """
    return f"pip install '.[{extra}]'"


class MissingExtra(KnotgymError, ImportError):
    """An optional dependency isn't installed.

    Args:
        needed: the missing module or package.
        how: the command that installs it.
        user: what needs it.
    """

    def __init__(self, needed: str, how: str, user: str = "this") -> None:
        super().__init__(f"{user} needs {needed}, which isn't installed; install it: {how}")


def one_line(error: BaseException) -> str:
    """What an error says, its line breaks taken out, other control characters spelled out."""
    return printable(" ".join(str(error).split()))


def printable(text: str) -> str:
    r"""The same, with all that a terminal would obey spelled out.

    >>> printable("a" + chr(27) + "[2J")
    'a\x1b[2J'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
